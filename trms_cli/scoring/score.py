"""The score of a run: one document of the schema ``trms.score/1``.

What does not exist in a run is null, never a number made up: a sine has no settling time, a real
rig no estimation error. Beside the keys of the schema, channels say how many steps they had
(``steps``), how many did not settle (``unsettled_steps``), the medians over steps, and whether
they were scored on the true ``state`` or on the ``measurement`` (``scored_on``): a simulated
rig's true state is taken where the log has it, since a sensor's noise is not the controller's
error. ``estimate`` also has ``nees_expected`` (the mean of a consistent filter) and
``prediction_rmse`` (one step ahead, per output), which exist for replayed recordings too, and the
``units`` of both; its ``innovations`` hold, per output, the mean of (ν/σ)² and the correlation of
each innovation with the next: how much it is that ``innovation_whiteness_p`` finds. ``degraded``
says how much of the run the loop was not normal, and why (:mod:`trms_cli.scoring.degraded`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core.data_file import not_as_written
from trms_cli.scoring import figures, metrics, step_response
from trms_cli.scoring.degraded import degraded_figures
from trms_cli.scoring.estimate import estimate_figures
from trms_cli.scoring.metrics import Array
from trms_cli.scoring.tables import Columns, floats, held, unit
from trms_cli.scoring.tables import Series as Series

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import LoggedRun

SCHEMA = "trms.score/1"
#: Key of the log's ``trms.run`` record with the limits as JSON: ``{"u_v": [-2.5, 2.5], …}``.
LIMITS_KEY = "limits"
Limits = Mapping[str, tuple[float, float]]


def score_log(log: LoggedRun, *, limits: Limits | None = None) -> dict[str, Any]:
    """Score a log, complete or not.

    Parameters
    ----------
    log : LoggedRun
        As :func:`trms_cli.recordings.log_reader.read_log` gives it.
    limits : mapping, optional
        Lower and upper limit by input or channel; by default those written in the log.
    """
    with not_as_written(str(log.path)):
        return score_tables(
            log.tables,
            limits=limits_of(log) if limits is None else limits,
            duration_s=log.duration_s,
            log=str(log.path),
            complete=log.complete,
        )


def limits_of(log: LoggedRun) -> dict[str, tuple[float, float]]:
    """The limits that a run wrote into its log; none if it wrote none."""
    given = json.loads(log.run.get(LIMITS_KEY, "{}"))
    return {
        name: (
            -math.inf if low is None else float(low),
            math.inf if high is None else float(high),
        )
        for name, (low, high) in given.items()
    }


def score_tables(
    tables: Mapping[str, Columns],
    *,
    limits: Limits,
    duration_s: float,
    log: str = "",
    complete: bool = True,
) -> dict[str, Any]:
    """Score signals by topic: the core, which needs no file.

    Parameters
    ----------
    tables : mapping of str to Columns
        By topic, with the fields of a log: ``/reference``, ``/command``, ``/measurement``,
        ``/plant/state``, ``/estimate``, ``/controller``. Any of them may be absent.
    limits : mapping of str to (float, float)
        Lower and upper limit of inputs and channels, in their units.
    duration_s : float
        Length of the run.
    log : str
        Path for the document.
    complete : bool
        Whether the run ended as it was meant to.

    Returns
    -------
    dict
        ``trms.score/1``; only text, numbers, truth values, None, lists and dicts.
    """
    document = {
        "schema": SCHEMA,
        "log": log,
        "complete": complete,
        "duration_s": duration_s,
        "channels": _channels(tables),
        "inputs": _inputs(tables, limits),
        "estimate": estimate_figures(tables),
        "solver": _solver(tables),
        "constraint_violations": _violations(tables, limits),
        "degraded": _degraded(tables),
    }
    return _without_nan(document)


@dataclass(frozen=True)
class Tracked:
    """A channel that was to follow a reference, as the figures of channels take it."""

    time: Array  #: (n,) s
    wanted: Array  #: (n,) reference
    response: Array  #: (n,) what it did; NaN where no sample is

    @cached_property
    def error(self) -> Array:
        """(n,) reference minus response."""
        return self.wanted - self.response

    @cached_property
    def steps(self) -> list[step_response.StepMetrics]:
        """Of the reference, in order; ``inf`` for what did not happen."""
        return step_response.steps(self.time, self.wanted, self.response)

    @cached_property
    def steady_state_error(self) -> float:
        """Mean over the last part of each hold."""
        return step_response.steady_state_error(self.time, self.wanted, self.response)


@dataclass(frozen=True)
class Applied:
    """An input as it was applied, as the figures of inputs take it."""

    time: Array  #: (n,) s
    command: Array  #: (n,)
    limits: tuple[float, float] | None  #: None where the log tells none


def _channels(tables: Mapping[str, Columns]) -> dict[str, Any]:
    reference = tables.get("/reference")
    if reference is None or len(reference.time) == 0:
        return {}
    scored = {}
    for name in reference.columns:
        source = _source_of(name, tables)
        if source is None:
            continue
        table, time = tables[source], reference.time
        signals = Tracked(time, floats(reference, name), held(table, name, time))
        if np.all(np.isnan(signals.wanted)) or np.all(np.isnan(signals.response)):
            continue
        scored[name] = _computed("channels", signals) | {
            "unit": unit(table, name),
            "scored_on": "state" if source == "/plant/state" else "measurement",
        }
    return scored


def _inputs(tables: Mapping[str, Columns], limits: Limits) -> dict[str, Any]:
    command = tables.get("/command")
    if command is None:
        return {}
    scored = {}
    for name in command.columns:
        signals = Applied(command.time, floats(command, name), limits.get(name))
        scored[name] = _computed("inputs", signals) | {"unit": unit(command, name)}
    return scored


def _computed(group: figures.Group, signals: Tracked | Applied) -> dict[str, Any]:
    """The figures of a channel or an input, by their keys."""
    return {
        figure.key: figure.of(metrics, signals)
        for figure in figures.of_group(group)
        if figure.of is not None
    }


def _solver(tables: Mapping[str, Columns]) -> dict[str, Any]:
    words = tables.get("/controller")
    columns: Mapping[str, Any] = words.columns if words is not None else {}

    def present(name: str) -> Array:
        values = np.asarray(columns.get(name, ()), dtype=float)
        return values[~np.isnan(values)]

    milliseconds = 1e3 * present("solve_time_s")
    missed, iterations = present("deadline_missed"), present("iterations")
    objective = present("objective")
    return {
        "time_ms": {
            "median": float(np.median(milliseconds)) if milliseconds.size else math.nan,
            "p99": float(np.percentile(milliseconds, 99)) if milliseconds.size else math.nan,
            "max": float(np.max(milliseconds)) if milliseconds.size else math.nan,
        },
        "deadline_misses": int(np.sum(missed > 0)) if missed.size else None,
        "iterations_mean": float(np.mean(iterations)) if iterations.size else math.nan,
        "failures": _failures(columns),
        "objective_total": float(np.sum(objective)) if objective.size else math.nan,
    }


def _degraded(tables: Mapping[str, Columns]) -> dict[str, Any] | None:
    words = tables.get("/controller")
    return None if words is None else degraded_figures(words.time, words.columns)


def _failures(columns: Mapping[str, Any]) -> int | None:
    """Samples on which the solver failed or a fall-back acted."""
    if "status" not in columns and "fallback" not in columns:
        return None
    failed = np.asarray(columns.get("status", ()), dtype=object) == "failed"
    acted = np.nan_to_num(np.asarray(columns.get("fallback", ()), dtype=float)) > 0
    if failed.size and acted.size:
        return int(np.count_nonzero(failed | acted))
    return int(np.count_nonzero(failed) + np.count_nonzero(acted))


def _violations(tables: Mapping[str, Columns], limits: Limits) -> dict[str, Any]:
    """Samples outside the limits, and by how much at worst, per channel that has limits."""
    found = {}
    for name, (lower, upper) in limits.items():
        command = tables.get("/command")
        is_input = command is not None and name in command.columns
        source = "/command" if is_input else _source_of(name, tables)
        if source is None:
            continue
        beyond = metrics.excess(floats(tables[source], name), lower, upper)
        if beyond.size:
            # rounding at a limit that is reached exactly is no violation
            tolerance = 1e-9 * (1.0 + min(abs(lower), abs(upper)))
            found[name] = {
                "samples": int(np.sum(beyond > tolerance)),
                "worst": float(np.max(beyond)) if np.max(beyond) > tolerance else 0.0,
                "unit": unit(tables[source], name),
            }
    return found


def _source_of(name: str, tables: Mapping[str, Columns]) -> str | None:
    """The topic that tells a channel best: the true state, else the measurement."""
    for topic in ("/plant/state", "/measurement"):
        table = tables.get(topic)
        if table is not None and name in table.columns and len(table.time):
            return topic
    return None


def _without_nan(value: Any) -> Any:
    """The same document with null for what is not a finite number."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
