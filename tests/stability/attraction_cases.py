"""Textbook systems whose regions of attraction are known."""

from __future__ import annotations

import casadi as ca
import numpy as np

from trms_cli.models.model import Model, Signal
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.parameters import ParameterSet


class Planar(Model):
    """Two states x1, x2 and a command u that adds to the second rate."""

    def __init__(self, name="planar", a=((-1.0, 2.0), (-2.0, -0.5)), bend=0.0):
        self.name = name
        self._a, self._bend = np.array(a), bend
        self.states = (Signal("x1", "1"), Signal("x2", "1"))
        self.inputs = (Signal("u", "1"),)
        self.outputs = self.states
        self.disturbances = (Signal("w", "1"),)
        self.parameters = ParameterSet(())
        self.controlled = ("x1",)
        self.input_limits = {"u": 1.0}
        self.stops, self.axes, self.rotors = {}, {}, {}

    def dynamics(self, x, u, p, w):
        f = ca.DM(self._a) @ x
        return f + ca.vertcat(0, u[0] + w[0]) + self._bend * ca.vertcat(x[0] ** 2, x[0] * x[1])

    def measurement(self, x, u, p):
        return x


class VanDerPol(Planar):
    """In reversed time: the limit cycle bounds the region of attraction of the origin."""

    def __init__(self):
        super().__init__("reversed_van_der_pol")

    def dynamics(self, x, u, p, w):
        return ca.vertcat(-x[1], x[0] + (x[0] ** 2 - 1.0) * x[1] + u[0])


def at_origin(model: Model) -> OperatingPoint:
    return OperatingPoint(np.zeros(model.n_x), np.zeros(model.n_u))


class Jumping(Planar):
    """With dry friction written as a sign: its rate jumps."""

    def dynamics(self, x, u, p, w):
        return super().dynamics(x, u, p, w) - ca.vertcat(0, 0.1 * ca.sign(x[1]))


class Cabled(Planar):
    """With a spring whose stiffness changes away from the equilibrium, at x1 = -0.3."""

    def dynamics(self, x, u, p, w):
        slack = x[0] + 0.3
        spring = ca.if_else(slack >= 0, 1.0, 3.0) * slack - 0.3
        return ca.vertcat(x[1], -spring - 0.4 * x[1] + u[0])
