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
    study = _every_effect if arguments.every_effect else _study
    return exit_code_of(lambda: study(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.gap", description=__doc__)
    parser.add_argument("--only", default="*", metavar="PATTERN", help="rigs: 'yaw_*', '*-1'")
    parser.add_argument(
        "--models",
        metavar="NAME,NAME",
        help=f"whose model: some of {', '.join(MODELS)}; "
        f"without `{DIAGNOSED}` nothing is diagnosed",
    )
    parser.add_argument(
        "--every-effect",
        action="store_true",
        help="in place of the study: every effect of the library, its size known, in simulation; "
        "--only is then a pattern of effects",
    )
    for name, meaning in (("controllers", "newton_mpc,pid"), ("references", "square,sine")):
        parser.add_argument(f"--{name}", metavar="NAME,NAME", help=f"of --every-effect: {meaning}")
    parser.add_argument("--seeds", type=int, default=1, help="of --every-effect: runs of each")
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


def _every_effect(arguments: argparse.Namespace) -> int:
    from experiments.gap import every_effect as study
    from experiments.gap.page import PAGE
    from experiments.page_tables import markdown, print_tables, write_tables

    effects = study.library_effects()
    chosen = [name for name in effects if fnmatch.fnmatchcase(name, arguments.only)]
    if not chosen:
        raise ConfigurationError(
            f"no effect is called {arguments.only!r}",
            where="--only",
            remedy=nearest(arguments.only, effects),
        )
    controllers = _chosen(arguments.controllers, study.CONTROLLERS, "--controllers")
    references = _chosen(arguments.references, tuple(study.REFERENCES), "--references")
    begin, out = process_time(), arguments.out / "every_effect"
    seeds = range(arguments.seeds)
    runs = study.compare_effects(chosen, controllers, references, seeds, out, _tell)
    comparisons = study.comparisons(runs)
    worse = dict.fromkeys(result.effect for result in comparisons if result.is_worse)
    tables = study.tables(comparisons, study.warned_of(list(worse), _tell))
    _tell("")
    print_tables(tables, width=140)
    if arguments.publish:
        write_tables(PAGE, {name: markdown(rows) for name, rows in tables.items()})
    print(f"{process_time() - begin:.0f} s of processor time; runs: {out}")
    return EXIT_OK


def _chosen(words: str | None, known: Sequence[str], where: str) -> list[str]:
    """Names between commas; all that there are where none is given."""
    names = words.split(",") if words else list(known)
    for name in names:
        if name not in known:
            raise ConfigurationError(
                f"{name!r} is none of {', '.join(known)}", where=where, remedy=nearest(name, known)
            )
    return names


def _tell(words: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{words}")
        sys.stderr.flush()
    elif words:
        sys.stderr.write(f"{words}\n")


if __name__ == "__main__":
    sys.exit(main())
