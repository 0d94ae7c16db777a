"""``python -m experiments.robustness``: two sweeps, their pictures, the tables of their pages."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from experiments.command_line import exit_code_of, one_thread_each, refuse_part
from experiments.page_tables import write_tables
from experiments.robustness.tables import table_of
from experiments.study_file import read_as
from trms_cli.commands.run import perform
from trms_cli.library.tasks.sweep import go_on, make_sweep
from trms_cli.reporting.sweep_screen import draw_summary
from trms_cli.sweeps.driver import SweepOutcome
from trms_cli.sweeps.outcome import outcome_of

ROOT = Path(__file__).resolve().parents[2]
STUDY = Path(__file__).with_name("study.yaml")
#: Where the pictures of the pages lie.
PICTURES = ROOT / "docs" / "figures" / "robustness"


class OneSweep(msgspec.Struct, forbid_unknown_fields=True):
    """A sweep of the study."""

    page: str  #: That shows its table and pictures
    figures: list[str]  #: Names of its pictures
    words: list[str]  #: What is typed after ``trms run -m``
    quick: list[str]  #: What is typed after that for a small part


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is left of the study, and print its tables."""
    parser = argparse.ArgumentParser(prog="python -m experiments.robustness", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a part of it, in seconds")
    parser.add_argument("--out", type=Path, help="folder of the runs (outputs/robustness)")
    parser.add_argument("--update", action="store_true", help="write the pages' tables, pictures")
    parser.add_argument("--jobs", type=int, help="processes (one for each core)")
    parser.add_argument("--only", help="one of the sweeps: draws, tuning")
    arguments = parser.parse_args(argv)
    one_thread_each()
    return exit_code_of(lambda: _study(arguments))


def _study(arguments: argparse.Namespace) -> int:
    if arguments.quick:
        refuse_part(arguments)
    sweeps = read_as(dict[str, OneSweep], STUDY, str(STUDY))
    out = arguments.out or ROOT / "outputs" / "robustness"
    failed = 0
    for name, sweep in sweeps.items():
        if arguments.only not in (None, name):
            continue
        swept = _run_sweep(sweep, out / name, arguments)
        failed += not swept.all_done
        document = outcome_of(swept.folder)
        table = table_of(document)
        sys.stdout.write(f"{table}\n\n")
        pictures = draw_summary(swept.folder, document["summary"])
        if arguments.update:
            PICTURES.mkdir(parents=True, exist_ok=True)
            for picture in pictures:
                if picture.name in sweep.figures:
                    shutil.copy(picture, PICTURES / picture.name)
            write_tables(ROOT / sweep.page, {name: table})
    return int(failed > 0)


def _run_sweep(sweep: OneSweep, folder: Path, arguments: argparse.Namespace) -> SweepOutcome:
    """The sweep, begun or gone on with."""
    workers = [f"launcher.workers={arguments.jobs}"] if arguments.jobs else []
    if (folder / "sweep.json").is_file():
        return go_on(folder, settings=workers)
    words = [*sweep.words, *(sweep.quick if arguments.quick else []), *workers, f"out={folder}"]
    return make_sweep(words, "run", perform)


if __name__ == "__main__":
    sys.exit(main())
