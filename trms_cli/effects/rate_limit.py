"""Rate limit of a drive: ``|v̇| ≤ U/τ``, with full command U and the time τ to reach it from zero.

The command is constant over a step, so that the ramp towards it is known exactly; each integration
step receives its mean. For τ = 0 there is no limit, bit for bit.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.models.model import Signal, Window, names
from trms_cli.models.parameters import Parameter

_SHORTEST = 1e-9  #: s, τ that is no limit in any step


@dataclass(frozen=True, kw_only=True)
class RateLimit(Effect):
    """Slew rate of one drive."""

    rotor: str  #: Name of an input, or of a rotor
    rise_time: NotNegative | None = None  #: τ, s: from zero to full command

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("rise_time", "s", (0.1, 1.0), "time τ from zero to full command"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("limited", "V", "command behind the rate limit"),)

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel = rotor_input(at.model, self.rotor)
        full = at.model.input_limits[names(at.model.inputs)[channel]]
        duration = (window[1] - window[0]) * step
        rise_time = at.sizes["rise_time"]
        most = full * duration / ca.fmax(rise_time, _SHORTEST)
        u = ca.SX(at.u)
        wanted = u[channel] - at.own[0]
        short = wanted - ca.fmin(ca.fmax(wanted, -most), most)  # zero where it arrives
        moved = wanted - short
        # It is on the ramp for |moved|/most of the window, and lacks half of the way meanwhile.
        lacking = moved * ca.fabs(moved) * rise_time / (2 * full * duration)
        u[channel] = u[channel] - short - lacking
        return u, at.u[channel] - short
