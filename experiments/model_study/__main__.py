"""``python -m experiments.model_study``: run, draw, hold against what was recorded."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.command_line import (
    exit_code_of,
    one_thread_each,
    progress_with_time,
    recorded_parser,
    refuse_part,
)
from experiments.expected_figures import exit_code, json_text, read_expected
from experiments.model_study.study import HERE, STUDY, read_study
from trms_cli.core.errors import EXIT_OK

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "model-study.md", DOCS / "figures" / "model_study"
EXPECTED = HERE / "expected.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a figure is not what was recorded."""
    parser = recorded_parser("model_study", __doc__, STUDY)
    parser.add_argument(
        "--record", type=Path, default=Path("tras"), help="folder of the TRAS record (tras/)"
    )
    arguments = parser.parse_args(argv)
    one_thread_each()
    return exit_code_of(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    from experiments.model_study.results import compute, details_of, document_of, figures_of
    from experiments.model_study.results import record_of as record_in

    refuse_part(arguments)
    study = read_study(arguments.study, quick=arguments.quick)
    part = "quick" if arguments.quick else "full"
    expected = None if arguments.update else read_expected(EXPECTED, part)
    report = progress_with_time()
    record = record_in(arguments.record)
    if study.record is not None and record is None:
        report(f"no record in {arguments.record}: its part is left out")
    results = compute(study, arguments.jobs, record, report)
    figures = figures_of(results)
    folder = FIGURES if arguments.update else arguments.out
    if folder is not None:
        from experiments.model_study.figures import draw
        from experiments.model_study.page import tables
        from experiments.page_tables import write_alone, write_tables

        folder.mkdir(parents=True, exist_ok=True)
        draw(results, folder)
        if arguments.update:
            quick = compute(read_study(arguments.study, quick=True), arguments.jobs, None, report)
            EXPECTED.write_text(document_of(figures, figures_of(quick)), encoding="utf-8")
            write_tables(PAGE, tables(results))
            report(f"recorded: {PAGE.name}, {EXPECTED.name}")
            return EXIT_OK
        write_alone(folder, tables(results))
        (folder / "results.json").write_text(json_text(details_of(results)), encoding="utf-8")
        report(f"written: {folder}")
    assert expected is not None
    return exit_code(figures, expected, study.tolerances, report)


if __name__ == "__main__":
    sys.exit(main())
