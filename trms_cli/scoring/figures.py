"""The figures of a score, each told once: key, words, unit, tolerance, and how it is computed.

A new figure of a channel or an input is one entry of :data:`FIGURES`. The score computes it, and
it stands in the tables of ``trms run``, of ``trms score`` and of ``trms compare`` for two runs, on
the pages of runs and sweeps, in the JSON document, in ``trms runs`` and in its help. With
``total="sum"`` it is one that ``trms compare --metric`` ranks many runs by, with a ``tolerance``
one that a baseline compares; ``short=False`` leaves it out where only a few stand::

    Figure("channels", "error_p95", "error, 95th percentile", "{}",
           of=lambda m, channel: m.quantile(abs(channel.error), 0.95)),
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from trms_cli.core import wording

#: Part of the score that a figure stands in; ``states`` are the two tables of ``estimate``, with a
#: figure a state, and ``run`` what is told of a run as a whole.
Group = Literal[
    "channels", "inputs", "states", "constraint_violations", "estimate", "solver", "timing", "run"
]


@dataclass(frozen=True, kw_only=True)
class FigureTolerance:
    """How far a figure may move: ``absolute + relative·|baseline|``."""

    absolute: float = 0.0  #: In the figure's unit
    relative: float = 0.0  #: Fraction of the baseline

    def limit(self, baseline: float) -> float:
        """In the figure's unit."""
        return self.absolute + self.relative * abs(baseline)


@dataclass(frozen=True)
class Figure:
    """A figure of a score."""

    group: Group
    key: str  #: In the score; a dot leads further down: ``time_ms.median``
    label: str  #: ``RMSE``; what follows a comma is left out in short: ``overshoot, worst step``
    unit: str = ""  #: ``{}`` stands for the unit of the channel, input or state
    tolerance: FigureTolerance | None = None  #: How far it may move from a baseline; None: any way
    judged: bool = True  #: Whether moving further decides about the run, or is shown only
    better: Literal["less", ""] = "less"  #: Which way is better; "" for neither
    short: bool = True  #: Whether ``trms run`` ends with it, and pages of sweeps and panels have it
    of_steps: Literal["worst", "median", ""] = ""  #: Of several steps of the reference, which one
    column: str = ""  #: In ``trms runs``; "" for the key
    about: str = ""  #: What it is, for ``trms runs --help``; "" for the label
    whole: bool = False  #: Whether it is a count
    #: How the column that holds one figure of all channels or inputs takes them together
    total: Literal["sum", "largest", ""] = ""
    #: What computes it, of the module :mod:`~trms_cli.scoring.metrics` (which is handed over:
    #: reading this registry loads no NumPy) and the signals of a channel or an input
    #: (:class:`~trms_cli.scoring.score.TrackedChannel`,
    #: :class:`~trms_cli.scoring.score.AppliedInput`), or of the whole score for a
    #: figure of the ``run``; None: the score has it by other means
    of: Callable[..., float | None] | None = None

    @property
    def column_name(self) -> str:
        """What it is called in ``trms runs``, before the channel: ``overshoot``."""
        return self.column or self.key

    def unit_of(self, unit: str) -> str:
        """Its unit, given that of its channel."""
        return self.unit.replace("{}", unit).strip()

    def value(self, owner: Any) -> float | int | None:
        """Its value in a channel, an input or a part of the score; None for what is no number."""
        for key in self.key.split("."):
            owner = owner.get(key) if isinstance(owner, Mapping) else None
        return finite(owner)


def _moves(absolute: float, relative: float = 0.02) -> FigureTolerance:
    return FigureTolerance(absolute=absolute, relative=relative)


def _time_not_normal(score: Mapping[str, Any]) -> float | None:
    degraded, duration = part(score, "degraded"), finite(score.get("duration_s"))
    share = total(finite(value) for value in part(degraded, "share").values())
    return None if share is None or duration is None else share * duration


def _violations(score: Mapping[str, Any]) -> int | None:
    if not isinstance(score.get("constraint_violations"), Mapping):
        return None
    limits = part(score, "constraint_violations")
    return sum(int(finite(part(limits, name).get("samples")) or 0) for name in limits)


