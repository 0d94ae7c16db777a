"""The columns of the index: their names, what they mean, and where a score has them.

Figures of a channel or an input are named ``<figure>_<channel>``: ``rmse_alpha_h``,
``effort_u_v``. Those of the twin rotor's two angles and two inputs are columns of the database;
those of other channels, and the errors of estimates, are kept beside them by the same rule and
can be asked for in the same way, with the units that such channels have.
"""

import difflib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from trms_cli.scoring import figures

Kind = Literal["text", "number", "whole", "truth", "any"]


@dataclass(frozen=True)
class IndexColumn:
    """A column."""

    name: str
    #: ``text``, ``number``, ``whole`` (a whole number), ``truth``; ``any`` for what may be each of
    #: them, as the values that were typed on a command line
    kind: Kind
    unit: str = ""  #: Of SI; "" for text and counts
    about: str = ""  #: What it is

    @property
    def is_number(self) -> bool:
        """Whether it holds numbers, whole or not."""
        return self.kind in ("number", "whole")


_CHANNELS = ("alpha_v", "alpha_h")
_INPUTS = ("u_v", "u_h")


def figure_stems() -> list[str]:
    """What figures of channels, inputs and states begin with: ``rmse`` of ``rmse_alpha_h``."""
    return [f.column_name for f in figures.of_group("channels", "inputs", "states")]


_OF_RUN = (
    IndexColumn("path", "text", "", "folder of the run, or its log if that has another name"),
    IndexColumn("log", "text", "", "the log's file, or the status of a job that left no log"),
    IndexColumn("time", "text", "UTC", "when it began, as 2025-01-31 12:00:00"),
    IndexColumn("command", "text", "", "what was typed"),
    IndexColumn(
        "outcome", "text", "", "completed, interrupted, failed, or unfinished: killed or running"
    ),
    IndexColumn("complete", "truth", "", "it ran to its end"),
    IndexColumn("problem", "text", "", "why a job of a sweep left no log"),
    IndexColumn("controller", "text", "", "option chosen"),
    IndexColumn("observer", "text", "", "option chosen"),
    IndexColumn("ref", "text", "", "option chosen"),
    IndexColumn("model", "text", "", "what controller and observer believe"),
    IndexColumn("plant", "text", "", "option chosen"),
    IndexColumn("supervisor", "text", "", "option chosen"),
    IndexColumn("experiment", "text", "", "option chosen"),
    IndexColumn("effects", "text", "", "joined by +; empty without any"),
    IndexColumn("faults", "text", "", "joined by +; empty without any"),
    IndexColumn("recording", "text", "", "file that was replayed"),
    IndexColumn("loop", "text", "", "closed or open"),
    IndexColumn("seed", "whole", "", "of the random numbers"),
    IndexColumn("duration", "number", "s", "time simulated or replayed"),
    IndexColumn("sample_time", "number", "s", "of the loop (sim.sample_time)"),
    IndexColumn("took", "number", "s", "from the log's beginning to its end by the clock"),
)
_TOTALS = {
    ("channels", "sum"): "sum over the channels, as `trms compare` ranks",
    ("inputs", "sum"): "sum over the inputs",
    ("inputs", "largest"): "of the input that was longest at a limit",
}
_UNITS = {"channels": "rad", "inputs": "V"}


def _of_figure(figure: figures.Figure, name: str, about: str = "") -> IndexColumn:
    kind: Kind = "whole" if figure.whole else "number"
    unit = figure.unit_of(_UNITS.get(figure.group, ""))
    if not unit and figure.group in _UNITS and not figure.whole:
        unit = "1"
    return IndexColumn(name, kind, unit, about or figure.about or figure.label)


_OF_SCORE = (
    *(
        _of_figure(figure, figure.column_name, _TOTALS[figure.group, figure.total])
        for figure in figures.of_group("channels", "inputs")
        if figure.total
    ),
    *(
        _of_figure(figure, figure.column_name)
        for figure in figures.of_group("solver", "run", "estimate")
    ),
)
_OF_ORIGIN = (
    IndexColumn("git", "text", "", "revision of the working folder"),
    IndexColumn("version", "text", "", "of trms"),
    IndexColumn("platform", "text", "", "where it ran"),
    IndexColumn("versions", "text", "", "of what computes, as JSON"),
    IndexColumn("overrides", "text", "", "what was typed as KEY=VALUE, as JSON"),
    IndexColumn("choices", "text", "", "option of each group, as JSON"),
)
_OF_CHANNELS = tuple(
    _of_figure(figure, f"{figure.column_name}_{name}")
    for group, names in (("channels", _CHANNELS), ("inputs", _INPUTS))
    for figure in figures.FIGURES
    if figure.group == group
    for name in names
)

