"""Bias of an angle sensor: the encoder's zero is not where the beam is level, ``y = α + b``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class SensorBias(SensorEffect):
    """Constant error of one angle."""

    axis: str  #: Name of an axis of the model, or of an output
    bias: Annotated[float, Meta(ge=-1, le=1)] | None = None  #: b, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("bias", "rad", (-0.035, 0.035), "bias b"),)

    def inverse(
        self, recorded: FloatArray, step: float, sizes: Mapping[str, float]
    ) -> FloatArray | None:
        return recorded - sizes["bias"]

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        return self.add_to_channel(at, y, at.sizes["bias"])