#: In the order of the score and of all tables. Tolerances: 1e-3 rad is less than a quantum of an
#: encoder with 4096 lines, 0.1 s ten samples at 100 Hz. Wall times have none: they belong to the
#: machine.
FIGURES: list[Figure] = [
    Figure("channels", "rmse", "RMSE", "{}", _moves(1e-3), total="sum",
           about="tracking error, root of the mean square", of=lambda m, c: m.rmse(c.error)),
    Figure("channels", "iae", "IAE", "{} s", _moves(1e-2), total="sum", about="∫|e| dt",
           of=lambda m, c: m.iae(c.time, c.error), short=False),
    Figure("channels", "ise", "ISE", "{}² s", _moves(1e-3), total="sum", about="∫e² dt",
           of=lambda m, c: m.ise(c.time, c.error), short=False),
    Figure("channels", "itae", "ITAE", "{} s²", _moves(0.3), total="sum", about="∫t|e| dt",
           of=lambda m, c: m.itae(c.time, c.error), short=False),
    Figure("channels", "max_abs_error", "largest error", "{}", _moves(5e-3),
           total="sum", of=lambda m, c: m.max_abs_error(c.error)),
    Figure("channels", "overshoot_percent", "overshoot, worst step", "%", _moves(1.0),
           of_steps="worst", column="overshoot", about="of the worst step",
           of=lambda m, c: m.worst(step.overshoot_percent for step in c.steps)),
    Figure("channels", "overshoot_median_percent", "overshoot, median", "%", of_steps="median",
           column="overshoot_median", about="over the steps",
           of=lambda m, c: m.median(step.overshoot_percent for step in c.steps), short=False),
    Figure("channels", "rise_time_s", "rise time, worst step", "s", _moves(0.05), judged=False,
           of_steps="worst", column="rise_time", about="of the worst step",
           of=lambda m, c: m.worst(step.rise_time for step in c.steps), short=False),
    Figure("channels", "rise_time_median_s", "rise time, median", "s", of_steps="median",
           column="rise_time_median", about="over the steps",
           of=lambda m, c: m.median(step.rise_time for step in c.steps), short=False),
    Figure("channels", "settling_time_s", "settling time, worst step", "s", _moves(0.1),
           of_steps="worst", column="settling_time", about="of the worst step",
           of=lambda m, c: m.worst(step.settling_time for step in c.steps)),
    Figure("channels", "settling_time_median_s", "settling time, median", "s", of_steps="median",
           column="settling_time_median", about="over the steps",
           of=lambda m, c: m.median(step.settling_time for step in c.steps), short=False),
    Figure("channels", "steps", "steps", better="", whole=True, about="steps of the reference",
           of=lambda m, c: len(c.steps), short=False),
    Figure("channels", "unsettled_steps", "steps not settled", "", _moves(0.0, 0.0), whole=True,
           column="unsettled", about="steps that did not settle",
           of=lambda m, c: sum(math.isinf(step.settling_time) for step in c.steps), short=False),
    Figure("channels", "steady_state_error", "steady-state error", "{}", _moves(1e-3),
           about="before the next step",
           of=lambda m, c: c.steady_state_error),
    Figure("inputs", "effort", "effort ∫u²dt", "{}² s", _moves(0.1, 0.05), judged=False,
           total="sum", about="∫u² dt",
           of=lambda m, u: m.input_effort(u.time, u.command)),
    Figure("inputs", "total_variation", "total variation Σ|Δu|", "{}", _moves(0.1, 0.05),
           judged=False, total="sum", about="Σ|Δu|", of=lambda m, u: m.total_variation(u.command),
           short=False),
    Figure("inputs", "saturation_share", "share of time at a limit", "", _moves(0.01),
           judged=False, total="largest", column="saturation",
           about="share of the time at a limit",
           of=lambda m, u: m.saturation_share(u.command, *u.limits) if u.limits else math.nan),
    Figure("states", "rmse", "RMSE of the state", "{}", _moves(1e-3, 0.05),
           column="estimate_rmse"),
    Figure("states", "prediction_rmse", "RMSE of 1-step prediction", "{}", _moves(1e-3, 0.05)),
    Figure("solver", "time_ms.median", "time of a step, median", "ms",
           column="solve_median", about="time of a control step"),
    Figure("solver", "time_ms.p99", "time of a step, p99", "ms", column="solve_p99",
           about="time of a control step"),
    Figure("solver", "time_ms.max", "time of a step, longest", "ms",
           column="solve_max", about="time of a control step"),
    Figure("solver", "iterations_mean", "iterations, mean", "", _moves(0.5), judged=False,
           better="", column="iterations", about="of the solver, on average", short=False),
    Figure("solver", "deadline_misses", "deadlines missed", whole=True,
           about="control steps that took too long"),
    Figure("solver", "failures", "failures and fall-backs", "", _moves(0.0, 0.0), whole=True,
           about="samples on which the solver failed or a fall-back acted"),
    Figure("solver", "objective_total", "objective, summed", better="", column="objective",
           about="of the solver, summed", short=False),
    Figure("timing", "late_share", "samples late by over 1 ms", "", column="late",
           about="share of the samples of a real rig that began over 1 ms late"),
    Figure("timing", "lateness_ms.p99", "lateness, p99", "ms", column="lateness_p99",
           about="of the samples of a real rig"),
    Figure("timing", "lateness_ms.max", "lateness, worst", "ms", column="lateness_max",
           about="of the samples of a real rig"),
    Figure("timing", "command_ms.median", "command after the reading, median", "ms",
           column="command_median", about="from a reading of a real rig to its command"),
    Figure("timing", "command_ms.p99", "command after the reading, p99", "ms",
           column="command_p99", about="from a reading of a real rig to its command"),
    Figure("timing", "skipped", "samples left out", whole=True,
           about="samples of a real rig that were left out"),
    Figure("constraint_violations", "samples", "samples outside", "", _moves(0.0, 0.0),
           whole=True),
    Figure("constraint_violations", "worst", "worst excess", "{}", _moves(1e-4, 0.0)),
    Figure("run", "violations", "samples beyond a limit", whole=True, of=_violations,
           about="samples beyond a limit, of all channels and inputs"),
    Figure("run", "degraded", "time not normal", "s", of=_time_not_normal,
           about="time in which the loop was not normal"),
    Figure("run", "landings", "landings", whole=True, about="how often the rig was landed",
           of=lambda score: finite(part(score, "degraded").get("landings"))),
    Figure("run", "gap_alarms", "gap alarms", whole=True,
           about="how often the gap watch said that rig and model differ",
           of=lambda score: finite(score.get("gap_alarms"))),
    Figure("estimate", "nees_mean", "NEES", better="", column="nees",
           about="estimate's squared error over its covariance, mean"),
    Figure("estimate", "nees_expected", "NEES expected", better="", about="of a consistent filter",
           short=False),
    Figure("estimate", "nis_mean", "NIS", better="", column="nis",
           about="innovations' squares over their covariance, mean"),
    Figure("estimate", "nis_expected", "NIS expected", better="", about="of a consistent filter",
           short=False),
    Figure("estimate", "innovation_whiteness_p", "whiteness, p", better="", column="whiteness_p",
           about="of the innovations", short=False),
    Figure("estimate", "missing_samples", "missing samples", better="", whole=True,
           about="that a sensor lost", short=False),
    Figure("estimate", "rejected_samples", "rejected samples", better="", whole=True,
           about="that the observer took for outliers", short=False),
]  # fmt: skip


