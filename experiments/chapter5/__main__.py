"""``python -m experiments.chapter5``: ask, draw, and hold the answers against what was recorded."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.chapter5.answers import answers, differences, figures_of
from experiments.chapter5.page import parts_of
from experiments.chapter5.study import HERE, STUDY, read_study
from experiments.command_line import clocked, ended, one_thread_each, recorded_parser, refuse_part
from experiments.page_tables import write_tables
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter5.md", DOCS / "figures" / "chapter5"
EXPECTED = HERE / "expected.json"
SCHEMA = "trms.chapter5/1"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a figure is not what was recorded."""
    given = recorded_parser("chapter5", __doc__, STUDY).parse_args(argv)
    one_thread_each()
    return ended(lambda: _run(given))


def _run(given: argparse.Namespace) -> int:
    refuse_part(given)
    study = read_study(given.study, quick=given.quick)
    expected = None if given.update else read_expected(EXPECTED)
    said = clocked()
    pictures = FIGURES if given.update else given.out
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
    documents = answers(study, given.jobs, pictures, said)
    found = figures_of(study, documents)
    if given.update:
        words: Mapping[str, Any] = {"schema": SCHEMA, "figures": found}
        EXPECTED.write_text(_json(words), encoding="utf-8")
        write_tables(PAGE, parts_of(study, documents))
        said(f"recorded: {PAGE.name}, {EXPECTED.name}")
        return EXIT_OK
    if given.out is not None:
        for name, document in documents.items():
            (given.out / f"{name}.json").write_text(_json(document), encoding="utf-8")
        said(f"written: {given.out}")
    assert expected is not None
    moved = differences(found, expected, study.tolerance)
    for sentence in moved:
        sys.stdout.write(f"  {sentence}\n")
    said(f"{len(moved)} of {sum(map(len, found.values()))} figures are not what was recorded")
    return EXIT_WORSE if moved else EXIT_OK


def read_expected(path: Path) -> dict[str, dict[str, Any]]:
    """Recorded figures by question.

    Raises
    ------
    ConfigurationError
        If the file has none.
    """
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["figures"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            "there are no recorded figures",
            where=str(path),
            remedy="python -m experiments.chapter5 --update records today's",
        ) from error


def _json(document: Mapping[str, Any]) -> str:
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


if __name__ == "__main__":
    sys.exit(main())
