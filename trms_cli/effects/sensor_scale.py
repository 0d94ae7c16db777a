"""Scale error of a sensor: ``y = (1 + e) α``."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class SensorScale(SensorEffect):
    """Relative error of one sensor's gain."""

    axis: str  #: Name of an output, or of an axis
    error: Annotated[float, Meta(ge=-0.9, le=9)] | None = None  #: e

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("error", "1", (-0.1, 0.1), "relative error e of the gain"),)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        return self.add_to_channel(at, y, at.sizes["error"] * y[self.row(at.model)])

    def stretch(self, model: Model, sizes: Mapping[str, float]) -> float:
        # the rate of an axis is seen through the sensor of its angle alone
        is_angle = model.outputs[self.row(model)].name in {a.angle for a in model.axes.values()}
        return (1 + is_angle) * math.log1p(sizes["error"])
