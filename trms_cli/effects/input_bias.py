"""Bias of a drive: what it adds to every command, ``v = u + b``; an amplifier's offset."""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.models.model import Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class InputBias(Effect):
    """Constant error of one command."""

    rotor: str  #: Name of an input, or of a rotor
    bias: Annotated[float, Meta(ge=-1e6, le=1e6)] | None = None  #: b, V

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("bias", "V", (-0.1, 0.1), "bias b"),)

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        u = ca.SX(at.u)
        u[rotor_input(at.model, self.rotor)] += at.sizes["bias"]
        return u, at.own
