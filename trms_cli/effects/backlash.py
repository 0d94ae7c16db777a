"""Backlash of a drive: its output follows the command only when that has crossed the play.

``v⁺ = clip(v, u − b, u + b)``: the play operator (Krasnosel'skii & Pokrovskii 1989).
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class Backlash(Effect):
    """Play of one drive."""

    rotor: str  #: Name of an input, or of a rotor
    width: NotNegative | None = None  #: b, V: half of the play

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("width", "V", (0.025, 0.15), "half width b"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("engaged", "V", "command behind the play"),)

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel, width = rotor_input(at.model, self.rotor), at.sizes["width"]
        u = ca.SX(at.u)
        u[channel] = ca.fmin(ca.fmax(at.own[0], u[channel] - width), u[channel] + width)
        return u, u[channel]
