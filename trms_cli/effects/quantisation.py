"""Quantisation of an angle: an encoder counts lines, ``y = q round(α/q)``.

Rounding has no useful derivative: it is zero nearly everywhere, and a fit would see a sensor that
shows nothing. What stands here has the value of the rounded angle and the derivative of the angle
itself (the straight-through derivative: that of the mean over a quantum), and none in the quantum.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter

#: A grid finer than doubles are: rounding to it changes no bit, but has a derivative of zero.
_FINEST = 2.0**-100


@dataclass(frozen=True, kw_only=True)
class Quantisation(SensorEffect):
    """Resolution of one angle."""

    axis: str  #: Name of an axis of the model, or of an output
    quantum: NotNegative | None = None  #: q, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("quantum", "rad", (0.001, 0.007), "quantum q"),)

    def resolution(self, model: Model) -> tuple[str, int]:
        return "quantum", self.row(model)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        row = self.row(at.model)
        y = ca.SX(y)
        angle, quantum = y[row], _constant(at.sizes["quantum"])
        width = ca.fmax(quantum, _FINEST)
        rounding = width * ca.floor(angle / width + 0.5) - _constant(angle)
        y[row] = angle + ca.if_else(quantum > 0, rounding, 0)
        return y


def _constant(value: ca.SX) -> ca.SX:
    """The value with a derivative of zero."""
    return ca.floor(value / _FINEST) * _FINEST
