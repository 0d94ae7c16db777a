"""A model made linear at a point, on both sides of a switch where the point lies on one.

With equations, ``A = ∂f/∂x``; a model that only steps has ``A = ∂x⁺/∂x`` and its eigenvalues z
stand for ``λ = ln z / T``.

Some coefficients depend on a direction (the cable's stiffness on the side of the yaw, thrust and
drag on the sense of rotation). On such a switch there are two matrices. Small oscillations across
it see their mean: the first harmonic of a spring with two slopes is that of the mean slope (its
describing function), and a central difference gives the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.models.model import Model

#: Which matrix at a switch: the mean of both, or that of the side where the switching states are
#: larger (``upper``) or smaller.
Side = Literal["mean", "upper", "lower"]

#: Distances to both sides of a point at which slopes are compared, relative to 1 + |x|. Across a
#: switch they differ by the same at either, in a smooth place by a tenth as much at the second.
_PROBES = (1e-6, 1e-7)
#: Distance at which one side is taken.
_ASIDE = 1e-9
#: Differences of slopes below this, relative to 1 + |slope|, are rounding.
_ROUNDING = 1e-8


@dataclass(frozen=True)
class Switch:
    """A state whose sign of change decides some coefficients at a point."""

    state: int  #: Position of the state
    entries: tuple[tuple[int, int], ...]  #: Entries of A that differ between the sides
    upper: tuple[float, ...]  #: Their values on either side
    lower: tuple[float, ...]  #: Their values on either side


@dataclass(frozen=True)
class Matrices:
    """The linear model at a point."""

    a: FloatArray  #: (n_x, n_x) array; ∂f/∂x, or ∂x⁺/∂x of a model that steps
    b: FloatArray  #: (n_x, n_u) array
    e: FloatArray  #: (n_x, n_w) array; by the disturbances
    c: FloatArray  #: (n_y, n_x) array; of the measured outputs
    sample_time: float | None = None  #: s, of a model that steps


class Linear:
    """Slopes of one model, with equations or with a step of its own, as compiled expressions.

    It keeps nothing between two calls.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.parameters = model.parameters.values

    @cached_property
    def _slopes(self) -> ca.Function:
        x, u, p, w, f = self._symbols()
        y = self.model.measurement(x, u, p)
        return _still([ca.jacobian(f, v) for v in (x, u, w)] + [ca.jacobian(y, x)], w, [x, u, p])

    @cached_property
    def _a(self) -> ca.Function:
        x, u, p, w, f = self._symbols()
        return _still([ca.jacobian(f, x)], w, [x, u, p])

    @cached_property
    def _change(self) -> ca.Function:
        x, u, p, w, f = self._symbols()
        a = ca.vec(ca.densify(ca.jacobian(f, x)))
        along = ca.vertcat(x, u, p)
        direction = ca.SX.sym("direction", along.shape[0])
        return _still([ca.jtimes(a, along, direction)], w, [x, u, p, direction])

    def matrices(
        self, x: FloatArray, u: FloatArray, side: Side = "mean", p: FloatArray | None = None
    ) -> Matrices:
        """A, B, E and C at a point."""
        a, b, e, c = self._averaged(self._slopes, x, u, side, p)
        return Matrices(a, b, e, c, self.model.sample_time)

    def a(
        self, x: FloatArray, u: FloatArray, side: Side = "mean", p: FloatArray | None = None
    ) -> FloatArray:
        """A alone."""
        return self._averaged(self._a, x, u, side, p)[0]

    def change(
        self,
        x: FloatArray,
        u: FloatArray,
        direction: FloatArray,
        side: Side = "mean",
        p: FloatArray | None = None,
    ) -> FloatArray:
        """dA along a direction (dx, du, dp), (n_x + n_u + n_p,); exact."""
        n = self.model.n_x
        return self._averaged(self._change, x, u, side, p, direction)[0].reshape(n, n, order="F")

    def switches(
        self, x: FloatArray, u: FloatArray, p: FloatArray | None = None
    ) -> tuple[Switch, ...]:
        """The switches that a point lies on; empty where A is continuous."""
        p = self.parameters if p is None else p
        n = self.model.n_x
        if not self._differs(x, u, p, np.ones(n)).any():
            return ()
        switches = []
        for i in range(n):
            away = np.zeros(n)
            away[i] = 1.0
            jumps = self._differs(x, u, p, away)
            if jumps.any():
                step = _ASIDE * (1.0 + abs(x[i])) * away
                upper, lower = self._at([x + step, x - step], u, p)
                entries = tuple((int(r), int(c)) for r, c in np.argwhere(jumps))
                values = (tuple(float(side[e]) for e in entries) for side in (upper, lower))
                switches.append(Switch(i, entries, *values))
        return tuple(switches)

    def _averaged(
        self,
        function: ca.Function,
        x: FloatArray,
        u: FloatArray,
        side: Side,
        p: FloatArray | None,
        *more: FloatArray,
    ) -> list[FloatArray]:
        """The outputs of a function of (x, u, p, …), of one side of a switch or their mean."""
        p = self.parameters if p is None else p
        sides = [function.call([at, u, p, *more]) for at in self._sides(x, u, side, p)]
        return [np.mean([np.array(m) for m in parts], axis=0) for parts in zip(*sides, strict=True)]

    def _sides(
        self, x: FloatArray, u: FloatArray, side: Side, p: FloatArray
    ) -> tuple[FloatArray, ...]:
        """The points whose slopes are averaged."""
        switching = [switch.state for switch in self.switches(x, u, p)]
        if not switching:
            return (x,)
        step = np.zeros(len(x))
        step[switching] = _ASIDE * (1.0 + np.abs(x[switching]))
        upper, lower = x + step, x - step
        return {"upper": (upper,), "lower": (lower,), "mean": (upper, lower)}[side]

    def _differs(self, x: FloatArray, u: FloatArray, p: FloatArray, away: FloatArray) -> BoolArray:
        """Entries of A that jump in a direction."""
        steps = [size * (1.0 + np.abs(x)) * away for size in _PROBES]
        points = [x + sign * step for step in steps for sign in (1, -1)]
        far_up, far_down, near_up, near_down = self._at(points, u, p)
        far, near = np.abs(far_up - far_down), np.abs(near_up - near_down)
        jumps: BoolArray = (near > 0.5 * far) & (near > _ROUNDING * (1.0 + np.abs(near_up)))
        return jumps

    def _at(self, points: list[FloatArray], u: FloatArray, p: FloatArray) -> list[FloatArray]:
        """A at several points, in one call."""
        many = np.array(self._a(np.array(points).T, u, p))
        return np.split(many, len(points), axis=1)

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """x, u, p and w, and the rates or the step of the model."""
        x, u, p, w = self.model.symbols()
        stepping = self.model.sample_time is not None
        f = (self.model.transition if stepping else self.model.dynamics)(x, u, p, w)
        return x, u, p, w, f


def _still(expressions: list[ca.SX], w: ca.SX, inputs: list[ca.SX]) -> ca.Function:
    """A function of dense expressions, without disturbance."""
    dense = [ca.densify(expression) for expression in expressions]
    return ca.Function("slopes", inputs, ca.substitute(dense, [w], [ca.SX.zeros(w.shape[0])]))
