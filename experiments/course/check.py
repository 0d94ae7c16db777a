"""``trms course check``: forms read, the key opened, answers marked."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.course.answers import (
    FORMS,
    Answer,
    EmptyForm,
    Marks,
    Scheme,
    Share,
    Worth,
    mark,
    read_answer,
    truth_of,
)
from experiments.gap.blind.sealing import COMMITMENT
from trms_cli.composition.composer import Composition
from trms_cli.core import wording
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.plugins import construct

if TYPE_CHECKING:
    from experiments.gap.blind.sealing import OpenedKey

SCHEMA = "trms.course.marks/1"
DOCUMENT, TABLE = "marks.json", "marks.csv"


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """The keys of ``configs/course_check.yaml``."""

    answers: str  #: A form, or a folder of them
    source: str | None = None  #: Folder that ``trms course rigs`` wrote (``in``)
    key: str | None = None
    size_within: Share = 0.1
    largest_uncertainty: Share = 0.25
    points: Mapping[str, Any] = field(default_factory=dict)  #: Of :class:`.answers.Worth`
    out: str | None = None


@dataclass(frozen=True, kw_only=True)
class Row:
    """A rig and what was handed in for it."""

    rig: str
    file: Path | None  #: None: nothing was handed in
    answer: Answer | None
    problem: str  #: Why nothing was marked; empty where it was
    marks: Marks


def perform(composition: Composition) -> int:
    """Mark what a configuration asks for, or only read it."""
    keys = dict(composition.config)
    options = construct(CheckOptions, {"source": keys.pop("in"), **keys})
    scheme = Scheme(
        size_within=options.size_within,
        largest_uncertainty=options.largest_uncertainty,
        points=construct(Worth, options.points, "points"),
    )
    place = Path(options.answers).expanduser()
    if options.source is None:
        return _read_alone(place)
    return _marked(options, place, scheme)


def forms(place: Path) -> list[Path]:
    """The form that a path is, or those in a folder and in the folders in it.

    Raises ConfigurationError where there is none.
    """
    if place.is_file():
        return [place]
    files = [*place.glob("*"), *place.glob("*/*")] if place.is_dir() else []
    handed_in = sorted(
        file
        for file in files
        if file.suffix.lower() in FORMS and file.is_file() and file.name != COMMITMENT
    )
    if not handed_in:
        raise ConfigurationError(
            f"{str(place)!r} holds no form" if place.is_dir() else f"there is no {str(place)!r}",
            where="answers",
            remedy=f"name a form, or a folder of them ({', '.join(FORMS)})",
        )
    return handed_in


def _read_alone(place: Path) -> int:
    for file in forms(place):
        answer = read_answer(file)
        said = answer.effect
        if answer.size is not None and answer.uncertainty is not None:
            said += f" at {answer.place}, {answer.size:g} ± {answer.uncertainty:g}"
        print(f"{file}: readable. {answer.rig}: {said}")
    return EXIT_OK


def rows(key: OpenedKey, files: Sequence[Path], scheme: Scheme) -> tuple[list[Row], list[str]]:
    """A row for each rig of a key, and what is wrong with forms that belong to none."""
    forms_by_rig: dict[str, list[tuple[Path, Answer | None, str]]] = {}
    strays: list[str] = []
    for file in files:
        try:
            answer = read_answer(file)
        except EmptyForm:
            continue
        except ConfigurationError as error:
            # a form that lies in the folder of its rig, or is called as it, is that rig's
            rig = next((n for n in (file.stem, file.parent.name) if n in key.cases), None)
            if rig is None:
                strays.append(f"{error.where}: {error.problem}")
            else:
                forms_by_rig.setdefault(rig, []).append((file, None, error.problem))
            continue
        if answer.rig not in key.cases:
            strays.append(f"{file}: there is no rig {answer.rig!r}")
        else:
            forms_by_rig.setdefault(answer.rig, []).append((file, answer, ""))
    return [_row(rig, forms_by_rig.get(rig, []), key, scheme) for rig in sorted(key.cases)], strays


def _row(
    rig: str,
    handed_in: Sequence[tuple[Path, Answer | None, str]],
    key: OpenedKey,
    scheme: Scheme,
) -> Row:
    if not handed_in:
        return Row(rig=rig, file=None, answer=None, problem="nothing handed in", marks=Marks())
    if len(handed_in) > 1:
        named = wording.listing([str(file) for file, *_ in handed_in])
        return Row(
            rig=rig,
            file=handed_in[0][0],
            answer=None,
            problem=f"handed in more than once: {named}",
            marks=Marks(),
        )
    file, answer, problem = handed_in[0]
    marks = Marks() if answer is None else mark(answer, key.cases[rig], scheme)
    return Row(rig=rig, file=file, answer=answer, problem=problem, marks=marks)


def _marked(options: CheckOptions, place: Path, scheme: Scheme) -> int:
    from experiments.gap.blind.make import key_folder_of
    from experiments.gap.blind.sealing import open_key
    from trms_cli.core.whole_file import replace_whole
    from trms_cli.runs.run_folder import new_folder, removed_if_empty, write_document

    source = Path(str(options.source)).expanduser()
    files = forms(place)
    folder = new_folder(options.out, "course")
    with removed_if_empty(folder):
        key = open_key(key_folder_of(source, options.key), source)
        marked, strays = rows(key, files, scheme)
        write_document(_document(key, marked, scheme), folder / DOCUMENT)
        replace_whole(folder / TABLE, _table(key, marked, scheme).encode())
    _print(key, marked, scheme, folder)
    unread = [f"{row.file}: {row.problem}" for row in marked if row.file and row.answer is None]
    if unread or strays:
        raise ConfigurationError(
            f"{wording.count(len(unread) + len(strays), 'form')} could not be marked; "
            "all others were\n" + "\n".join(f"  {line}" for line in (*unread, *strays)),
            where="answers",
            remedy="have them handed in again; students see with "
            "`trms course check answers=FILE` whether theirs is readable",
        )
    return EXIT_OK


def _document(key: OpenedKey, marked: Sequence[Row], scheme: Scheme) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "commitment": key.commitment,
        "seed": key.seed,
        "scheme": asdict(scheme),
        "rigs": {
            row.rig: {
                "file": None if row.file is None else str(row.file),
                "answer": None if row.answer is None else asdict(row.answer),
                "truth": dict(truth_of(key.cases[row.rig])),
                "marks": asdict(row.marks),
                "points": row.marks.all,
                "problem": row.problem or None,
            }
            for row in marked
        },
    }


def _table(key: OpenedKey, marked: Sequence[Row], scheme: Scheme) -> str:
    """CSV for a spreadsheet."""
    text = io.StringIO()
    writer = csv.writer(text)
    parts = ("effect", "place", "size", "uncertainty")
    writer.writerow(
        (
            *("rig", "file", "points", "of", *(f"{part}_points" for part in parts), "answer"),
            *("answer_size", "answer_uncertainty", "truth", "truth_size", "problem"),
        )
    )
    for row in marked:
        truth = truth_of(key.cases[row.rig])
        answer = row.answer
        said = ("", "", "") if answer is None else (answer.effect, answer.size, answer.uncertainty)
        writer.writerow(
            [row.rig, row.file or "", row.marks.all, scheme.points.all]
            + [getattr(row.marks, part) for part in parts]
            + ["" if value is None else _harmless(value) for value in said]
            + [truth["effect"], "" if truth["size"] is None else truth["size"]]
            + [_harmless(row.problem)]
        )
    return text.getvalue()


def _harmless(value: object) -> object:
    """A cell whose text no spreadsheet takes for a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in "=+-@" and value else value


