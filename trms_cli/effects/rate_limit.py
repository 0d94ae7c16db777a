"""Rate limit of a drive: ``|v̇| ≤ U/τ``, with full command U and the time τ to reach it from zero.

The command is constant over a step, so that the ramp towards it is known exactly; each integration
step receives its mean. For τ = 0 there is no limit, bit for bit.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext, InputEffect
from trms_cli.models.model import Signal
from trms_cli.models.parameters import Parameter

_SHORTEST = 1e-9  #: s, τ that is no limit in any step


@dataclass(frozen=True, kw_only=True)
class RateLimit(InputEffect):
    """Slew rate of one drive."""

    rise_time: NotNegative | None = None  #: τ, s: from zero to full command

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("rise_time", "s", (0.1, 1.0), "time τ from zero to full command"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("limited", "V", "command behind the rate limit"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        full, rise_time = self.full_command(at.model), at.sizes["rise_time"]
        most = full * duration / ca.fmax(rise_time, _SHORTEST)
        wanted = u - at.own[0]
        short = wanted - ca.fmin(ca.fmax(wanted, -most), most)  # zero where it arrives
        moved = wanted - short
        # It is on the ramp for |moved|/most of the window, and lacks half of the way meanwhile.
        lacking = moved * ca.fabs(moved) * rise_time / (2 * full * duration)
        return u - short - lacking, u - short
