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
says how much of the run the loop was not normal, and why (:func:`degraded_figures`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core.data_file import not_as_written
from trms_cli.core.findings import json_data
from trms_cli.recordings.topics import ESTIMATE_TOPIC, THINNED_KEY
from trms_cli.scoring import figures, metrics
from trms_cli.scoring.metrics import Array, Columns, floats, hold_at, unit
from trms_cli.scoring.metrics import Series as Series
from trms_cli.simulation.pace import IN_TIME

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import LoggedRun

SCHEMA = "trms.score/1"
#: Key of the log's ``trms.run`` record with the limits as JSON: ``{"u_v": [-2.5, 2.5], …}``.
LIMITS_KEY = "limits"
Limits = Mapping[str, tuple[float, float]]


def score_log(log: LoggedRun) -> dict[str, Any]:
    """Score a log, complete or not, by the limits that are written in it.

    Where only some of the estimates are in the log, what they say is taken from the score that was
    made of all of them as the run ended; it is missing where there is none.
    """
    with not_as_written(str(log.path)):
        is_thinned = ESTIMATE_TOPIC in json.loads(log.run.get(THINNED_KEY, "{}"))
        tables = {k: v for k, v in log.tables.items() if not (is_thinned and k == ESTIMATE_TOPIC)}
        score = score_tables(
            tables,
            limits=limits_of(log),
            duration_s=log.duration_s,
            log=str(log.path),
            complete=log.complete,
        )
        if is_thinned and log.score.get("estimate"):
            score["estimate"] = log.score["estimate"]
        return score


def limits_of(log: LoggedRun) -> dict[str, tuple[float, float]]:
    """The limits that a run wrote into its log; none if it wrote none."""
    limits = json.loads(log.run.get(LIMITS_KEY, "{}"))
    return {
        name: (
            -math.inf if low is None else float(low),
            math.inf if high is None else float(high),
        )
        for name, (low, high) in limits.items()
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

    ``tables``: by topic, with the fields of a log: ``/reference``, ``/command``, ``/measurement``,
    ``/plant/state``, ``/estimate``, ``/controller``; any of them may be absent. ``limits``: lower
    and upper limit of inputs and channels, in their units. ``log``: path for the document.
    ``complete``: whether the run ended as it was meant to.

    Returns ``trms.score/1``; only text, numbers, truth values, None, lists and dicts.
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
        "degraded": degraded_figures(tables.get("/controller")),
    }
    if alarms := _count_events(tables.get("/event"), "gap_alarm"):
        document["gap_alarms"] = alarms
    if (timing := timing_figures(tables.get("/timing"), tables.get("/controller"))) is not None:
        document["timing"] = timing
    return json_data(document)


@dataclass(frozen=True)
class TrackedChannel:
    """A channel that was to follow a reference, as the figures of channels take it."""

    time: Array  #: (n,) s
    reference: Array  #: (n,)
    response: Array  #: (n,) what it did; NaN where no sample is

    @cached_property
    def error(self) -> Array:
        """(n,) reference minus response."""
        return self.reference - self.response

    @cached_property
    def steps(self) -> list[metrics.StepMetrics]:
        """Of the reference, in order; ``inf`` for what did not happen."""
        return metrics.steps(self.time, self.reference, self.response)

    @cached_property
    def steady_state_error(self) -> float:
        """Mean over the last part of each hold."""
        return metrics.steady_state_error(self.time, self.reference, self.response)


@dataclass(frozen=True)
class AppliedInput:
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
        signals = TrackedChannel(time, floats(reference, name), hold_at(table, name, time))
        if np.all(np.isnan(signals.reference)) or np.all(np.isnan(signals.response)):
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
        signals = AppliedInput(command.time, floats(command, name), limits.get(name))
        scored[name] = _computed("inputs", signals) | {"unit": unit(command, name)}
    return scored


def _computed(group: figures.Group, signals: TrackedChannel | AppliedInput) -> dict[str, Any]:
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
    violations = {}
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
            violations[name] = {
                "samples": int(np.sum(beyond > tolerance)),
                "worst": float(np.max(beyond)) if np.max(beyond) > tolerance else 0.0,
                "unit": unit(tables[source], name),
            }
    return violations


def _source_of(name: str, tables: Mapping[str, Columns]) -> str | None:
    """The topic that tells a channel best: the true state, else the measurement."""
    for topic in ("/plant/state", "/measurement"):
        table = tables.get(topic)
        if table is not None and name in table.columns and len(table.time):
            return topic
    return None


#: Modes other than normal, as the log names them.
MODES = ("degraded", "landing")


def degraded_figures(words: Columns | None) -> dict[str, Any] | None:
    """How much of a run the loop was not normal, and why: from the modes its supervisor logged.

    ``words``: a row a control sample, with ``mode`` and ``reasons``, (n,) texts; None for a run
    without. Gives the ``share`` of the control samples by mode;
    ``reasons_s``: seconds by reason (``missing alpha_h``), which may overlap; ``first_s``, when it
    first was not normal (None for never); ``landings``, how often the rig was landed.
    """
    if words is None or "mode" not in words.columns or len(words.time) == 0:
        return None
    time, columns = words.time, words.columns
    modes = np.asarray(columns["mode"], dtype=object)
    period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    seconds: dict[str, float] = {}
    for text in columns["reasons"]:
        for reason in filter(None, text.split("; ")):
            seconds[reason] = seconds.get(reason, 0.0) + period
    strange = np.flatnonzero(modes != "normal")
    landing = modes == "landing"
    return {
        "share": {mode: float(np.mean(modes == mode)) for mode in MODES},
        "reasons_s": {reason: round(value, 9) for reason, value in sorted(seconds.items())},
        "first_s": float(time[strange[0]]) if strange.size else None,
        "landings": int(np.count_nonzero(landing[1:] & ~landing[:-1]) + bool(landing[0])),
    }


def _count_events(events: Columns | None, kind: str) -> int:
    """How many events of a kind there are."""
    if events is None or len(events.time) == 0:
        return 0
    return int(np.count_nonzero(np.asarray(events.columns["kind"], dtype=object) == kind))


#: ms, edges of the histogram of lateness.
_LATENESS_EDGES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def timing_figures(timing: Columns | None, words: Columns | None) -> dict[str, Any] | None:
    """How punctual the samples of a real rig were; None for a run that did not wait for a clock.

    ``timing``: a row a sample; ``words``: one a control step. Gives ``samples``, ``skipped``;
    ``late_share``, of those over 1 ms late; ``lateness_ms`` and ``command_ms`` (from the reading to
    the command, of the samples at which the controller was asked) with median, p99 and max;
    ``histogram`` of the lateness: ``edges_ms`` and ``counts`` between them, the last one of all
    that is beyond.
    """
    if timing is None or len(timing.time) == 0:
        return None
    lateness, command = (1e3 * floats(timing, name) for name in ("lateness_s", "command_s"))
    if words is not None and len(words.time):
        asked = np.isin(np.round(1e9 * timing.time), np.round(1e9 * words.time))
        command = command[asked] if asked.any() else command
    due = floats(timing, "due_s")
    period = float(np.median(np.diff(due))) if due.size > 1 else math.inf
    expected = round((due[-1] - due[0]) / period) + 1 if due.size > 1 else due.size
    edges = np.array([*_LATENESS_EDGES, np.inf])
    return {
        "samples": int(due.size),
        "skipped": int(expected - due.size),
        "late_share": float(np.mean(lateness > 1e3 * IN_TIME)),
        "lateness_ms": _spread(lateness),
        "command_ms": _spread(command),
        "histogram": {
            "edges_ms": list(_LATENESS_EDGES),
            "counts": np.histogram(np.maximum(lateness, 0.0), edges)[0].tolist(),
        },
    }


def _spread(values: Array) -> dict[str, float]:
    """Median, 99th percentile and maximum of (n,) values."""
    present = values[~np.isnan(values)]
    if not present.size:
        return {"median": math.nan, "p99": math.nan, "max": math.nan}
    median, p99, largest = np.percentile(present, [50, 99, 100])
    return {"median": float(median), "p99": float(p99), "max": float(largest)}


#: Share of a run in which an observer may find its feet before its innovations are judged.
_TRANSIENT = 0.1
#: Kind of the events that tell of a sample that was not believed.
_OUTLIER = "outlier"


def estimate_figures(tables: Mapping[str, Columns]) -> dict[str, Any]:
    """How good an observer was, and whether it believed the right amount of itself.

    Samples that the observer rejected as outliers are counted; figures of innovations lack them.
    """
    estimate = tables.get("/estimate")
    if estimate is None or len(estimate.time) == 0:
        estimate = Series(np.zeros(0), {})
    errors = _errors(estimate, tables.get("/plant/state"))
    nees, states = _nees(estimate, errors)
    rejected = _rejected(estimate, tables.get("/event"))
    innovations, spreads, missing = _innovations(estimate, rejected)
    time = estimate.time
    settled = time >= (time[0] + _TRANSIENT * (time[-1] - time[0]) if time.size else 0.0)
    late = {name: values[settled] for name, values in innovations.items()}
    p_values = {name: metrics.whiteness_p(values) for name, values in late.items()}
    return {
        "rmse": {name: metrics.rmse(error) for name, error in errors.items()},
        "nees_mean": nees,
        "nees_expected": states or math.nan,
        **_nis(late, {name: values[settled] for name, values in spreads.items()}),
        "innovation_whiteness_p": metrics.joint_p(list(p_values.values())),
        "innovations": {
            name: {
                "normalised_square": metrics.normalised_square(values, spreads[name][settled]),
                "correlation": metrics.neighbour_correlation(values),
                "whiteness_p": p_values[name],
                "missing": missing[name],
                "rejected": int(np.count_nonzero(rejected[name])),
            }
            for name, values in late.items()
        },
        "missing_samples": sum(missing.values()),
        "rejected_samples": sum(int(np.count_nonzero(which)) for which in rejected.values()),
        "prediction_rmse": {name: metrics.rmse(values) for name, values in innovations.items()},
        "units": {name: unit(estimate, name) for name in errors}
        | {name: unit(estimate, f"innovation_{name}") for name in innovations},
    }


def _errors(estimate: Columns, truth: Columns | None) -> dict[str, Array]:
    """Estimate less truth of each state that both have."""
    if truth is None or len(truth.time) == 0:
        return {}
    return {
        name: floats(estimate, name) - hold_at(truth, name, estimate.time)
        for name in truth.columns
        if name in estimate.columns
    }


def _innovations(
    estimate: Columns, rejected: Mapping[str, Array]
) -> tuple[dict[str, Array], dict[str, Array], dict[str, int]]:
    """Innovations that were believed, their expected deviations, and how many were missing."""
    innovations, spreads, missing = {}, {}, {}
    for name in rejected:
        values = floats(estimate, f"innovation_{name}")
        missing[name] = int(np.count_nonzero(np.isnan(values)))
        innovations[name] = np.where(rejected[name], np.nan, values)
        spread = f"innovation_sd_{name}"
        has_spread = spread in estimate.columns
        spreads[name] = floats(estimate, spread) if has_spread else np.full(values.shape, np.nan)
    return innovations, spreads, missing


def _rejected(estimate: Columns, events: Columns | None) -> dict[str, Array]:
    """By measured channel: at which samples of the estimate it was taken for an outlier."""
    channels = [
        name.removeprefix("innovation_")
        for name in estimate.columns
        if name.startswith("innovation_") and not name.startswith("innovation_sd_")
    ]
    rejected = {name: np.zeros(len(estimate.time), dtype=bool) for name in channels}
    if events is None or len(events.time) == 0:
        return rejected
    outlier = np.asarray(events.columns["kind"], dtype=object) == _OUTLIER
    sources = np.asarray(events.columns["source"], dtype=object)
    for name, which in rejected.items():
        times = events.time[outlier & (sources == name)]
        # An event has the time of its sample, to the nanosecond.
        at = np.searchsorted(estimate.time, times - 1e-9)
        which[at[at < which.size]] = True
    return rejected


def _nis(innovations: Mapping[str, Array], spreads: Mapping[str, Array]) -> dict[str, Any]:
    """Normalised innovation squared, summed over the channels, of the samples that have all."""
    figures: dict[str, Any] = {
        "nis_mean": math.nan,
        "nis_expected": math.nan,
        "nis_interval": None,
        "nis_share_inside": math.nan,
    }
    if not innovations:
        return figures
    normalised = [
        values / np.where(spreads[name] > 0, spreads[name], np.nan)
        for name, values in innovations.items()
    ]
    squares = np.sum(np.stack(normalised, axis=1) ** 2, axis=1)
    squares = squares[~np.isnan(squares)]
    if not squares.size:
        return figures
    low, high = metrics.chi_square_interval(len(normalised))
    return {
        "nis_mean": float(np.mean(squares)),
        "nis_expected": len(normalised),
        "nis_interval": [low, high],
        "nis_share_inside": float(np.mean((low <= squares) & (squares <= high))),
    }


def _nees(estimate: Columns, errors: Mapping[str, Array]) -> tuple[float, int]:
    """Mean NEES, and of how many states; only of those with a deviation above zero."""
    columns = []
    for name, error in errors.items():
        if f"sd_{name}" in estimate.columns:
            deviation = floats(estimate, f"sd_{name}")
            if np.all(deviation[~np.isnan(deviation)] > 0) and not np.all(np.isnan(deviation)):
                columns.append((error, deviation))
    if not columns:
        return math.nan, 0
    error, deviation = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
    values = metrics.nees(error, deviation)
    present = values[~np.isnan(values)]
    return (float(np.mean(present)) if present.size else math.nan), len(columns)


INNOVATIONS_SCHEMA = "trms.innovations/1"


def innovation_table(
    estimate: Columns, measurement: Columns, channels: Sequence[str], units: Sequence[str]
) -> dict[str, Any]:
    """How well an observer foresaw a recording, one sample ahead: the only truth that a rig tells.

    Gives figures of every channel as :data:`INNOVATIONS_SCHEMA`; null for what there is not.

    ``estimate``, ``measurement``: the topics of a log, on the same times. ``channels``, ``units``:
    measured channels and their units. Per channel, of the innovations ν (measured minus predicted)
    and the deviations σ expected of them:

    - RMSE of ν, beside the RMSE of predicting that nothing changes (the last measured value stays):
      a model earns its place by the ratio of the two;
    - the mean of (ν/σ)², 1 for a filter that believes the right amount, and the share within ±2σ;
    - whether ν is white: the correlation of neighbours, and the Ljung–Box test over 20 lags.
    """
    settled = slice(int(_TRANSIENT * len(estimate.time)), None)
    document: dict[str, Any] = {"schema": INNOVATIONS_SCHEMA, "channels": {}}
    for name, own_unit in zip(channels, units, strict=True):
        innovation = floats(estimate, f"innovation_{name}")
        deviation = floats(estimate, f"innovation_sd_{name}")
        share = (innovation / deviation)[settled]
        share = share[~np.isnan(share)]
        measured = floats(measurement, name)
        figures = {
            "prediction_rmse": metrics.rmse(innovation),
            "unchanged_rmse": metrics.rmse(np.diff(measured[~np.isnan(measured)])),
            "normalised_square": metrics.normalised_square(innovation[settled], deviation[settled]),
            "within_2sd": float(np.mean(np.abs(share) <= 2.0)) if share.size else math.nan,
            "correlation": metrics.neighbour_correlation(innovation[settled]),
            "whiteness_p": metrics.whiteness_p(innovation[settled]),
        }
        document["channels"][name] = {
            "samples": int(np.count_nonzero(~np.isnan(innovation))),
            **{key: value if math.isfinite(value) else None for key, value in figures.items()},
            "unit": own_unit,
        }
    return document