#: Every column, in the order in which a frame has them.
COLUMNS: dict[str, IndexColumn] = {
    column.name: column for column in (*_OF_RUN, *_OF_SCORE, *_OF_CHANNELS, *_OF_ORIGIN)
}

_OTHER_NAMES = {
    "effect": "effects",
    "fault": "faults",
    "reference": "ref",
    "sim.duration": "duration",
    "sim.sample_time": "sample_time",
    "started": "time",
    "plant.file": "recording",
}
_ENDINGS = {"_yaw": "_alpha_h", "_pitch": "_alpha_v", "_main": "_u_v", "_tail": "_u_h"}
#: Other names of columns, as they are said at the bench: ``rmse_yaw``.
ALIASES: dict[str, str] = _OTHER_NAMES | {
    name.removesuffix(ending) + said: name
    for said, ending in _ENDINGS.items()
    for name in COLUMNS
    if name.endswith(ending)
}


def figures_of(score: Mapping[str, Any]) -> dict[str, float | None]:
    """The figures of a score by their names here, of every channel and input that it has.

    ``score``: ``trms.score/1``, also one of an older version, or one that holds what it should not:
    what is no finite number is None.
    """
    values: dict[str, float | None] = {"duration": figures.finite(score.get("duration_s"))}
    members: dict[figures.Figure, list[float | None]] = {
        f: [] for f in figures.of_group("channels", "inputs") if f.total
    }
    for entry in figures.entries(score):
        figure = entry.figure
        if figure.group != "constraint_violations":
            name = f"{figure.column_name}_{entry.of}" if entry.of else figure.column_name
            values[name] = entry.value
        if figure in members:
            members[figure].append(entry.value)
    for figure, own in members.items():
        finite_values = [value for value in own if value is not None]
        largest = max(finite_values, default=None)
        values[figure.column_name] = figures.total(own) if figure.total == "sum" else largest
    return values


def units_of(score: Mapping[str, Any]) -> dict[str, str]:
    """Units of figures of channels and inputs that the twin rotor does not have, and of totals."""
    units: dict[str, str] = {}
    for entry in figures.entries(score, "channels", "inputs"):
        stem, name = entry.figure.column_name, f"{entry.figure.column_name}_{entry.of}"
        if name not in COLUMNS:
            units[name] = entry.unit
            if entry.figure.total:
                units[stem] = entry.unit if units.get(stem, entry.unit) == entry.unit else ""
    return units


def expanded(names: Iterable[str], extra: Iterable[str]) -> list[str]:
    """Columns with ``*`` for all, and ``rmse_*`` for those of other channels than the twin rotor's.

    ``extra``: names that some runs have beside the columns.
    """
    stems = tuple(f"{figure.column_name}_" for figure in figures.of_group("channels", "inputs"))
    others = [name for name in extra if name.startswith(stems)]
    result: list[str] = []
    for name in names:
        within = [n for n in others if n.startswith(name[:-1])] if name.endswith("*") else [name]
        result += [*COLUMNS, *within] if name == "*" else within
    return list(dict.fromkeys(result))


@dataclass(frozen=True)
class Sql:
    """A part of a statement."""

    text: str  #: With ``?`` for each value
    values: tuple[Any, ...] = ()  #: To be bound, in their order


def column_sql(name: str, extra: Collection[str] | None = ()) -> tuple[IndexColumn, Sql] | None:
    """A column by any of its names, and the SQL that reads it; None if there is none.

    A name with a dot is a key that was typed: ``plant.prior_seed``.
    """
    name = ALIASES.get(name, name)
    if name in COLUMNS:
        return COLUMNS[name], Sql(f'"{name}"')
    renamed = name
    for said, ending in (("_yaw", "_alpha_h"), ("_pitch", "_alpha_v")):
        renamed = renamed.removesuffix(said) + ending if name.endswith(said) else renamed
    if _may_be_figure(renamed) if extra is None else renamed in extra:
        return IndexColumn(renamed, "number"), Sql("json_extract(more, ?)", (_json_path(renamed),))
    if "." in name:
        return IndexColumn(name, "any"), Sql("json_extract(typed, ?)", (_json_path(name),))
    return None


def nearest(name: str, extra: Collection[str] | None = ()) -> str:
    """What may have been meant, as a sentence."""
    names = [*COLUMNS, *ALIASES, *(extra or ())]
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.6)
    if close:
        return f"did you mean {' or '.join(close)}? all columns: trms runs --help"
    return "all columns: trms runs --help; a key that was typed has its dots: plant.prior_seed"


def _may_be_figure(name: str) -> bool:
    return any(name.startswith(f"{stem}_") for stem in figure_stems())


def _json_path(key: str) -> str:
    escaped = key.replace("\\", "\\\\").replace('"', '\\"')
    return f'$."{escaped}"'
