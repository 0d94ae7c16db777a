"""Mechanical stops of an axis: the rig's frame ends its travel, without rebound."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from trms_cli.effects.effect import Effect, EffectContext, axis_of, resisting_impulse
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class MechanicalStop(Effect):
    """A stop at either end of an axis' travel.

    Attributes
    ----------
    axis : {"pitch", "yaw"}
    range : float
        Largest angle to either side, rad.
    """

    axis: str
    range: float

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("range", self.range, "rad", lower=0.0),)

    def check(self, model: Model) -> None:
        axis_of(model, self.axis)

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        row = at.model.state_index(at.axis(self.axis).angle)
        angle, limit = at.x[row], at.sizes["range"]
        held = resisting_impulse(at, self.axis, None, duration)
        outward = ca.logic_and(ca.fabs(angle) >= limit, angle * at.rate(self.axis) > 0)
        x = ca.if_else(outward, held, at.x)
        x[row] = ca.fmin(ca.fmax(angle, -limit), limit)
        return x


def with_stops(model: Model) -> dict[str, Effect]:
    """Stops for every axis of a model that has a finite range, by effect name."""
    return {
        f"{name}_stop": MechanicalStop(axis=name, range=model.stops[axis.angle])
        for name, axis in model.axes.items()
        if model.stops.get(axis.angle, float("inf")) < float("inf")
    }
