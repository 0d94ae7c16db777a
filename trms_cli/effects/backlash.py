"""Backlash of a drive: its output follows the command only when that has crossed the play.

``v⁺ = clip(v, u − b, u + b)``: the play operator (Krasnosel'skii & Pokrovskii 1989).
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext, InputEffect
from trms_cli.models.model import Signal
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class Backlash(InputEffect):
    """Play of one drive."""

    width: NotNegative | None = None  #: b, V: half of the play

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("width", "V", (0.025, 0.15), "half width b"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("engaged", "V", "command behind the play"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        width = at.sizes["width"]
        engaged = ca.fmin(ca.fmax(at.own[0], u - width), u + width)
        return engaged, engaged
