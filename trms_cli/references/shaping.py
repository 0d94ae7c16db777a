"""Limits on the rate, acceleration and jerk of a reference.

A rig cannot follow a jump; a shaped reference asks only for what it can do. The shaping is
time-optimal: at each point of a fine grid the fastest motion within the limits that comes to
rest at the signal's present value is planned anew, and its first moment is taken. Constant
targets are therefore reached without overshoot, and a moving one is followed at the distance
that is needed for stopping.

Source of the planner: L. Berscheid, T. Kröger, "Jerk-limited real-time trajectory generation
with arbitrary target states", Robotics: Science and Systems 2021 (the ``ruckig`` library).
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.ranges import Positive
from trms_cli.references.signal import Array, ReferenceSignal

#: Distance between the points at which the motion is planned, s. Between them the reference is
#: a straight line, off by at most ``max_acceleration · GRID² / 8``.
GRID = 0.002
#: Points planned at a time when a later time is asked for.
_CHUNK = 2048
#: Stands for "no limit" where the planner wants a number: 1e6 rad/s is none for a rig.
_UNLIMITED = 1e6


@dataclass(frozen=True, kw_only=True)
class Shaping:
    """How fast a reference may move; a limit that is ``None`` does not bind."""

    max_rate: Positive | None = None  #: rad/s
    max_acceleration: Positive | None = None  #: rad/s²
    max_jerk: Positive | None = None  #: rad/s³
    #: Where the shaped reference begins at t = 0, at rest, rad: where the rig is. ``None`` begins
    #: at the signal's own first value.
    initial: float | None = 0.0

    def __post_init__(self) -> None:
        if self.max_rate is None and self.max_acceleration is None and self.max_jerk is None:
            raise ConfigurationError(
                "a shaping without any limit",
                where="max_rate",
                remedy="set max_rate, max_acceleration or max_jerk, or leave the shaping out",
            )

    def apply(self, signal: ReferenceSignal) -> ShapedSignal:
        """The signal within the limits."""
        return ShapedSignal(signal, self)


@dataclass(frozen=True, eq=False)
class ShapedSignal:
    """A signal seen through a :class:`Shaping`.

    The grid is planned from t = 0 onward as far as it is needed and then remembered: each point
    depends only on the points before it, so that what was asked for first cannot matter.
    """

    signal: ReferenceSignal  #: What is to be followed
    shaping: Shaping  #: The limits
    _grid: _Grid = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_grid", _Grid(self.signal, self.shaping))

    def __reduce__(self) -> tuple[Any, ...]:
        # the planner holds compiled state that does not travel to another process
        return ShapedSignal, (self.signal, self.shaping)

    def sample(self, times: Array) -> Array:
        """Value at each time, ``times: (n,) s -> (n,) rad``; before 0 the value at 0."""
        position = np.maximum(np.asarray(times, dtype=float), 0.0) / GRID
        if position.size == 0:
            return np.zeros(position.shape)
        values = self._grid.until(math.ceil(float(np.max(position))) + 1)
        below = np.floor(position).astype(np.int64)
        fraction = position - below
        return values[below] + fraction * (values[below + 1] - values[below])


class _Grid:
    """The shaped values at ``0, GRID, 2·GRID, …``, planned on demand."""

    def __init__(self, signal: ReferenceSignal, shaping: Shaping) -> None:
        self._signal = signal
        self._shaping = shaping
        self._values: Array = np.zeros(0)
        self._advance: Callable[[float], float] | None = None

    def until(self, index: int) -> Array:
        """Values up to the index at least, (≥ index + 1,) rad."""
        while self._values.size <= index:
            self._extend()
        return self._values

    def _extend(self) -> None:
        first = self._values.size
        targets = self._signal.sample(GRID * np.arange(first, first + _CHUNK, dtype=np.float64))
        if not np.all(np.isfinite(targets)):
            raise ConfigurationError(
                "the signal is not finite, and cannot be shaped",
                where="shaping",
                remedy="check the signal's parameters",
            )
        planned = []
        if self._advance is None:
            initial = self._shaping.initial
            begin = float(targets[0]) if initial is None else initial
            self._advance = _planner(self._shaping, begin)
            planned.append(begin)
            targets = targets[1:]
        planned.extend(map(self._advance, targets.tolist()))
        self._values = np.concatenate([self._values, planned])


def _planner(shaping: Shaping, begin: float) -> Callable[[float], float]:
    """A function that moves one grid step towards a target, and returns the new position."""
    try:
        ruckig: Any = importlib.import_module("ruckig")
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            "shaping needs the package ruckig, which is not installed",
            where="shaping",
            remedy="pip install ruckig (where PyPI has no wheel of it, that takes a C++ compiler)",
        ) from error

    planner = ruckig.Ruckig(1, GRID)
    state = ruckig.InputParameter(1)
    result = ruckig.OutputParameter(1)
    state.current_position = [begin]
    state.current_velocity = [0.0]
    state.current_acceleration = [0.0]
    # Without a jerk limit the planner solves the simpler second-order problem, and without an
    # acceleration limit the first-order one: it takes infinity as the word for that.
    jerk = shaping.max_jerk or math.inf
    no_acceleration_limit = math.inf if jerk == math.inf else _UNLIMITED
    if shaping.max_rate is None and shaping.max_acceleration is None:
        no_acceleration_limit = _UNLIMITED
    state.max_velocity = [shaping.max_rate or _UNLIMITED]
    state.max_acceleration = [shaping.max_acceleration or no_acceleration_limit]
    state.max_jerk = [jerk]

    def advance(target: float) -> float:
        state.target_position = [target]
        planner.update(state, result)
        result.pass_to_input(state)
        return float(result.new_position[0])

    return advance