def of_group(*groups: Group) -> list[Figure]:
    """The figures of some groups, in order."""
    return [figure for figure in FIGURES if figure.group in groups]


def column_title(name: str, unit: str = "") -> str:
    """A column of ``trms runs`` on an axis: ``rmse_alpha_h`` is *yaw RMSE [rad]*."""
    for figure in FIGURES:
        if name == figure.column_name:
            return wording.with_unit(figure.label, unit)
        channel = name.removeprefix(f"{figure.column_name}_")
        if channel in wording.SIGNALS and figure.group in ("channels", "inputs", "states"):
            return wording.with_unit(f"{wording.signal(channel)} {figure.label}", unit)
    return wording.with_unit({"merit": "figure of merit"}.get(name, name.replace("_", " ")), unit)


def metrics() -> dict[str, str]:
    """Figures that a comparison ranks by, summed over the channels, with their units."""
    return {f.key: f.unit for f in of_group("channels") if f.total == "sum"}


@dataclass(frozen=True)
class Entry:
    """A figure of a score, with its value."""

    figure: Figure
    of: str  #: Channel, input or state; "" for a figure of the run as a whole
    key: str  #: ``channels.alpha_v.rmse``
    unit: str
    value: float | int | None

    @property
    def label(self) -> str:
        """``alpha_v RMSE``."""
        return f"{self.of} {self.figure.label}".strip()


def entries(score: Mapping[str, Any], *groups: Group) -> Iterator[Entry]:
    """Every figure of some groups (default: of all) that a score has, or could have.

    ``score``: ``trms.score/1``, also one of an older version, or one that holds what it should not:
    what is no finite number is None.
    """
    requested_groups = {figure.group for figure in FIGURES if not groups or figure.group in groups}
    for group in dict.fromkeys(figure.group for figure in FIGURES):
        if group not in requested_groups:
            continue
        figures = of_group(group)
        if group in ("channels", "inputs", "constraint_violations"):
            for name, own in part(score, group).items():
                unit = str(own.get("unit", "")) if isinstance(own, Mapping) else ""
                for each in figures:
                    key = f"{group}.{name}.{each.key}"
                    yield Entry(each, name, key, each.unit_of(unit), each.value(own))
        elif group == "states":
            estimate = part(score, "estimate")
            units = part(estimate, "units")
            for each in figures:
                for name, value in part(estimate, each.key).items():
                    key = f"estimate.{each.key}.{name}"
                    yield Entry(each, name, key, str(units.get(name, "")), finite(value))
        elif group == "run":
            for each in figures:
                value = None if each.of is None else each.of(score)
                yield Entry(each, "", each.key, each.unit, value)
        else:
            for each in figures:
                value = each.value(part(score, group))
                yield Entry(each, "", f"{group}.{each.key}", each.unit, value)


def part(owner: Any, key: str) -> Mapping[str, Any]:
    """A part of a score; empty where it has none."""
    inner = owner.get(key) if isinstance(owner, Mapping) else None
    return inner if isinstance(inner, Mapping) else {}


def finite(value: Any) -> float | int | None:
    """A finite number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return value if abs(value) < 1e300 and math.isfinite(value) else None


def total(values: Iterable[float | None]) -> float | None:
    """The sum; None where one of them is missing, or without any."""
    present = list(values)
    if not present or any(value is None for value in present):
        return None
    return float(sum(value for value in present if value is not None))
