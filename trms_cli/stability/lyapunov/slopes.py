"""Bounds of the slopes θ over boxes of states: mean values of derivatives between two places."""

from __future__ import annotations

import casadi as ca
import numpy as np

from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval, stack
from trms_cli.stability.lyapunov.energy import SLOPES, Energy

#: Parts into which a range is cut before a derivative is bounded over it.
_PARTS = 8


class Slopes:
    """θ of an energy function, about an equilibrium known between bounds.

    Parameters
    ----------
    energy : Energy
    rest : Interval
        (3k,), of :func:`.enclosed_rest.enclosed_rest`.
    """

    def __init__(self, energy: Energy, rest: Interval) -> None:
        self.energy, self.rest = energy, rest
        t = ca.SX.sym("t")

        def of(expression: ca.SX) -> Enclosure:
            return Enclosure(ca.Function("slope", [t], [expression]))

        self._ratio = {
            a: of(ca.substitute(energy.rotors[a].ratio, energy.rotors[a].omega, t))
            for a in energy.axes
        }
        self._stiffness = {a: of(energy.stiffness(a, t)) for a in energy.axes}
        self._restoring = {a: of(energy.restoring(a, t)) for a in energy.axes}
        self._thrust = of(energy.thrust("h", t))

    def __call__(self, boxes: Interval) -> Interval:
        """Bounds (m, 6) over boxes (m, 3k)."""
        count = len(boxes.lower)
        zero = Interval.point(np.zeros(count))
        found = dict.fromkeys(SLOPES, zero)
        for a in self.energy.axes:
            i, j = self.energy.index("omega", a), self.energy.index("alpha", a)
            found[f"psi_{a}"] = over(self._ratio[a], boxes[:, i].hull(self.rest[i]))
            found[f"lambda_{a}"] = self._well(a, boxes[:, j], self.rest[j])
        if self.energy.k == 2:
            pitch, yaw = self.energy.index("alpha", "v"), self.energy.index("omega", "h")
            between = boxes[:, pitch].hull(self.rest[pitch])
            found["sigma"] = between.sine()
            speed = self.rest[yaw]
            still = self._thrust(Interval(speed.lower[None, None], speed.upper[None, None]))[0]
            found["thrust_h"] = Interval(
                np.full(count, still.lower[0, 0]), np.full(count, still.upper[0, 0])
            )
        return stack([found[name] for name in SLOPES])

    def _well(self, axis: str, angle: Interval, rest: Interval) -> Interval:
        """λ: between the derivatives on the way, and the quotient itself away from the rest."""
        slope = over(self._stiffness[axis], angle.hull(rest))
        apart = ~angle.meets(rest)
        moment = self._restoring[axis](_column(angle))[0][:, 0]
        there = self._restoring[axis](Interval(rest.lower[None, None], rest.upper[None, None]))[0]
        with np.errstate(invalid="ignore", over="ignore"):
            quotient = (moment - there[:, 0]) / (angle - rest)
        return Interval(
            np.where(apart, np.maximum(slope.lower, quotient.lower), slope.lower),
            np.where(apart, np.minimum(slope.upper, quotient.upper), slope.upper),
        )


def over(derivative: Enclosure, between: Interval, parts: int = _PARTS) -> Interval:
    """Bounds (m,) of a function of one variable over ranges (m,), cut into parts."""
    share = np.linspace(0.0, 1.0, parts + 1)
    edges = between.lower[:, None] + share * between.width[:, None]
    edges[:, -1] = between.upper
    bounds = derivative(_column(Interval(edges[:, :-1].ravel(), edges[:, 1:].ravel())))[0]
    shape = (len(between.lower), parts)
    return Interval(
        bounds.lower.reshape(shape).min(axis=1), bounds.upper.reshape(shape).max(axis=1)
    )


def _column(values: Interval) -> Interval:
    return Interval(values.lower[:, None], values.upper[:, None])
