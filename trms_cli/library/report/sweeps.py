"""Reads folders of many runs for reports: rows of the index, and a sweep's own words."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec

from trms_cli.core.data_file import json_or_none
from trms_cli.core.wording import listing, typed_files
from trms_cli.library.report import summary
from trms_cli.runs.index import Row, Rows, column_of

if TYPE_CHECKING:
    from trms_cli.reporting.sweep_report import Objective, SweepReport, SweepRun, Value
    from trms_cli.runs.query import QueryResult
    from trms_cli.scoring.comparison.runs import RunCollection

STATUS_NAME = "status.json"
SWEEP_NAME, PAGE_NAME = "sweep.json", "report.html"
_SWEEP_SCHEMA = "trms.sweep/"
_LONGEST_PLAN = 64 * 2**20  # bytes of a sweep.json
_MOST_KEYS = 30
_LONGEST_PROBLEM = 1_000
#: Options that are told of a run where they differ.
_OPTIONS = (
    "controller",
    "observer",
    "ref",
    "model",
    "plant",
    "effects",
    "faults",
    "supervisor",
    "recording",
    "loop",
)
#: Keys that tell where files go, and what is drawn: nothing of what was run.
_NO_KEYS = frozenset({"out", "picture", "sim.prediction_every"})
#: The key of a model's file, by which models of one name are told apart.
_MODEL_FILE = "model.path"


def _page_figures(extra: Iterable[str] = ()) -> list[str]:
    """Figures of a page, those that say most first, by the names of ``trms runs``.

    ``extra``: what there is of other channels than the twin rotor's.
    """
    from trms_cli.runs.columns import expanded
    from trms_cli.scoring.figures import of_group

    short = [f for f in of_group("channels") if f.short]
    names = [f.column_name for f in short[:1]]
    names += [f"{f.column_name}_{axis}" for f in short for axis in ("yaw", "pitch")]
    names += expanded((f"{f.column_name}_*" for f in short), extra)
    names += [f.column_name for f in of_group("inputs") if f.total]
    names += [f.column_name for f in of_group("solver") if f.key != "objective_total"]
    names += [f.column_name for f in of_group("run")]
    names += [f.column_name for f in of_group("estimate") if f.short]
    return [*names, "duration"]


#: What a page and its ranking read of a run beside its figures.
_ABOUT = (
    *("path", "log", "time", "command", "outcome", "complete", "problem", *_OPTIONS, "seed"),
    *("version", "overrides", "choices"),
)


def rows_of(folders: Sequence[Path], *, quiet: bool = False) -> QueryResult:
    """The runs in folders, as ``trms runs`` has them; logs that are new are read.

    Of each what a page tells of it, and no more: there may be a hundred thousand.
    """
    from trms_cli.reporting.progress import ReadingProgress
    from trms_cli.runs.columns import ALIASES, COLUMNS
    from trms_cli.runs.query import Query, find
    from trms_cli.scoring.comparison.runs import FIGURE_COLUMNS
    from trms_cli.scoring.figures import of_group

    plan = sweep_document(folders[0]) if len(folders) == 1 else {}
    sought = [o.figure for o in summary.objectives_of(summary.search_of(plan))]
    of_others = [f"{f.column_name}_*" for f in of_group("channels") if f.short]
    figures = [ALIASES.get(name, name) for name in (*sought, *_page_figures(), *FIGURE_COLUMNS)]
    # Of a figure that no run may have all that begin with its name are asked for.
    figures = [name if name in COLUMNS else f"{name}*" for name in figures]
    columns = tuple(dict.fromkeys([*_ABOUT, *figures, *of_others]))
    question = Query(
        folders=tuple(folders), sort="path", descending=False, columns=columns, compact=True
    )
    with ReadingProgress(quiet=quiet) as progress:
        result = find(question, progress)
    assert isinstance(result.runs, Rows)
    return replace(result, runs=_completed(result.runs))


def read_sweep(
    folders: Sequence[Path],
    result: QueryResult,
    page_folder: Path,
    typed: Sequence[Mapping[str, Any]] | None = None,
    *,
    address: Callable[[str], str] | None = None,
) -> SweepReport:
    """Many runs in folders, by their rows in `result`, as a report sees them.

    `typed`: their :func:`typed_values`, where they are known. `page_folder`: where the page will
    be, for links to reports of single runs; `address`: where those are instead, by a run's log.
    """
    from trms_cli.reporting.sweep_report import SweepReport

    rows = result.runs
    plan = sweep_document(folders[0]) if len(folders) == 1 else {}
    words = summary.search_of(plan)
    objectives = summary.objectives_of(words)
    typed = typed_values(rows) if typed is None else typed
    keys = keys_of(rows, typed, summary.drawn_keys(plan))
    draw_keys = [key for key in summary.drawn_keys(plan) if key in keys]
    others = [key for key in keys if key not in draw_keys]
    by = _entrant_keys(others)
    named = summary.short_names(draw_keys, others)
    root = _root(rows, folders)
    figures, total = _figures(result, objectives), plan.get("total")
    runs = _runs(rows, typed, keys, by, figures, named, root, page_folder, address)
    return SweepReport(
        name=_name(folders, root),
        runs=runs,
        keys=[*others, *named.values()],
        figures=figures,
        objectives=objectives,
        pareto=summary.pareto_of(words),
        trials=summary.trials_of(words),
        history=summary.history_of(words),
        planned_count=total if isinstance(total, int) and not isinstance(total, bool) else None,
        draws=summary.draws_of(plan, named),
        left_out=[*result.unreadable],
        facts=_facts(folders, plan, rows),
    )


def from_scores(gathered: RunCollection, folders: Sequence[Path]) -> SweepReport:
    """Runs of which there are scores alone, without a log."""
    from trms_cli.reporting.sweep_report import SweepReport, SweepRun
    from trms_cli.runs.columns import ALIASES, COLUMNS, figures_of, units_of
    from trms_cli.scoring.comparison.ranking import controller_name, usual_entrants
    from trms_cli.scoring.comparison.runs import differing_coordinates

    scored_runs = list(gathered.runs)
    keys = differing_coordinates(scored_runs)[:_MOST_KEYS]
    by = usual_entrants(keys)
    others = {n: unit for run in scored_runs for n, unit in units_of(run.score or {}).items()}
    page_figures = _page_figures(name for name in others if name not in COLUMNS)
    units = {
        name: others[name] if name in others else COLUMNS[ALIASES.get(name, name)].unit
        for name in page_figures
    }
    root = folders[0].resolve() if len(folders) == 1 else Path.cwd()
    runs = []
    for run in scored_runs:
        all_figures = figures_of(run.score or {})
        figures = {
            name: value
            for name in units
            if (value := all_figures.get(ALIASES.get(name, name))) is not None
        }
        runs.append(
            SweepRun(
                name=_relative(run.path, str(root)),
                entrant=controller_name(run.coordinates, [key for key in by if key in keys]),
                outcome={"done": "completed"}.get(run.state.value, run.state.value),
                values={key: _number_or_text(run.coordinates.get(key)) for key in keys},
                figures=figures,
                problem=run.message[:_LONGEST_PROBLEM],
            )
        )
    present = {name for run in runs for name in run.figures}
    return SweepReport(
        name=_name(folders, root),
        runs=runs,
        keys=keys,
        figures={name: unit for name, unit in units.items() if name in present},
        left_out=gathered.left_out,
        facts={
            "folder": ", ".join(map(str, folders)),
            "runs": f"{len(runs)}, of which there are scores alone",
        },
    )


def sweep_document(folder: Path) -> Mapping[str, Any]:
    """What a sweep says of itself (``sweep.json``); empty where it does not, or is of others."""
    try:
        with (folder / SWEEP_NAME).open("rb") as file:
            document = json.loads(file.read(_LONGEST_PLAN))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(document, Mapping):
        return {}
    return document if str(document.get("schema", "")).startswith(_SWEEP_SCHEMA) else {}


def _figures(result: QueryResult, objectives: Sequence[Objective]) -> dict[str, str]:
    """Figures that some run has, with their units."""
    from trms_cli.runs.columns import ALIASES, COLUMNS

    others = [name for name in result.columns if name not in COLUMNS]
    figure_names = dict.fromkeys([*(o.figure for o in objectives), *_page_figures(others)])
    units = {}
    for name in figure_names:
        column = ALIASES.get(name, name)
        if any(value is not None for value in column_of(result.runs, column)):
            units[name] = result.columns[column].unit if column in result.columns else ""
    return units


def keys_of(
    rows: Sequence[Mapping[str, Any]], typed: Sequence[Mapping[str, Any]], last: Sequence[str] = ()
) -> list[str]:
    """Options and typed keys in which runs differ; `last` behind the others, in their order."""
    keys = [o for o in _OPTIONS if len({value or "" for value in column_of(rows, o)}) > 1]
    every = dict.fromkeys(key for values in typed for key in values)
    for key in every:
        stem = key.partition("@")[0]
        is_option = stem in ("effect", "fault") or (key in _OPTIONS and "." not in key)
        if key in _NO_KEYS or is_option or key == "seed":
            continue
        if len({str(values.get(key)) for values in typed}) > 1:
            keys.append(key)
    if len(set(column_of(rows, "seed"))) > 1:
        keys.append("seed")
    places = {key: i for i, key in enumerate(last, start=1)}
    return sorted(keys, key=lambda key: places.get(key, 0))[:_MOST_KEYS]


def _entrant_keys(keys: Sequence[str]) -> tuple[str, ...]:
    from trms_cli.scoring.comparison.ranking import OF_ENTRANTS, usual_entrants

    # A setting with a number of its own for each run names no entrant, but a point in a range.
    own = [key for key in keys if "." not in key or key == _MODEL_FILE]
    return usual_entrants([key for key in own if re.split(r"[.@]", key)[0] in OF_ENTRANTS])


def _runs(
    rows: Sequence[Mapping[str, Any]],
    typed: Sequence[Mapping[str, Any]],
    keys: Sequence[str],
    by: Sequence[str],
    figures: Iterable[str],
    named: Mapping[str, str],
    root: Path,
    page_folder: Path,
    address: Callable[[str], str] | None,
) -> list[SweepRun]:
    """The runs of rows by their numbers; of a hundred thousand, so that columns are taken whole."""
    from trms_cli.reporting.page import MOST_ROWS
    from trms_cli.reporting.sweep_report import SweepRun
    from trms_cli.runs.columns import ALIASES

    values = {key: values_of(rows, typed, key) for key in dict.fromkeys((*keys, *by))}
    value_rows = zip(*(values[key] for key in keys), strict=True) if keys else repeat(())
    who_rows = zip(*(values[key] for key in by), strict=True) if by else repeat(())
    page_keys = [named.get(key, key) for key in keys]
    columns = {name: column_of(rows, ALIASES.get(name, name)) for name in figures}
    places = {name: place for place, name in enumerate(columns)}
    figure_rows = zip(*columns.values(), strict=True) if columns else repeat(())
    paths, *about = [column_of(rows, name) for name in ("path", "log", "outcome", "problem")]
    in_order = list(
        zip(map(_number, paths), paths, *about, value_rows, who_rows, figure_rows, strict=False)
    )
    in_order.sort(key=lambda cells: (cells[0] is None, cells[0] or 0))
    stem, page_place, who = str(root), str(page_folder), tuple(by)
    runs: list[SweepRun] = []
    for number, path, log, outcome, problem, own, ran, cells in in_order:
        folder, page = log.rpartition(os.sep)[0], ""
        if address is not None:
            page = address(log)
        elif len(runs) < MOST_ROWS and folder != page_place:  # others stand in no table
            report = f"{folder}{os.sep}{PAGE_NAME}"
            page = relative_link(report, page_place) if os.path.isfile(report) else ""
        runs.append(
            SweepRun(
                name=_relative(path, stem),
                entrant=_entrant(who, ran),
                outcome=str(outcome or "unfinished"),
                values=dict(zip(page_keys, own, strict=True)),
                figures=RowFigures(places, cells),
                problem=str(problem or "")[:_LONGEST_PROBLEM],
                page=page,
                number=number,
            )
        )
    return runs


def _number(path: str) -> int | None:
    """The number that a run's folder is called by; None for another name."""
    name = path.rpartition(os.sep)[2]
    return int(name) if name.isascii() and name.isdigit() else None


