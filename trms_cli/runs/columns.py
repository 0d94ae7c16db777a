"""The columns of the index: their names, what they mean, and where a score has them.

Figures of a channel or an input are named ``<figure>_<channel>``: ``rmse_alpha_h``,
``effort_u_v``. Those of the twin rotor's two angles and two inputs are columns of the database;
those of other channels, and the errors of estimates, are kept beside them by the same rule and
can be asked for in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["text", "number", "whole", "truth", "any"]


@dataclass(frozen=True)
class Column:
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

#: Figures of a channel: our name, the score's key, kind, unit, what it is.
CHANNEL_FIGURES: tuple[tuple[str, str, Kind, str, str], ...] = (
    ("rmse", "rmse", "number", "rad", "tracking error, root of the mean square"),
    ("iae", "iae", "number", "rad s", "∫|e| dt"),
    ("ise", "ise", "number", "rad² s", "∫e² dt"),
    ("itae", "itae", "number", "rad s²", "∫t|e| dt"),
    ("max_abs_error", "max_abs_error", "number", "rad", "largest error"),
    ("overshoot", "overshoot_percent", "number", "%", "of the worst step"),
    ("overshoot_median", "overshoot_median_percent", "number", "%", "over the steps"),
    ("rise_time", "rise_time_s", "number", "s", "of the worst step"),
    ("rise_time_median", "rise_time_median_s", "number", "s", "over the steps"),
    ("settling_time", "settling_time_s", "number", "s", "of the worst step"),
    ("settling_time_median", "settling_time_median_s", "number", "s", "over the steps"),
    ("steady_state_error", "steady_state_error", "number", "rad", "before the next step"),
    ("steps", "steps", "whole", "", "steps of the reference"),
    ("unsettled", "unsettled_steps", "whole", "", "steps that did not settle"),
)
INPUT_FIGURES: tuple[tuple[str, str, Kind, str, str], ...] = (
    ("effort", "effort", "number", "V² s", "∫u² dt"),
    ("total_variation", "total_variation", "number", "V", "Σ|Δu|"),
    ("saturation", "saturation_share", "number", "1", "share of the time at a limit"),
)

#: What figures of channels, inputs and states begin with: ``rmse_alpha_h``.
FIGURE_STEMS = (
    *(name for name, *_ in (*CHANNEL_FIGURES, *INPUT_FIGURES)),
    "estimate_rmse",
    "prediction_rmse",
)

_OF_RUN = (
    Column("path", "text", "", "folder of the run, or its log if that has another name"),
    Column("log", "text", "", "the log's file, or the status of a job that left no log"),
    Column("time", "text", "UTC", "when it began, as 2025-01-31 12:00:00"),
    Column("command", "text", "", "what was typed"),
    Column(
        "outcome", "text", "", "completed, interrupted, failed, or unfinished: killed or running"
    ),
    Column("complete", "truth", "", "it ran to its end"),
    Column("problem", "text", "", "why a job of a sweep left no log"),
    Column("controller", "text", "", "option chosen"),
    Column("observer", "text", "", "option chosen"),
    Column("ref", "text", "", "option chosen"),
    Column("model", "text", "", "what controller and observer believe"),
    Column("plant", "text", "", "option chosen"),
    Column("supervisor", "text", "", "option chosen"),
    Column("experiment", "text", "", "option chosen"),
    Column("effects", "text", "", "joined by +; empty without any"),
    Column("faults", "text", "", "joined by +; empty without any"),
    Column("recording", "text", "", "file that was replayed"),
    Column("loop", "text", "", "closed or open"),
    Column("seed", "whole", "", "of the random numbers"),
    Column("duration", "number", "s", "time simulated or replayed"),
    Column("sample_time", "number", "s", "of the loop (sim.sample_time)"),
    Column("took", "number", "s", "from the log's beginning to its end by the clock"),
)
_OF_SCORE = (
    Column("rmse", "number", "rad", "sum over the channels, as `trms compare` ranks"),
    Column("iae", "number", "rad s", "sum over the channels"),
    Column("ise", "number", "rad² s", "sum over the channels"),
    Column("itae", "number", "rad s²", "sum over the channels"),
    Column("effort", "number", "V² s", "sum over the inputs"),
    Column("total_variation", "number", "V", "sum over the inputs"),
    Column("saturation", "number", "1", "of the input that was longest at a limit"),
    Column("solve_median", "number", "ms", "time of a control step"),
    Column("solve_p99", "number", "ms", "time of a control step"),
    Column("solve_max", "number", "ms", "time of a control step"),
    Column("iterations", "number", "", "of the solver, on average"),
    Column("deadline_misses", "whole", "", "control steps that took too long"),
    Column("failures", "whole", "", "samples on which the solver failed or a fall-back acted"),
    Column("objective", "number", "", "of the solver, summed"),
    Column("violations", "whole", "", "samples beyond a limit, of all channels and inputs"),
    Column("degraded", "number", "s", "time in which the loop was not normal"),
    Column("landings", "whole", "", "how often the rig was landed"),
    Column("nees", "number", "", "estimate's squared error over its covariance, mean"),
    Column("nees_expected", "number", "", "of a consistent filter"),
    Column("nis", "number", "", "innovations' squares over their covariance, mean"),
    Column("nis_expected", "number", "", "of a consistent filter"),
    Column("whiteness_p", "number", "", "of the innovations"),
    Column("missing_samples", "whole", "", "that a sensor lost"),
    Column("rejected_samples", "whole", "", "that the observer took for outliers"),
)
_OF_ORIGIN = (
    Column("git", "text", "", "revision of the working folder"),
    Column("version", "text", "", "of trms"),
    Column("platform", "text", "", "where it ran"),
    Column("versions", "text", "", "of what computes, as JSON"),
    Column("overrides", "text", "", "what was typed as KEY=VALUE, as JSON"),
    Column("choices", "text", "", "option of each group, as JSON"),
)
_OF_CHANNELS = tuple(
    Column(f"{name}_{channel}", kind, unit, about)
    for name, _, kind, unit, about in CHANNEL_FIGURES
    for channel in _CHANNELS
)
_OF_INPUTS = tuple(
    Column(f"{name}_{channel}", kind, unit, about)
    for name, _, kind, unit, about in INPUT_FIGURES
    for channel in _INPUTS
)

#: Every column, in the order in which a frame has them.
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (*_OF_RUN, *_OF_SCORE, *_OF_CHANNELS, *_OF_INPUTS, *_OF_ORIGIN)
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

    Parameters
    ----------
    score : mapping
        ``trms.score/1``, also one of an older version, or one that holds what it should not:
        what is no finite number is None.
    """
    found: dict[str, float | None] = {}
    channels, inputs = _mapping(score, "channels"), _mapping(score, "inputs")
    for channel, told in channels.items():
        for name, key, *_ in CHANNEL_FIGURES:
            found[f"{name}_{channel}"] = _number(told, key)
    for channel, told in inputs.items():
        for name, key, *_ in INPUT_FIGURES:
            found[f"{name}_{channel}"] = _number(told, key)
    for name in ("rmse", "iae", "ise", "itae"):
        found[name] = _total(_number(told, name) for told in channels.values())
    for name in ("effort", "total_variation"):
        found[name] = _total(_number(told, name) for told in inputs.values())
    shares = [_number(told, "saturation_share") for told in inputs.values()]
    found["saturation"] = max((share for share in shares if share is not None), default=None)
    return found | _of_solver(score) | _of_estimate(score) | _of_loop(score)


