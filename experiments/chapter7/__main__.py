"""``python -m experiments.chapter7``: close the loops of the chapter, compare, draw, write."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from experiments.chapter7.comparison import deviations
from experiments.chapter7.page import tables_of
from experiments.chapter7.runs import Outcome, run_all
from experiments.chapter7.study import HERE, STUDY, Study, jobs_of, read_study
from experiments.command_line import exit_code_of
from experiments.expected_figures import json_text, rounded
from experiments.page_tables import write_alone, write_tables
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError

SCHEMA = "trms.chapter7/1"
EXPECTED = HERE / "expected.json"
DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter7.md", DOCS / "figures" / "chapter7"
OBSERVERS = HERE / "observers" / "results.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter7", description=__doc__)
    parser.add_argument("--study", type=Path, default=STUDY, help="another study.yaml")
    parser.add_argument("--quick", action="store_true", help="only the beginning of each case")
    parser.add_argument("--all-pairs", action="store_true", help="more observers and controllers")
    parser.add_argument("--only", default="", help="only runs whose name contains this")
    parser.add_argument(
        "--over-the-wire",
        action="store_true",
        help="the cases of the experiment in real time, each on a rig in a process of its own "
        "behind UDP; nothing is compared or updated",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes at once (default: 2)")
    parser.add_argument("--out", type=Path, help="folder for figures, tables and JSON")
    parser.add_argument(
        "--update", action="store_true", help="make these the expected figures; redo the page"
    )
    arguments = parser.parse_args(argv)
    return exit_code_of(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    study = read_study(arguments.study)
    jobs = jobs_of(study, quick=arguments.quick, all_pairs=arguments.all_pairs)
    jobs = [job for job in jobs if arguments.only in job.key]
    begin, outcomes = perf_counter(), []
    if arguments.over_the_wire:
        if arguments.update:
            raise ConfigurationError(
                "what a clock has a part in is not repeatable",
                where="--over-the-wire --update",
                remedy="leave one of them out",
            )
        from experiments.chapter7.over_the_wire import run_over_the_wire

        jobs = [job for job in jobs if job.is_blind]
        coming: Iterable[Outcome] = (run_over_the_wire(job, study.last) for job in jobs)
    else:
        coming = run_all(jobs, study.last, arguments.jobs)
    for outcome in coming:
        outcomes.append(outcome)
        message = outcome.problem or _summary(outcome)
        sys.stdout.write(f"{perf_counter() - begin:6.1f} s  {outcome.job.key}: {message}\n")
        sys.stdout.flush()
    tables = tables_of(study, outcomes)
    for name, table in tables.items():
        sys.stdout.write(f"\n{name}\n\n{table}\n")
    figures = rounded({outcome.job.key: outcome.figures for outcome in outcomes})
    section = "quick" if arguments.quick else "full"
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        _draw(study, outcomes, arguments.out)
        document = {"schema": SCHEMA, section: figures}
        (arguments.out / "chapter7.json").write_text(json_text(document), encoding="utf-8")
        write_alone(arguments.out, tables)
    if any(outcome.problem for outcome in outcomes):
        return EXIT_WORSE
    if arguments.update:
        expected = read_expected() | {"schema": SCHEMA, section: figures}
        EXPECTED.write_text(json_text(expected), encoding="utf-8")
        if not arguments.quick:
            FIGURES.mkdir(parents=True, exist_ok=True)
            _draw(study, outcomes, FIGURES)
            write_tables(PAGE, tables)
        return EXIT_OK
    return EXIT_OK if arguments.over_the_wire else _compare(study, figures, section)


def read_expected() -> dict[str, Any]:
    """The expected figures; empty before the first ``--update``."""
    if not EXPECTED.is_file():
        return {}
    expected: dict[str, Any] = json.loads(EXPECTED.read_text(encoding="utf-8"))
    return expected


def _compare(study: Study, figures: dict[str, Any], section: str) -> int:
    expected = {k: v for k, v in read_expected().get(section, {}).items() if k in figures}
    changes = list(deviations(expected, figures, study.tolerances))
    for one in changes:
        sys.stdout.write(f"\n{one.key}: {one.now}, expected {one.expected}")
    sys.stdout.write(f"\n{len(changes)} figures deviate from {EXPECTED.name}\n")
    return EXIT_WORSE if changes else EXIT_OK


def _draw(study: Study, outcomes: Sequence[Outcome], folder: Path) -> None:
    from experiments import block_diagrams
    from experiments.chapter7 import figures

    block_diagrams.draw_output_feedback(folder / "loop.png")
    main_pairs = [o for o in outcomes if o.job.pair in study.pairs]
    for part in study.parts:
        members = [o for o in main_pairs if o.job.part == part]
        figures.draw_cases(members, folder / f"{part}.png")
        figures.draw_inputs(members, folder / f"{part}_inputs.png")
    if any(o.job.case == "step with force" for o in main_pairs):
        figures.draw_force(study, main_pairs, folder / "force.png")
    if OBSERVERS.is_file():
        document = json.loads(OBSERVERS.read_text(encoding="utf-8"))
        figures.draw_observers(document, folder / "observers.png")


def _summary(outcome: Outcome) -> str:
    pitch, yaw = (outcome.figures[angle]["rmse"] for angle in ("alpha_v", "alpha_h"))
    return f"RMSE pitch {pitch:.4f}, yaw {yaw:.4f} rad"


if __name__ == "__main__":
    sys.exit(main())
