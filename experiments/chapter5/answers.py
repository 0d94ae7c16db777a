"""Questions answered by the program itself, and their figures held against recorded ones."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

from experiments.chapter5.study import Question, Study
from experiments.command_line import process_pool
from experiments.expected_figures import Figure
from trms_cli.core.errors import ConfigurationError

#: In place of a number in a key: how many there are.
COUNT = "#"


def answer(question: Question, pictures: str | None) -> dict[str, Any]:
    """The document of one question; its pictures are kept in a folder, if there is one."""
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks import stability
    from trms_cli.library.tasks.task import Listener

    with tempfile.TemporaryDirectory(prefix="trms-chapter5-") as scratch:
        folder = Path(scratch, "answer")
        words = [*question.overrides, f"out='{folder}'"]
        if pictures is None:
            words.append("page=false")
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            stability.perform(compose(words, "stability"), Listener("stability"))
        document: dict[str, Any] = json.loads(
            (folder / stability.DOCUMENT_NAME).read_text(encoding="utf-8")
        )
        if pictures is not None:
            for chart, picture in question.pictures.items():
                shutil.copy(folder / f"{chart}.png", Path(pictures, f"{picture}.png"))
    return document


def answers(
    study: Study, jobs: int, pictures: Path | None, report: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """The documents of all questions, by name."""
    picture_folder = None if pictures is None else str(pictures)
    documents: dict[str, dict[str, Any]] = {}
    if jobs <= 1:
        for name, question in study.questions.items():
            documents[name] = answer(question, picture_folder)
            report(name)
        return documents
    with process_pool(jobs) as pool:
        futures = {
            pool.submit(answer, question, picture_folder): name
            for name, question in study.questions.items()
        }
        for future in as_completed(futures):
            documents[futures[future]] = future.result()
            report(futures[future])
    return {name: documents[name] for name in study.questions}


def figures_of(
    study: Study, documents: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Figure]]:
    """The figures that are recorded, by question and key."""
    return {
        name: {key: _at(documents[name]["results"], key, name) for key in question.figures}
        for name, question in study.questions.items()
    }


def _at(node: Any, key: str, name: str) -> Figure:
    for part in key.split("."):
        try:
            if part == COUNT:
                node = len(node)
            else:
                node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            raise ConfigurationError(
                f"the answer has no {key!r}",
                where=f"study.yaml, questions.{name}.figures",
                remedy=f"at {part!r} there is: "
                + (", ".join(map(str, node)) if isinstance(node, dict) else type(node).__name__),
            ) from None
    if isinstance(node, dict | list):
        raise ConfigurationError(
            f"{key!r} is no single figure", where=f"study.yaml, questions.{name}.figures"
        )
    return float(f"{node:.8g}") if isinstance(node, float) else node