@lru_cache(maxsize=4096)
def _entrant(by: tuple[str, ...], values: tuple[Value, ...]) -> str:
    from trms_cli.scoring.comparison.ranking import controller_name

    texts = [str(value or "–") for value in values]
    return controller_name(dict(zip(by, texts, strict=True)), by)


class RowFigures(Row):
    """The figures that a row has, by the names of a page: nothing is copied out of it."""

    __slots__ = ()

    def __getitem__(self, name: str) -> float:
        value = self.cells[self.places[name]]
        if value is None:
            raise KeyError(name)
        return float(value)

    def get(self, name: str, default: Any = None) -> Any:
        """The figure, or what else is said."""
        place = self.places.get(name)
        value = None if place is None else self.cells[place]
        return default if value is None else float(value)

    def __contains__(self, name: object) -> bool:
        return self.get(str(name)) is not None

    def __iter__(self) -> Iterator[str]:
        return (name for name, place in self.places.items() if self.cells[place] is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def relative_link(target: str, folder: str) -> str:
    """A file's address from a folder, as a link: never one of another kind than of a file."""
    path = os.path.relpath(target, folder)
    return "./" + quote(path.encode("utf-8", "surrogateescape"))


def _completed(rows: Rows) -> Rows:
    """Rows in which a job that left no log has the usual option of each group it does not name."""
    usual: dict[int, Any] = {}
    for key in (*_OPTIONS, "seed"):
        counts = Counter(column_of(rows, key))
        named = [(value, count) for value, count in counts.items() if value not in (None, "")]
        if named:
            usual[rows.places[key]] = max(named, key=lambda item: item[1])[0]
    completed = list(rows.cells)
    for number, log in enumerate(column_of(rows, "log")):
        if str(log).endswith(STATUS_NAME):
            cells = list(completed[number])
            for place, value in usual.items():
                cells[place] = value if cells[place] in (None, "") else cells[place]
            completed[number] = tuple(cells)
    return Rows(rows.places, completed)


def values_of(
    rows: Sequence[Mapping[str, Any]], typed: Sequence[Mapping[str, Any]], key: str
) -> list[Value]:
    """What each run has for an option, or for a key that was typed; None for nothing."""
    is_column = bool(rows) and key in rows[0]
    values = column_of(rows, key) if is_column else [values.get(key) for values in typed]
    return [
        value if isinstance(value, (str, int, float)) or value is None else str(value)
        for value in values
    ]


def typed_values(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Values that were typed for each run, by their dotted keys.

    Where one name stands for several model files, their paths too, as a comparison has them.
    """
    from trms_cli.scoring.comparison.runs import FlatConfiguration, differing_settings

    typed = [_typed_of(row) for row in rows]
    files = [_model_file(row, values) for row, values in zip(rows, typed, strict=True)]
    if not any(files):
        return typed
    settings = differing_settings(rows, [FlatConfiguration(own) for own in files])
    return [{**values, **own} for values, own in zip(typed, settings, strict=True)]


def _model_file(row: Mapping[str, Any], typed: Mapping[str, Any]) -> dict[str, str]:
    path = typed.get(_MODEL_FILE)
    if path is None:
        if not any(key.startswith("model") for key in typed):
            return {}
        choices = json_or_none(row.get("choices"))
        path = typed_files(choices if isinstance(choices, Mapping) else {}, typed).get("model")
    return {} if path is None else {_MODEL_FILE: str(Path(path).expanduser())}


def _typed_of(row: Mapping[str, Any]) -> dict[str, Any]:
    from trms_cli.runs.entry import typed_overrides

    text = row.get("overrides")
    try:
        words = msgspec.json.decode(text or "null")
    except (msgspec.DecodeError, RecursionError):
        words = json_or_none(text)
    return typed_overrides([str(word) for word in words]) if isinstance(words, list) else {}


def _facts(
    folders: Sequence[Path], plan: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
) -> dict[str, str]:
    facts = {"folder": ", ".join(map(str, folders)), "runs": str(len(rows))}
    command = plan.get("command")
    if not isinstance(command, str):
        commands = set(filter(None, column_of(rows, "command")))
        run_command = str(next(iter(commands))) if len(commands) == 1 else ""
        # A sweep by Hydra names its own settings too, which nobody typed.
        command = run_command.partition(" 'hydra.")[0].partition(" hydra")[0]
    if command:
        facts["command"] = f"`{command[:2000].replace('`', chr(39))}`"
    times = [str(time) for time in column_of(rows, "time") if time]
    if times:
        first, last = min(times), max(times)
        facts["begun"] = first if first == last else f"{first} to {last} UTC"
    versions = sorted({str(version) for version in column_of(rows, "version") if version})
    if versions:
        facts["version"] = ", ".join(versions)
    return facts


def _root(rows: Sequence[Mapping[str, Any]], folders: Sequence[Path]) -> Path:
    if len(folders) == 1:
        return folders[0].resolve()
    paths = [str(row["path"]) for row in rows]
    return Path(os.path.commonpath(paths)) if paths else Path.cwd()


def _name(folders: Sequence[Path], root: Path) -> str:
    """What many runs are called: by their folders."""
    if len(folders) > 1:
        return listing([folder.resolve().name for folder in folders], most=4)
    return root.name or str(root)


def _relative(path: str, root: str) -> str:
    stem = f"{root}{os.sep}"
    if path.startswith(stem) and f"{os.sep}." not in path and os.sep * 2 not in path:
        return path[len(stem) :].rstrip(os.sep) or os.path.basename(root)
    relative_path = os.path.relpath(os.path.abspath(path), root)
    return os.path.basename(root) if relative_path == "." else relative_path


def _number_or_text(text: str | None) -> Value:
    if text is None:
        return None
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
