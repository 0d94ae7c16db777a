"""Two runs side by side: every figure of both, and what they were given differently."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from trms_cli.scoring.comparison.compared_run import ComparedRun
from trms_cli.scoring.comparison.coordinates import differences

_CHANNEL = (
    ("rmse", "RMSE", "{}"),
    ("iae", "IAE", "{} s"),
    ("ise", "ISE", "{}² s"),
    ("max_abs_error", "largest error", "{}"),
    ("steady_state_error", "steady-state error", "{}"),
    ("overshoot_percent", "overshoot, worst step", "%"),
    ("rise_time_s", "rise time, worst step", "s"),
    ("settling_time_s", "settling time, worst step", "s"),
)
_INPUT = (("effort", "effort ∫u²dt", "{}² s"), ("total_variation", "total variation", "{}"))


@dataclass(frozen=True, kw_only=True)
class Row:
    """A figure of both runs; all are better when small."""

    key: str  #: ``channels.alpha_v.rmse``
    label: str  #: In words, with the channel
    unit: str
    one: float | None  #: in the row's unit
    other: float | None  #: in the row's unit

    @property
    def change(self) -> float | None:
        """(other − one)/one; None where it says nothing."""
        if self.one is None or self.other is None or abs(self.one) < 1e-12:
            return None
        return (self.other - self.one) / abs(self.one)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two runs."""

    one: ComparedRun
    other: ComparedRun
    #: Keys of the configuration that differ, with both values
    settings: tuple[tuple[str, str, str], ...]
    rows: tuple[Row, ...]


def pair(one: ComparedRun, other: ComparedRun) -> Pair:
    """Put two runs side by side."""
    chosen = [
        (key, one.coordinates.get(key, "–"), other.coordinates.get(key, "–"))
        for key in dict.fromkeys([*one.coordinates, *other.coordinates])
        if one.coordinates.get(key) != other.coordinates.get(key)
    ]
    # keys below an option that differs follow from the option
    below = tuple(f"{key}." for key, _, _ in chosen if "." not in key)
    named = {key for key, _, _ in chosen}
    settings = [
        row
        for row in differences(one.config, other.config)
        if row[0] not in named and not row[0].startswith(below)
    ]
    return Pair(one=one, other=other, settings=(*chosen, *settings), rows=tuple(_rows(one, other)))


def _rows(one: ComparedRun, other: ComparedRun) -> Iterator[Row]:
    for group, figures in (("channels", _CHANNEL), ("inputs", _INPUT)):
        left, right = ((run.score or {}).get(group, {}) for run in (one, other))
        for name in dict.fromkeys([*left, *right]):
            for key, label, unit in figures:
                own = (left.get(name) or right.get(name) or {}).get("unit", "")
                values = [side.get(name, {}).get(key) for side in (left, right)]
                if any(value is not None for value in values):
                    yield Row(
                        key=f"{group}.{name}.{key}",
                        label=f"{name} {label}",
                        unit=unit.replace("{}", own).strip(),
                        one=values[0],
                        other=values[1],
                    )
    for key, label in (("median", "time of a step, median"), ("p99", "time of a step, p99")):
        yield _row(f"solver.time_ms.{key}", label, "ms", one.step_time(key), other.step_time(key))
    for key, label in (("failures", "solver failures"), ("deadline_misses", "deadlines missed")):
        yield _row(f"solver.{key}", label, "", one.solver(key), other.solver(key))
    yield _row("degraded", "time not normal", "s", one.degraded(), other.degraded())
    yield _row("violations", "samples beyond a limit", "", one.violations(), other.violations())


def _row(key: str, label: str, unit: str, one: float, other: float) -> Row:
    left, right = (None if math.isnan(value) else value for value in (one, other))
    return Row(key=key, label=label, unit=unit, one=left, other=right)
