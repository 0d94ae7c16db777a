"""Delay between the command of a rotor and its motor, of any fraction of a sample.

The delayed command is piecewise constant like the command itself, but switches inside the sample.
Each integration step receives its exact mean over that step, so that the delay is continuous (and
differentiable almost everywhere) as a parameter.
"""

import math
from dataclasses import dataclass

import casadi as ca

from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.models.model import Signal, Window
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class InputDelay(Effect):
    """Transport delay of one command."""

    rotor: str  #: Name of a rotor of the model, or of an input
    delay: NotNegative | None = None  #: s
    #: Bound of the delay, s; the past commands that are kept reach back this far
    longest: Positive = 0.2

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("delay", "s", (0.005, 0.1), "transport delay d", upper=self._reach),)

    @property
    def _reach(self) -> float:
        return max(self.longest, self.delay or 0.0)

    def memory(self, step: float) -> tuple[Signal, ...]:
        count = math.ceil(self._reach / step - 1e-9)
        return tuple(Signal(f"past_{k + 1}", "V", "earlier command") for k in range(count))

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel = rotor_input(at.model, self.rotor)
        begin, end = window
        commands = ca.vertcat(at.u[channel], at.own)
        age = at.sizes["delay"] / step
        # The command of k steps ago acts while the delayed time lies in [−k, 1 − k] steps; its
        # weight is the share of the window for which it does.
        arriving = ca.SX(0)
        for k in range(commands.shape[0]):
            first = ca.fmax(begin - age, -k)
            last = ca.fmin(end - age, 1 - k)
            share = ca.fmax(last - first, 0) / (end - begin)
            arriving = arriving + share * commands[k]
        u = ca.SX(at.u)
        u[channel] = arriving
        return u, (commands[:-1, :] if end >= 1 else at.own)