def _of_solver(score: Mapping[str, Any]) -> dict[str, float | None]:
    solver = _mapping(score, "solver")
    found = {
        f"solve_{key}": _number(solver.get("time_ms"), key) for key in ("median", "p99", "max")
    }
    return found | {
        "iterations": _number(solver, "iterations_mean"),
        "deadline_misses": _number(solver, "deadline_misses"),
        "failures": _number(solver, "failures"),
        "objective": _number(solver, "objective_total"),
    }


def _of_estimate(score: Mapping[str, Any]) -> dict[str, float | None]:
    estimate = _mapping(score, "estimate")
    found: dict[str, float | None] = {
        "nees": _number(estimate, "nees_mean"),
        "nees_expected": _number(estimate, "nees_expected"),
        "nis": _number(estimate, "nis_mean"),
        "nis_expected": _number(estimate, "nis_expected"),
        "whiteness_p": _number(estimate, "innovation_whiteness_p"),
        "missing_samples": _number(estimate, "missing_samples"),
        "rejected_samples": _number(estimate, "rejected_samples"),
    }
    for key, name in (("rmse", "estimate_rmse"), ("prediction_rmse", "prediction_rmse")):
        for channel in _mapping(estimate, key):
            found[f"{name}_{channel}"] = _number(estimate[key], channel)
    return found


def _of_loop(score: Mapping[str, Any]) -> dict[str, float | None]:
    duration = _number(score, "duration_s")
    limits = _mapping(score, "constraint_violations")
    degraded = _mapping(score, "degraded")
    shares = _total(_number(degraded.get("share"), mode) for mode in _mapping(degraded, "share"))
    told = "constraint_violations" in score
    return {
        "duration": duration,
        "violations": sum(_number(each, "samples") or 0 for each in limits.values())
        if told
        else None,
        "degraded": None if shares is None or duration is None else shares * duration,
        "landings": _number(degraded, "landings"),
    }


def _mapping(owner: Any, key: str) -> Mapping[str, Any]:
    found = owner.get(key) if isinstance(owner, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _number(owner: Any, key: str) -> float | None:
    value = owner.get(key) if isinstance(owner, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return value if abs(value) < 1e300 and math.isfinite(value) else None


def _total(values: Iterable[float | None]) -> float | None:
    """The sum; None where one of them is missing, or without any."""
    present = list(values)
    if not present or any(value is None for value in present):
        return None
    return float(sum(value for value in present if value is not None))
