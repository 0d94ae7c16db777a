"""``python -m experiments.chapter5``: ask, draw, and hold the answers against what was recorded."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from experiments.chapter5.answers import answers, figures_of
from experiments.chapter5.page import parts_of
from experiments.chapter5.study import HERE, STUDY, read_study
from experiments.command_line import (
    exit_code_of,
    one_thread_each,
    progress_with_time,
    recorded_parser,
    refuse_part,
)
from experiments.expected_figures import exit_code, json_text, read_expected
from experiments.page_tables import write_tables
from trms_cli.core.errors import EXIT_OK

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter5.md", DOCS / "figures" / "chapter5"
EXPECTED = HERE / "expected.json"
SCHEMA = "trms.chapter5/1"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a figure is not what was recorded."""
    arguments = recorded_parser("chapter5", __doc__, STUDY).parse_args(argv)
    one_thread_each()
    return exit_code_of(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    refuse_part(arguments)
    study = read_study(arguments.study, quick=arguments.quick)
    expected = None if arguments.update else read_expected(EXPECTED, "figures")
    report = progress_with_time()
    pictures = FIGURES if arguments.update else arguments.out
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
    documents = answers(study, arguments.jobs, pictures, report)
    figures = figures_of(study, documents)
    if arguments.update:
        EXPECTED.write_text(json_text({"schema": SCHEMA, "figures": figures}), encoding="utf-8")
        write_tables(PAGE, parts_of(study, documents))
        report(f"recorded: {PAGE.name}, {EXPECTED.name}")
        return EXIT_OK
    if arguments.out is not None:
        for name, document in documents.items():
            (arguments.out / f"{name}.json").write_text(json_text(document), encoding="utf-8")
        report(f"written: {arguments.out}")
    assert expected is not None
    return exit_code(figures, expected, dict.fromkeys(figures, study.tolerance), report)


if __name__ == "__main__":
    sys.exit(main())
