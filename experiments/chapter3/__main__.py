"""``python -m experiments.chapter3``: train the networks of chapter 3 and write what came out.

``study`` (the default) renews the tables and figures of docs/chapter3.md; ``networks`` trains the
networks that travel with the program.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.command_line import exit_code_of
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.threads import take_one_thread

_DOCS = Path(__file__).resolve().parents[2] / "docs"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    arguments = _parser().parse_args(argv)
    take_one_thread()
    return exit_code_of(
        lambda: _networks(arguments.only) if arguments.what == "networks" else _study(arguments)
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter3", description=__doc__)
    parser.add_argument("what", nargs="?", choices=("study", "networks"), default="study")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--docs", type=Path, default=_DOCS, help="folder of chapter3.md")
    parser.add_argument(
        "--short", type=float, default=1.0, help="share of the recordings' durations, for a try"
    )
    parser.add_argument("--seeds", type=int, nargs="+", help="starts, in place of the settings'")
    parser.add_argument("--only", nargs="+", help="networks to train: narx_2dof …")
    return parser


def _study(arguments: argparse.Namespace) -> int:
    from experiments.chapter3.figures import draw_all
    from experiments.chapter3.page import write_page
    from experiments.chapter3.study import run_study
    from experiments.chapter3.tables import markdown, plain

    study = run_study(arguments.jobs, arguments.short, arguments.seeds)
    folder = arguments.docs / "figures" / "chapter3"
    draw_all(study, folder, arguments.short)
    tables = markdown(study)
    document = json.dumps(plain(study), indent=1, ensure_ascii=False)
    (folder / "chapter3.json").write_text(f"{document}\n", encoding="utf-8")
    write_page(arguments.docs / "chapter3.md", tables)
    sys.stdout.write("\n\n".join(f"{name}\n\n{table}" for name, table in tables.items()) + "\n")
    return EXIT_OK


def _networks(only: Sequence[str] | None) -> int:
    from experiments.chapter3.networks import settings, train_network, write_network
    from experiments.chapter3.screen import Screen

    for name in only or settings()["networks"]:
        content = train_network(name, Screen(name))
        path = write_network(content)
        sys.stdout.write(f"{path}\n")
        for horizon, errors in content.training["free_run_rms"].items():
            words = ", ".join(f"{key} {value:g}" for key, value in errors.items())
            sys.stdout.write(f"  RMS error over free runs of {horizon}: {words}\n")
    return EXIT_OK


if __name__ == "__main__":
    raise SystemExit(main())
