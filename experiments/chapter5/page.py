"""What the page of the study says: the answers' own sentences and tables, as Markdown."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.chapter5.study import Question, Study
from trms_cli.core import wording


def parts_of(study: Study, documents: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """The text between the marks of the page, by question."""
    return {name: _part(question, documents[name]) for name, question in study.questions.items()}


def _part(question: Question, document: Mapping[str, Any]) -> str:
    lines = [f"`trms stability {shlex.join(question.overrides)}`: {question.why}.", ""]
    lines += [f"- {sentence}" for sentence in document["lead"]]
    lines += [f"- *{warning}*" for warning in document["warnings"]]
    for place in question.tables:
        table = document["tables"][place]
        lines += ["", *_table(table["columns"], table["rows"])]
        if table["caption"]:
            lines += ["", f"*{table['caption']}*"]
    charts = {chart["name"]: chart for chart in document["charts"]}
    for name, picture in question.pictures.items() if question.shown else ():
        lines += ["", f"![{charts[name]['caption']}](figures/chapter5/{picture}.png)"]
    return "\n".join(lines)


def _table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    body = [[wording.cell(cell).replace("|", "\\|") for cell in row] for row in rows]
    heads = [column.replace("|", "\\|") for column in columns]
    lines = [heads, ["---"] * len(columns), *body]
    return [f"| {' | '.join(line)} |" for line in lines]
