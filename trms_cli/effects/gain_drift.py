"""The gain of a drive drifts with time: ``v = u (1 + g (1 − exp(−t/τ)))``, t from the first sample.

A drive that warms up or a battery that empties, whatever is asked of it; what sags with the load is
:mod:`trms_cli.effects.supply_derating`.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.effects.first_order import first_order
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class GainDrift(Effect):
    """Drift of one drive's gain."""

    rotor: str  #: Name of an input, or of a rotor
    drift: Annotated[float, Meta(ge=-1, le=1)] | None = None  #: g: relative change in the end
    time_constant: Annotated[float, Meta(ge=1)] = 60.0  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("drift", "1", (-0.15, 0.15), "relative change g of the gain"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("course", "1", "0 at the first sample, 1 in the end", begins_cold=True),)

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel = rotor_input(at.model, self.rotor)
        duration = (window[1] - window[0]) * step
        course, after = first_order(at.own[0], ca.SX(1), ca.SX(self.time_constant), duration)
        u = ca.SX(at.u)
        u[channel] = u[channel] * (1 + at.sizes["drift"] * course)
        return u, after
