"""The gain of a drive drifts with time: ``v = u (1 + g (1 − exp(−t/τ)))``, t from the first sample.

A drive that warms up or a battery that empties, whatever is asked of it; what sags with the load is
:mod:`trms_cli.effects.supply_derating`.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import EffectContext, InputEffect
from trms_cli.effects.first_order import first_order
from trms_cli.models.model import Signal
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class GainDrift(InputEffect):
    """Drift of one drive's gain."""

    drift: Annotated[float, Meta(ge=-1, le=1)] | None = None  #: g: relative change in the end
    time_constant: Annotated[float, Meta(ge=1)] = 60.0  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("drift", "1", (-0.15, 0.15), "relative change g of the gain"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("course", "1", "0 at the first sample, 1 in the end", begins_cold=True),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        course, after = first_order(at.own[0], ca.SX(1), ca.SX(self.time_constant), duration)
        return u * (1 + at.sizes["drift"] * course), after
