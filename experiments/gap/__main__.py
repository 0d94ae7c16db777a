"""``python -m experiments.gap``: does a diagnosed effect make the controller's model better?"""

from __future__ import annotations

import argparse
import fnmatch
import sys
from collections.abc import Sequence
from pathlib import Path
from time import process_time

from experiments.command_line import exit_code_of
from experiments.gap.models import DIAGNOSED, MODELS
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.core.threads import take_one_thread


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, print its tables, write them into the documentation on request."""
    arguments = _parser().parse_args(argv)
    take_one_thread()
    return exit_code_of(lambda: _study(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.gap", description=__doc__)
    parser.add_argument("--only", default="*", metavar="PATTERN", help="rigs: 'yaw_*', '*-1'")
    parser.add_argument(
        "--models",
        metavar="NAME,NAME",
        help=f"whose model: some of {', '.join(MODELS)}; "
        f"without `{DIAGNOSED}` nothing is diagnosed",
    )
    parser.add_argument("--without-separation", action="store_true", help="tracking alone")
    parser.add_argument(
        "--publish",
        action="store_true",
        help="put tables and figures into docs/closing-the-loop.md",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("outputs/closing_loop"),
        help="folder of recordings, diagnoses and runs; what it holds is not made again",
    )
    return parser


def _study(arguments: argparse.Namespace) -> int:
    from experiments.gap import page
    from experiments.gap.closing_loop import control, diagnose, record, rigs_of, sizes_of
    from experiments.gap.rigs import read_study
    from experiments.gap.separation import separate
    from experiments.page_tables import print_tables

    study = read_study()
    begin = process_time()
    rigs = [rig for rig in rigs_of(study) if fnmatch.fnmatchcase(rig.name, arguments.only)]
    if not rigs:
        raise ConfigurationError(
            f"no rig is called {arguments.only!r}",
            where="--only",
            remedy=nearest(arguments.only, [rig.name for rig in rigs_of(study)]),
        )
    models = arguments.models.split(",") if arguments.models else study["models"]
    for name in models:
        if name not in MODELS:
            raise ConfigurationError(
                f"no model is called {name!r}", where="--models", remedy=nearest(name, MODELS)
            )
    record(rigs, study, arguments.out, _tell)
    verdicts = []
    for i, rig in enumerate(rigs if DIAGNOSED in models else [], start=1):
        _tell(f"diagnosing {i} of {len(rigs)}: {rig.name}")
        verdicts.append(diagnose(rig, study["diagnose"], arguments.out))
    runs = control(rigs, study["tasks"], models, study, arguments.out, _tell)
    separations = [] if arguments.without_separation else separate(study, arguments.out, _tell)
    sizes = [sizes_of(rig, models, arguments.out) for rig in rigs]
    findings = page.Findings(runs, verdicts, sizes, separations, process_time() - begin)
    _tell("")
    print_tables(page.tables(findings), width=140)
    page.write_out(findings, arguments.out, arguments.out)
    if arguments.publish:
        page.publish(findings, arguments.out)
    print(f"{findings.seconds:.0f} s of processor time; tables and figures: {arguments.out}")
    return EXIT_OK


def _tell(words: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{words}")
        sys.stderr.flush()
    elif words:
        sys.stderr.write(f"{words}\n")


if __name__ == "__main__":
    sys.exit(main())
