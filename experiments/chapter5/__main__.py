"""``python -m experiments.chapter5``: ask, draw, and hold the answers against what was recorded."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from experiments.chapter5.answers import answers, differences, figures_of
from experiments.chapter5.page import parts_of
from experiments.chapter5.study import HERE, STUDY, read_study
from experiments.command_line import ended
from experiments.page_tables import write_tables
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter5.md", DOCS / "figures" / "chapter5"
EXPECTED = HERE / "expected.json"
SCHEMA = "trms.chapter5/1"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 1 when a figure is not what was recorded."""
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter5", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a part of it, in seconds")
    parser.add_argument("--out", type=Path, help="figures and JSON go there")
    parser.add_argument(
        "--update", action="store_true", help="record the figures, write docs/chapter5.md's parts"
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
    expected = None if given.update else read_expected(EXPECTED)
    begin = perf_counter()

    def said(what: str) -> None:
        sys.stdout.write(f"{perf_counter() - begin:6.1f} s  {what}\n")
        sys.stdout.flush()

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
    except (OSError, ValueError, KeyError) as error:
        raise ConfigurationError(
            "there are no recorded figures",
            where=str(path),
            remedy="python -m experiments.chapter5 --update records today's",
        ) from error


def _json(document: Mapping[str, Any]) -> str:
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


if __name__ == "__main__":
    sys.exit(main())
