"""Textbook systems of two states, whose cycles and regions of attraction are known."""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.models.model import Model, Signal
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.parameters import ParameterSet


class Planar(Model):
    """Two states x, y and a command u; (x, y, u) to the rates is given."""

    name = "planar"
    states = (Signal("x", "1"), Signal("y", "1"))
    inputs = (Signal("u", "1"),)
    outputs = (Signal("x", "1"),)
    disturbances = ()
    controlled = ("x",)

    def __init__(self, rates: Callable[..., Any]) -> None:
        self.input_limits, self.stops, self.axes, self.rotors = {"u": 2.0}, {}, {}, {}
        self.parameters = ParameterSet([], "none")
        self._rates = rates

    def dynamics(self, x, u, p, w):
        return ca.vertcat(*self._rates(x[0], x[1], u[0]))

    def measurement(self, x, u, p):
        return x[0]


def van_der_pol() -> Planar:
    return Planar(lambda x, y, u: (y, (1 - x**2) * y - x))


def reversed_van_der_pol() -> Planar:
    """The limit cycle bounds the region of attraction of the origin."""
    return Planar(lambda x, y, u: (-y, x + (x**2 - 1) * y + u))


def bent(a=((-1.0, 2.0), (-2.0, -0.5)), bend=0.0) -> Planar:
    """A linear system with a quadratic term."""
    return Planar(
        lambda x, y, u: (
            a[0][0] * x + a[0][1] * y + bend * x**2,
            a[1][0] * x + a[1][1] * y + u + bend * x * y,
        )
    )


def at_origin(model: Model) -> OperatingPoint:
    return OperatingPoint(np.zeros(model.n_x), np.zeros(model.n_u))
