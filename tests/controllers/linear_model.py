"""A small linear model for tests against textbook solutions."""

from __future__ import annotations

import casadi as ca
import numpy as np

from trms_cli.models.model import Model, RigAxis, Signal
from trms_cli.models.parameters import Parameter, ParameterSet


class DoubleMass(Model):
    """Two coupled, damped masses with a force on each: ẋ = A x + B (u + w)."""

    def __init__(self, limit: float = 100.0) -> None:
        self.name = "double_mass"
        self.states = tuple(Signal(name, "m") for name in ("p1", "v1", "p2", "v2"))
        self.inputs = (Signal("f1", "N"), Signal("f2", "N"))
        self.outputs = (self.states[0], self.states[2])
        self.disturbances = (Signal("push_1", "N"), Signal("push_2", "N"))
        self.parameters = ParameterSet([Parameter("k", 2.0, "N/m"), Parameter("d", 0.4, "N*s/m")])
        self.controlled = ("p1", "p2")
        self.input_limits = {"f1": limit, "f2": limit}
        self.stops: dict[str, float] = {}
        self.axes: dict[str, RigAxis] = {}
        self.rotors: dict[str, str] = {}

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        k, d = p[0], p[1]
        spring = k * (x[2] - x[0])
        return ca.vertcat(
            x[1], spring - k * x[0] - d * x[1] + u[0] + w[0], x[3], -spring - d * x[3] + u[1] + w[1]
        )

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return x[[0, 2]]


def matrices(discrete_step: ca.Function, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """A and B of a discretised linear model."""
    x, u, p, w = model.symbols()
    after = discrete_step(x, u, p, w)
    slopes = ca.Function("slopes", [x, u, p, w], [ca.jacobian(after, x), ca.jacobian(after, u)])
    a, b = slopes(
        np.zeros(model.n_x), np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w)
    )
    return np.array(a), np.array(b)
