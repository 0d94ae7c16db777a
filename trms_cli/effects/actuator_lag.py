"""First-order lag between the command of a rotor and its motor: ``τ v̇ = u − v``.

An amplifier with a filter, or a speed loop inside it. The command is constant over a step, so the
lagged command is known exactly; each integration step receives its mean over that step.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import EffectContext, InputEffect
from trms_cli.effects.first_order import first_order
from trms_cli.models.model import Signal
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class ActuatorLag(InputEffect):
    """Lag of one command."""

    time_constant: NotNegative | None = None  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("time_constant", "s", (0.005, 0.1), "time constant τ"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("lagged", "V", "command after the lag"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        return first_order(at.own[0], u, at.sizes["time_constant"], duration)
