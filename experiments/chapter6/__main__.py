"""``python -m experiments.chapter6``: run the study, draw it, hold it against what was recorded."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.chapter6.results import Results, compute, details_of, document_of, figures_of
from experiments.chapter6.study import HERE, STUDY, Study, read_study
from experiments.command_line import (
    exit_code_of,
    one_thread_each,
    progress_with_time,
    recorded_parser,
    refuse_part,
)
from experiments.expected_figures import exit_code, json_text, read_expected
from trms_cli.core.errors import EXIT_OK

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter6.md", DOCS / "figures" / "chapter6"
EXPECTED = HERE / "expected.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a figure is not what was recorded."""
    arguments = recorded_parser("chapter6", __doc__, STUDY).parse_args(argv)
    one_thread_each()
    return exit_code_of(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    refuse_part(arguments)
    study = read_study(arguments.study, quick=arguments.quick)
    expected = (
        None
        if arguments.update
        else read_expected(EXPECTED, "quick" if arguments.quick else "full")
    )
    report = progress_with_time()
    results = compute(study, arguments.jobs, report)
    figures = figures_of(results)
    if arguments.update:
        quick = compute(read_study(arguments.study, quick=True), arguments.jobs, report)
        EXPECTED.write_text(document_of(figures, figures_of(quick)), encoding="utf-8")
        _show(study, results, FIGURES, page=True)
        report(f"recorded: {PAGE.name}, {EXPECTED.name}")
        return EXIT_OK
    if arguments.out is not None:
        _show(study, results, arguments.out, page=False)
        report(f"written: {arguments.out}")
    assert expected is not None
    return exit_code(figures, expected, study.tolerances, report)


def _show(study: Study, results: Results, folder: Path, *, page: bool) -> None:
    """Figures, and tables into the page or beside the figures."""
    from experiments import block_diagrams
    from experiments.chapter6 import figures
    from experiments.chapter6 import page as pages
    from experiments.chapter6.settings import settings_table
    from experiments.page_tables import write_alone, write_tables
    from trms_cli.controllers.newton_mpc import NewtonMpc

    folder.mkdir(parents=True, exist_ok=True)
    block_diagrams.draw_newton_mpc(folder / "controller.png")
    figures.draw_cases(results.runs, folder / "cases.png")
    figures.draw_objective(results.runs, folder / "objective.png")
    figures.draw_predictions(results.plans, folder / "predictions.png")
    figures.draw_decrease(results.records, NewtonMpc().sample_time, folder / "decrease.png")
    figures.draw_domain(study.domain, results.slices, folder / "domain.png")
    figures.draw_shares(study.domain, results.box, results.arrivals, folder / "horizon.png")
    figures.draw_iterations(results.economy, folder / "iterations.png")
    tables = {
        "settings": settings_table(study.cases),
        **pages.case_tables(study.cases.runs, results.runs),
        "decrease": pages.decrease_table(results.claims),
        **pages.domain_tables(study.domain, results.box, results.slices, results.arrivals),
        "iterations": pages.iteration_table(results.economy),
    }
    if page:
        write_tables(PAGE, tables)
        return
    write_alone(folder, tables)
    (folder / "results.json").write_text(json_text(details_of(results)), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
