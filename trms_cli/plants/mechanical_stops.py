"""Mechanical stops of an axis: the rig's frame ends its travel, without rebound.

Where a model has equations, a stop is an effect: an impulse that takes the rate away. Where it only
steps, the angle is held at the stop, and so is what the model remembers of it: it has no rate left.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from trms_cli.effects.effect import Effect, EffectContext, axis_of, resisting_impulse
from trms_cli.models.discrete import SteppedModel, copied_states, root_of
from trms_cli.models.model import FloatArray, Model, Signal
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class MechanicalStop(Effect):
    """A stop at either end of an axis' travel."""

    axis: str
    range: float  #: Largest angle to either side, rad

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
    """Stops for every axis of a model with equations that has a finite range, by effect name."""
    return {
        f"{name}_stop": MechanicalStop(axis=name, range=model.stops[axis.angle])
        for name, axis in model.axes.items()
        if model.stops.get(axis.angle, float("inf")) < float("inf")
    }


class StoppedSteps(SteppedModel):
    """A model that only steps, its angles within the stops.

    Parameters
    ----------
    base : Model
        With a ``sample_time``.
    """

    def __init__(self, base: Model) -> None:
        assert base.sample_time is not None
        self.base, self.name, self.sample_time = base, base.name, base.sample_time
        self.states, self.inputs, self.outputs = base.states, base.inputs, base.outputs
        self.disturbances, self.parameters = base.disturbances, base.parameters
        self.controlled, self.input_limits = base.controlled, base.input_limits
        self.stops, self.axes, self.rotors = base.stops, base.axes, base.rotors
        copies = copied_states(base)
        #: Rows of an angle and of what is remembered of it, by the angle's range.
        self._held = [
            (row, [i for i in range(base.n_x) if root_of(copies, i) == ("x", row)], limit)
            for row, limit in (
                (base.state_index(name), limit) for name, limit in base.stops.items()
            )
            if limit < float("inf")
        ]

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        free = self.base.transition(x, u, p, w)
        after = ca.SX(free)
        for angle, rows, limit in self._held:
            stop = ca.sign(free[angle]) * limit
            for row in rows:
                after[row] = ca.if_else(ca.fabs(free[angle]) >= limit, stop, free[row])
        return after

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return self.base.measurement(x, u, p)

    def rest(self) -> FloatArray:
        return self.base.rest()

    def memory(self, step: float) -> tuple[Signal, ...]:
        return self.base.memory(step)

    def input_path(
        self, memory: ca.SX, u: ca.SX, p: ca.SX, window: tuple[float, float], step: float
    ) -> tuple[ca.SX, ca.SX]:
        return self.base.input_path(memory, u, p, window, step)

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return self.base.sensor_memory(step)

    def sensor_path(
        self,
        memory: ca.SX,
        before: ca.SX,
        after: ca.SX,
        u: ca.SX,
        p: ca.SX,
        window: tuple[float, float],
        step: float,
    ) -> ca.SX:
        return self.base.sensor_path(memory, before, after, u, p, window, step)

    def reading(
        self, memory: ca.SX, x: ca.SX, u: ca.SX, p: ca.SX, step: float, since: float = 1.0
    ) -> ca.SX:
        return self.base.reading(memory, x, u, p, step, since)
