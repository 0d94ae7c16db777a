"""The columns worth showing of runs that are listed: in a terminal, and on a page."""

import json
from collections.abc import Sequence

from trms_cli.runs.columns import ALIASES, IndexColumn
from trms_cli.runs.entry import typed_overrides
from trms_cli.runs.query import QueryResult

#: Read with the usual columns, for the settings in which runs differ; not shown itself.
OVERRIDES = "overrides"
_MOST_SETTINGS = 6
#: Columns of the table, in their order.
USUAL = (
    "path",
    "time",
    "controller",
    "observer",
    "ref",
    "model",
    "plant",
    "effects",
    "faults",
    "seed",
    "duration",
    "outcome",
    "rmse_alpha_v",
    "rmse_alpha_h",
    "rmse_*",
    "total_variation",
    "solve_p99",
    "failures",
    "deadline_misses",
)
#: Worth a column only where runs differ in them.
_IF_DIFFERENT = frozenset(USUAL) - {
    "path",
    "time",
    "controller",
    "rmse_alpha_v",
    "rmse_alpha_h",
    "total_variation",
    "solve_p99",
}
HEADINGS = {
    "path": "run",
    "rmse_alpha_v": "rmse pitch",
    "rmse_alpha_h": "rmse yaw",
    "total_variation": "Σ|Δu|",
    "solve_p99": "step p99",
    "deadline_misses": "misses",
}


def visible_columns(result: QueryResult, mentioned_columns: Sequence[str]) -> list[str]:
    """The columns worth showing: those asked for, and the usual ones that say something."""
    requested_names = {ALIASES.get(name, name) for name in mentioned_columns}
    names_by_column: dict[str, str] = {}  # by the column's own name: an alias is shown once
    for name in result.columns:
        own = ALIASES.get(name, name)
        if own in names_by_column or (own == OVERRIDES and own not in requested_names):
            continue
        values = {run[name] for run in result.runs}
        same = len(values - {None}) < 2 and own in _IF_DIFFERENT
        usual_end = own == "outcome" and values == {"completed"}
        empty = values <= {None, ""}
        if own in requested_names or not (same or usual_end or empty):
            names_by_column[own] = name
    return list(names_by_column.values())


#: What nobody typed: a sweep gives it to its runs.
_SET_BY_SWEEPS = ("picture", "sim.scene_every", "sim.estimate_every")


def differing_keys(result: QueryResult, names: Sequence[str]) -> list[str]:
    """Keys that were typed, and in which the runs differ: else the runs of a sweep look alike."""
    overrides = [typed_overrides(json.loads(run.get(OVERRIDES) or "[]")) for run in result.runs]
    settings = []
    for key in dict.fromkeys(key for keys in overrides for key in keys):
        own = ALIASES.get(key, key)
        values = {str(keys.get(key)) for keys in overrides}
        if (
            key not in _SET_BY_SWEEPS
            and ("." in key or "@" in key)
            and own not in result.columns
            and len(values) > 1
        ):
            settings.append(key)
            result.columns[key] = IndexColumn(key, "any")
            for run, keys in zip(result.runs, overrides, strict=True):
                run[key] = keys.get(key)
    return [key for key in settings if key not in names][:_MOST_SETTINGS]
