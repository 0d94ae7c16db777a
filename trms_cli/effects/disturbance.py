"""An exogenous torque on an axis: draughts and pushes, of which only the statistics are known.

Coloured noise of the first order (Ornstein & Uhlenbeck 1930), with the torque d as a state::

    ḋ = −d/τ + white noise,      in the long run d has the standard deviation σ

The rig draws the noise from its seed. A model has the same state; an observer estimates it, with
the noise as its process noise; without one it decays. It is estimated, not explained.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.model import Signal
from trms_cli.models.parameters import Parameter

#: s: what changes faster is white noise to every integration step.
_SHORTEST = 0.05


@dataclass(frozen=True, kw_only=True)
class Disturbance(Effect):
    """Coloured torque; it begins at zero."""

    axis: str  #: Name of an axis of the model
    torque: NotNegative | None = None  #: σ, N m: standard deviation in the long run
    #: τ, s: time over which it forgets itself
    time: Annotated[float, Meta(ge=_SHORTEST)] | None = None

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("torque", "N*m", (0.002, 0.02), "standard deviation σ"),
            self.size("time", "s", (0.3, 3.0), "correlation time τ"),
        )

    def states(self) -> tuple[Signal, ...]:
        return (Signal("torque", "N*m", "exogenous torque"),)

    def derivative(self, at: EffectContext) -> ca.SX:
        return -at.own / at.sizes["time"]

    def disturbance(self, at: EffectContext) -> ca.SX:
        return at.on(at.axis(self.axis).moment, at.own[0])

    def noise_sd(self, at: EffectContext, step: float) -> ca.SX:
        """What keeps the variance of ``d⁺ = exp(−h/τ) d + noise`` at σ²."""
        forgotten = 1 - ca.exp(-2 * step / at.sizes["time"])
        return at.sizes["torque"] * ca.sqrt(forgotten)
