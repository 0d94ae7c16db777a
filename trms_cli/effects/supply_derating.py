"""The drive of a rotor weakens as it warms up, or as its supply sags under load.

The warmth ``θ`` follows the load, the square of the command over its limit, with a first-order
lag, and takes gain away::

    v = u (1 − depth θ)        τ θ̇ = (u/u_max)² − θ

A long time constant (10 to 300 s) is a gain that falls with time in use, a zero one a supply that
sags at once. Full command for ever ends at a gain of ``1 − depth``.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext, InputEffect
from trms_cli.effects.first_order import first_order
from trms_cli.models.model import Signal
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class SupplyDerating(InputEffect):
    """Thermal derating of one drive; it begins cold."""

    #: Share of the gain that is lost at full load for ever
    depth: Annotated[float, Meta(ge=0, le=1)]
    time_constant: NotNegative  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("depth", "1", (0.0, 0.1), "gain lost at full load"),
            self.size("time_constant", "s", (10.0, 300.0), "time constant τ"),
        )

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("warmth", "1", "0 cold, 1 after full load for ever", begins_cold=True),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        load = (u / self.full_command(at.model)) ** 2
        warmth, after = first_order(at.own[0], load, at.sizes["time_constant"], duration)
        return u * (1 - at.sizes["depth"] * warmth), after
