"""The list of all runs, as a page: filtered, sorted and turned over by addresses alone."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from trms_cli.core import wording
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Cell, Datum, Findings, Measure, NextCommand, Section, Table
from trms_cli.core.invocation import program
from trms_cli.library.server.catalogue import CHOICES, Catalogue, key_of
from trms_cli.reporting.run_list import ColumnChoice, ListHead, ListRow, RunList
from trms_cli.runs.filter import names_in, translate_filter
from trms_cli.runs.query import Query, QueryResult
from trms_cli.runs.table import HEADINGS, OVERRIDES, USUAL, differing_keys, visible_columns

#: Runs of one page, values that a choice offers, and folders that are listed.
PAGE_LENGTH, _MOST_OPTIONS, _MOST_FOLDERS = 100, 60, 30
_LONGEST_CELL = 60  # characters
#: Runs without an end, the latest first, of which it is asked whether they are being written.
_MOST_OPEN = 50
_LABELS = {"ref": "reference", "plant": "rig"}
_JUDGEMENTS: Mapping[str, Any] = {
    "failed": "bad",
    "interrupted": "doubtful",
    "unfinished": "doubtful",
    "live": "good",
}


@dataclass(frozen=True)
class ListRequest:
    """What an address asks of the list."""

    filter: str = ""
    chosen: tuple[tuple[str, str], ...] = ()  #: Columns and the value that each has to have
    sort: str = "time"
    descending: bool = True
    page: int = 1  #: From 1 on

    @classmethod
    def of_query(cls, query: Mapping[str, str]) -> ListRequest:
        """The request of an address; what it does not say, or says badly, is as usual."""
        number = query.get("page", "1")
        sort = query.get("sort") or "time"
        order = query.get("order", "descending" if sort == "time" else "ascending")
        return cls(
            filter=query.get("filter", "").strip(),
            chosen=tuple((name, query[name]) for name in CHOICES if query.get(name)),
            sort=sort,
            descending=order == "descending",
            page=max(1, int(number)) if number.isascii() and number.isdigit() else 1,
        )

    @property
    def condition(self) -> str:
        """The filter, in the language of ``trms runs``, with what was chosen."""
        parts = [f"({self.filter})"] if self.filter else []
        parts += [f"{name} == {value!r}" for name, value in self.chosen]
        return " and ".join(parts)

    @property
    def hidden(self) -> list[tuple[str, str]]:
        """What a form has to send beside its fields, for the order to stay."""
        if self.sort == "time" and self.descending:
            return []
        return [("sort", self.sort), ("order", "descending" if self.descending else "ascending")]

    def address(self, **changes: Any) -> str:
        """The address of this list, but for what is given."""
        values: dict[str, Any] = {"filter": self.filter, **dict(self.chosen)}
        values |= {"sort": self.sort, "order": "descending" if self.descending else "ascending"}
        values |= {"page": self.page, **changes}
        return "/?" + urlencode({key: value for key, value in values.items() if value})


def list_page(catalogue: Catalogue, request: ListRequest) -> tuple[Findings, RunList]:
    """What the page of all runs tells, and its list."""
    problem = ""
    try:
        result = catalogue.find(_query(request))
    except ConfigurationError as error:
        result = catalogue.find(Query(columns=("log",), limit=1))
        problem = "\n".join(filter(None, (error.problem, error.where, error.remedy)))
        result = replace(result, runs=())
    live = _live_runs(catalogue)
    runs = _run_list(catalogue, request, result, {str(run["log"]) for run in live}, problem)
    return _findings(catalogue, result, live), runs


def _query(request: ListRequest) -> Query:
    if request.filter:  # the reader's part alone: its trouble is told at its own places
        translate_filter(request.filter, None)
    mentioned = [request.sort, *names_in(request.filter)]
    return Query(
        filter=request.condition,
        sort=request.sort,
        descending=request.descending,
        columns=tuple(dict.fromkeys(["log", *USUAL, *mentioned, OVERRIDES])),
        limit=PAGE_LENGTH * request.page,
    )


def _live_runs(catalogue: Catalogue) -> list[Any]:
    columns = ("log", "path", "controller", "ref", "time")
    query = Query(filter="outcome == 'unfinished'", columns=columns, limit=_MOST_OPEN)
    return [run for run in catalogue.find(query).runs if catalogue.is_live(str(run["log"]))]


def _findings(catalogue: Catalogue, result: QueryResult, live: Sequence[Any]) -> Findings:
    paths = [_from_home(folder.resolve()) for folder in catalogue.folders]
    where = wording.listing(paths, most=3) or "this machine"
    if not result.of:
        commands = [
            NextCommand(f"{program()} run controller=pid ref=square", "makes one:"),
            NextCommand(f"{program()} serve --all", "serves every run that this machine knows of:"),
        ]
        lead = [f"No run yet in {where}. This page shows each as soon as it begins."]
        return Findings("Runs", lead, [Section("What to type", blocks=commands)])
    outcomes = catalogue.inventory.counts["outcome"]
    failed = outcomes.get("failed", 0)
    measures = [
        Measure("runs", result.of),
        Measure("live now", len(live), judgement="good" if live else ""),
        Measure("completed", outcomes.get("completed", 0)),
        Measure("failed", failed, judgement="bad" if failed else "good"),
    ]
    going_on = [
        f"**{run['controller'] or 'A run'}** on {run['ref'] or 'no reference'} is going on: "
        f"{_short_path(catalogue, str(run['path']))}."
        for run in live[:3]
    ]
    lead = [f"{wording.count(result.of, 'run')} in {where}.", *going_on, *result.remarks]
    sections = []
    folders: list[list[Cell]] = [
        [
            Datum(_short_path(catalogue, folder.path), link=f"/folder/{key_of(folder.path)}"),
            folder.count,
        ]
        for folder in catalogue.run_folders[:_MOST_FOLDERS]
    ]
    if folders:
        words = "A report of all runs of a folder: how they rank, spread, depend and fail."
        sections.append(Section("Folders of runs", [words], [Table(["folder", "runs"], folders)]))
    if result.unreadable:
        rows: list[list[Cell]] = [
            [_short_path(catalogue, log), why] for log, why in result.unreadable[:200]
        ]
        table = Table(["log", "why"], rows)
        count = wording.count(len(result.unreadable), "log")
        sections.append(Section(f"{count} not readable", blocks=[table], folded=True))
    return Findings("Runs", lead, sections, measures=measures)


def _run_list(
    catalogue: Catalogue,
    request: ListRequest,
    result: QueryResult,
    live: set[str],
    problem: str,
) -> RunList:
    first = PAGE_LENGTH * (request.page - 1)
    result = replace(result, runs=result.runs[first:])
    for run in result.runs:
        if run["log"] in live:
            run["outcome"] = "live"
    names = [] if problem else _names(request, result)
    numeric = {name for name in names if _is_numeric(result, name)}
    heads = [_head(request, name, result.columns[name].unit, name in numeric) for name in names]
    rows = [
        ListRow(
            key_of(str(run["log"])),
            _short_path(catalogue, str(run["path"])),
            [_cell(catalogue, run, name, name in numeric) for name in names],
        )
        for run in result.runs
    ]
    shown = len(rows)
    later = bool(shown) and first + shown < result.matching
    return RunList(
        heads,
        rows,
        "" if problem else _count(result, first, shown),
        filter=request.filter,
        problem=problem,
        choices=_choices(catalogue, dict(request.chosen)),
        hidden=request.hidden,
        earlier=request.address(page=request.page - 1) if request.page > 1 else "",
        later=request.address(page=request.page + 1) if later else "",
    )


def _count(result: QueryResult, first: int, shown: int) -> str:
    if not shown:
        return "No run is like that." if result.of else ""
    if shown < result.matching:
        return f"{first + 1} to {first + shown} of {wording.count(result.matching, 'run')}"
    return wording.count(shown, "run")


def _choices(catalogue: Catalogue, chosen: Mapping[str, str]) -> list[ColumnChoice]:
    """Columns in which runs differ, with the values to choose from."""
    counts = catalogue.inventory.counts
    return [
        ColumnChoice(
            name,
            _LABELS.get(name, name),
            list(counts[name].items())[:_MOST_OPTIONS],
            chosen.get(name, ""),
        )
        for name in CHOICES
        if len(counts[name]) > 1 or name in chosen
    ]


def _names(request: ListRequest, result: QueryResult) -> list[str]:
    mentioned = [request.sort, *names_in(request.filter)]
    if any(run["outcome"] != "completed" for run in result.runs):
        mentioned.append("outcome")
    names = visible_columns(result, mentioned)
    names += differing_keys(result, names)
    return [name for name in names if name != "log"]


def _is_numeric(result: QueryResult, name: str) -> bool:
    """Whether a column holds numbers: also one that may hold anything, as a key that was typed."""
    values = [run[name] for run in result.runs if run[name] is not None]
    return result.columns[name].is_number or (
        bool(values)
        and all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    )


def _head(request: ListRequest, name: str, unit: str, is_number: bool) -> ListHead:
    sorted_by = request.sort == name
    falling = not request.descending if sorted_by else name == "time"
    order = "descending" if falling else "ascending"
    address = request.address(sort=name, order=order, page=None)
    now = ("descending" if request.descending else "ascending") if sorted_by else ""
    text = wording.with_unit(HEADINGS.get(name, name), unit)
    return ListHead(text, address, now, is_number)


def _cell(catalogue: Catalogue, run: Mapping[str, Any], name: str, is_number: bool) -> Cell:
    value = run[name]
    if name == "path":
        return Datum(_short_path(catalogue, str(value)), link=f"/run/{key_of(str(run['log']))}")
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value == "":
        return None if is_number else "–"
    if isinstance(value, int | float):
        return value
    text = str(value)
    text = text if len(text) <= _LONGEST_CELL else f"{text[: _LONGEST_CELL - 1]}…"
    return Datum(text, _JUDGEMENTS.get(text, "") if name == "outcome" else "")


def _from_home(folder: Path) -> str:
    """``~/lab`` for a folder under the user's own."""
    home = Path.home()
    return str(Path("~") / folder.relative_to(home)) if folder.is_relative_to(home) else str(folder)


def _short_path(catalogue: Catalogue, path: str) -> str:
    """A path from the folder on that is served, where it is one."""
    folders = [os.path.realpath(folder) for folder in catalogue.folders]
    if len(folders) == 1 and path.startswith(folders[0].rstrip(os.sep) + os.sep):
        return os.path.relpath(path, folders[0])
    return path