def _print(key: OpenedKey, marked: Sequence[Row], scheme: Scheme, folder: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console()
    handed_in = [row for row in marked if row.file is not None]
    console.print(
        f"{len(handed_in)} of {len(marked)} handed in; the key is the one of the task sheets, "
        f"{key.commitment[:16]}…",
        highlight=False,
        soft_wrap=True,
    )
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in ("rig", "points", "answer", "the rig has", "size off by"):
        table.add_column(
            column,
            header_style="bold cyan",
            justify="right" if column in ("points", "size off by") else "left",
            no_wrap=column in ("rig", "points"),
        )
    for row in marked:
        marks = row.marks
        style = {"right": "green", "confusable": "yellow", "wrong": "red"}.get(marks.verdict, "dim")
        table.add_row(
            row.rig,
            f"{marks.all:g} of {scheme.points.all:g}",
            row.problem.partition(":")[0] if row.answer is None else row.answer.effect,
            str(truth_of(key.cases[row.rig])["effect"]),
            wording.percent(marks.size_error) if marks.size_error is not None else "",
            style=style,
        )
    console.print(table)
    names = [row.marks.verdict for row in handed_in if row.answer is not None]
    console.print(
        f"  effects of {wording.count(len(names), 'answer')}: {names.count('right')} right, "
        f"{names.count('confusable')} confusable, {names.count('wrong')} wrong",
        highlight=False,
    )
    console.print(
        f"written: {folder / TABLE}, {folder / DOCUMENT}", highlight=False, soft_wrap=True
    )
