"""A torque on an axis that does not change: a weight at one holding point, a pull, a spring.

``τ = c``. What makes it is not said, so that it explains nothing: a comparison with a known state
tells it, and it corrects a model.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import Effect, EffectContext
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class ConstantTorque(Effect):
    """A torque that is always there."""

    explains: ClassVar[bool] = False

    axis: str  #: Name of an axis of the model
    torque: Annotated[float, Meta(ge=-1e3, le=1e3)] | None = None  #: N m

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("torque", "N*m", (-0.02, 0.02), "constant torque"),)

    def disturbance(self, at: EffectContext) -> ca.SX:
        return at.on(at.axis(self.axis).moment, at.sizes["torque"])
