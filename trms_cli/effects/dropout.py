"""Dropouts of a sensor: a share of its samples is lost, and the last one shown in their place.

Which are lost is chance. This is what such a sensor shows on the mean of all chances,
``m⁺ = p m + (1 − p) α``; a rig that loses samples in earnest has a fault (group ``fault``).
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import EffectContext, SensorEffect
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class Dropout(SensorEffect):
    """Lost samples of one sensor."""

    axis: str  #: Name of an output, or of an axis
    share: Annotated[float, Meta(ge=0, le=0.99)] | None = None  #: p: of the samples that are lost

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("share", "1", (0.3, 0.8), "share p of lost samples"),)

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("lag", "rad", "what was shown less what was there"),)

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        row = self.row(at.model)
        kept = at.sizes["share"] if window[1] >= 1 else 1
        return kept * (at.sensor_memory - (after[row] - before[row]))

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        return self.add_to_channel(at, y, at.sensor_memory[0])
