"""``python -m experiments.chapter6``: run the study, draw it, hold it against what was recorded."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.chapter6.results import (
    Results,
    compute,
    details_of,
    differences,
    document_of,
    figures_of,
    read_expected,
)
from experiments.chapter6.study import HERE, STUDY, Study, read_study
from experiments.command_line import clocked, ended, one_thread_each, recorded_parser, refuse_part
from trms_cli.core.errors import (
    EXIT_OK,
    EXIT_WORSE,
)

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter6.md", DOCS / "figures" / "chapter6"
EXPECTED = HERE / "expected.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a figure is not what was recorded."""
    given = recorded_parser("chapter6", __doc__, STUDY).parse_args(argv)
    one_thread_each()
    return ended(lambda: _run(given))


def _run(given: argparse.Namespace) -> int:
    refuse_part(given)
    study = read_study(given.study, quick=given.quick)
    expected = None if given.update else read_expected(EXPECTED, quick=given.quick)
    said = clocked()
    results = compute(study, given.jobs, said)
    found = figures_of(results)
    if given.update:
        quick = compute(read_study(given.study, quick=True), given.jobs, said)
        EXPECTED.write_text(document_of(found, figures_of(quick)), encoding="utf-8")
        _show(study, results, FIGURES, page=True)
        said(f"recorded: {PAGE.name}, {EXPECTED.name}")
        return EXIT_OK
    if given.out is not None:
        _show(study, results, given.out, page=False)
        said(f"written: {given.out}")
    assert expected is not None
    moved = differences(found, expected, study.tolerances)
    for sentence in moved:
        sys.stdout.write(f"  {sentence}\n")
    count = sum(map(len, found.values()))
    said(f"{len(moved)} of {count} figures are not what was recorded")
    return EXIT_WORSE if moved else EXIT_OK


def _show(study: Study, results: Results, folder: Path, *, page: bool) -> None:
    """Figures, and tables into the page or beside the figures."""
    from experiments.chapter6 import figures
    from experiments.chapter6 import page as pages
    from experiments.page_tables import write_tables
    from trms_cli.controllers.newton_mpc import NewtonMpc

    folder.mkdir(parents=True, exist_ok=True)
    figures.draw_cases(results.runs, folder / "cases.png")
    figures.draw_objective(results.runs, folder / "objective.png")
    figures.draw_predictions(results.plans, folder / "predictions.png")
    figures.draw_decrease(results.records, NewtonMpc().sample_time, folder / "decrease.png")
    figures.draw_domain(study.domain, results.slices, folder / "domain.png")
    figures.draw_shares(study.domain, results.box, results.arrivals, folder / "horizon.png")
    figures.draw_iterations(results.economy, folder / "iterations.png")
    tables = {
        **pages.case_tables(study.cases.runs, results.runs),
        "decrease": pages.decrease_table(results.claims),
        **pages.domain_tables(study.domain, results.box, results.slices, results.arrivals),
        "iterations": pages.iteration_table(results.economy),
    }
    if page:
        write_tables(PAGE, tables)
        return
    words = "\n\n".join(f"## {name}\n\n{table}" for name, table in tables.items())
    (folder / "tables.md").write_text(words + "\n", encoding="utf-8")
    text = json.dumps(details_of(results), indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
