"""``python -m experiments.chapter6``: run the study, draw it, hold it against what was recorded."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

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
from experiments.command_line import ended
from trms_cli.core.errors import (
    EXIT_OK,
    EXIT_WORSE,
    ConfigurationError,
)

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter6.md", DOCS / "figures" / "chapter6"
EXPECTED = HERE / "expected.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a figure is not what was recorded."""
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter6", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a part of it, in seconds")
    parser.add_argument("--out", type=Path, help="figures, tables and JSON go there")
    parser.add_argument(
        "--update", action="store_true", help="record the figures, write docs/chapter6.md's tables"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--study", type=Path, default=STUDY, help="another study.yaml")
    given = parser.parse_args(argv)
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"  # of the processes begun here: each is one thread
    return ended(lambda: _run(given))


def _run(given: argparse.Namespace) -> int:
    if given.update and (given.quick or given.out):
        raise ConfigurationError(
            "what is recorded is the whole study, in its own place",
            where="--update",
            remedy="leave out --quick and --out",
        )
    study = read_study(given.study, quick=given.quick)
    expected = None if given.update else read_expected(EXPECTED, quick=given.quick)
    begin = perf_counter()

    def said(what: str) -> None:
        sys.stdout.write(f"{perf_counter() - begin:6.1f} s  {what}\n")
        sys.stdout.flush()

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
