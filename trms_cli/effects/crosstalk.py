"""Crosstalk of a sensor: it shows a part of another output, ``y_i = α_i + c (s_i/s_j) α_j``.

``s`` are the ranges of the two, so that c is a share of the other one's range.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.errors import ModelError
from trms_cli.effects.effect import EffectContext, SensorEffect, output_row
from trms_cli.models.model import Model, names
from trms_cli.models.parameters import Parameter
from trms_cli.models.scales import port_scale


@dataclass(frozen=True, kw_only=True)
class Crosstalk(SensorEffect):
    """Part of another output in one sensor."""

    axis: str  #: Name of an output, or of an axis
    source: str | None = None  #: Name of the other output; None: the next one of the model
    share: Annotated[float, Meta(ge=-1, le=1)] | None = None  #: c

    def check(self, model: Model) -> None:
        self.row(model)
        if self.source_row(model) == self.row(model):
            raise ModelError(
                f"model {model.name!r} has no output beside {self.axis!r} that it could show",
                remedy="crosstalk is between two outputs",
            )

    def source_row(self, model: Model) -> int:
        """Position of the other output in ``y``."""
        if self.source is not None:
            return output_row(model, self.source)
        return (self.row(model) + 1) % model.n_y

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("share", "1", (-0.1, 0.1), "share c of the other output"),)

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        outputs, other = names(at.model.outputs), self.source_row(at.model)
        own = port_scale(at.model, output=outputs[self.row(at.model)]).travel
        ratio = own / port_scale(at.model, output=outputs[other]).travel
        return self.add_to_channel(at, y, at.sizes["share"] * ratio * y[other])
