"""First-order lag between the command of a rotor and its motor: ``τ v̇ = u − v``.

An amplifier with a filter, or a speed loop inside it. The command is constant over a step, so the
lagged command is known exactly; each integration step receives its mean over that step.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.effects.first_order import first_order
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class ActuatorLag(Effect):
    """Lag of one command."""

    rotor: str  #: Name of a rotor of the model, or of an input
    time_constant: NotNegative | None = None  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("time_constant", "s", (0.005, 0.1), "time constant τ"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("lagged", "V", "command after the lag"),)

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel = rotor_input(at.model, self.rotor)
        duration = (window[1] - window[0]) * step
        u = ca.SX(at.u)
        u[channel], lagged = first_order(
            at.own[0], at.u[channel], at.sizes["time_constant"], duration
        )
        return u, lagged
