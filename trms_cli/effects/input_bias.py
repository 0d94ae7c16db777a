"""Bias of a drive: what it adds to every command, ``v = u + b``; an amplifier's offset."""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import EffectContext, InputEffect
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class InputBias(InputEffect):
    """Constant error of one command."""

    bias: Annotated[float, Meta(ge=-1e6, le=1e6)] | None = None  #: b, V

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("bias", "V", (-0.1, 0.1), "bias b"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        return u + at.sizes["bias"], at.own
