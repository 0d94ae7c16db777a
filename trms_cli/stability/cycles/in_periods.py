"""A model in a time of its own, in which one period takes one unit.

With τ = t/T the equations are ``dx/dτ = T f(x, u, p, w)``: the period T becomes a parameter, and
the slopes of a discretised step by T come out of the same derivative as those by the state.
"""

from __future__ import annotations

import casadi as ca

from trms_cli.models.model import FloatArray, Model
from trms_cli.models.parameters import Parameter

#: Name of the period among the parameters.
PERIOD = "the_period"


class InPeriods(Model):
    """A model whose time is counted in periods; the period is its last parameter, s.

    Parameters
    ----------
    base : Model
        With equations. What impulses, delays and sensors add to it is left out: f must be
        differentiable for the variational equations.
    """

    def __init__(self, base: Model) -> None:
        self.base = base
        self.name = base.name
        self.states, self.inputs, self.outputs = base.states, base.inputs, base.outputs
        self.disturbances = base.disturbances
        self.parameters = base.parameters.joined([Parameter(PERIOD, 1.0, "s", lower=0.0)])
        self.controlled, self.input_limits = base.controlled, base.input_limits
        self.stops, self.axes, self.rotors = base.stops, base.axes, base.rotors
        self.stiff = base.stiff

    def rest(self) -> FloatArray:
        return self.base.rest()

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n = len(self.base.parameters)
        return p[n] * self.base.dynamics(x, u, p[:n, 0], w)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return self.base.measurement(x, u, p[: len(self.base.parameters), 0])
