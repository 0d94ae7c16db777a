"""What happens to a command on its way to the motor.

A command is constant over a step, so that what a lag or a ramp makes of it is known exactly: each
integration step receives its mean over that step.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.effects.effect import Effect, EffectContext, rotor_input
from trms_cli.models.model import Signal, Window, names
from trms_cli.models.parameters import Parameter

#: A window of this many time constants and more leaves nothing of the past: exp(−1000) is zero in
#: double precision.
LONGEST = 1000.0
_SHORTEST = 1e-9  #: s, rise time that is no limit in any step


def first_order(
    state: ca.SX, target: ca.SX, time_constant: ca.SX, duration: float
) -> tuple[ca.SX, ca.SX]:
    """Mean over a window and value after it of a first-order lag, ``τ v̇ = target − v``.

    ``v⁺ = e v + (1 − e) target`` and ``mean = target + (v − target) (1 − e) τ/h`` with
    ``e = exp(−h/τ)``. For τ = 0 both are ``target``, bit for bit, and their derivatives are finite.

    ``state``: v at the beginning of the window. ``time_constant``: τ, s, not negative.
    ``duration``: h, s.
    """
    divisor = ca.fmax(time_constant, duration / LONGEST)
    decay = ca.exp(-duration / divisor)
    mean = target + (state - target) * (1 - decay) * (time_constant / duration)
    return mean, decay * state + (1 - decay) * target


@dataclass(frozen=True, kw_only=True)
class InputEffect(Effect):
    """An effect on one command."""

    rotor: str  #: Name of an input, or of a rotor of the model

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel = rotor_input(at.model, self.rotor)
        u = ca.SX(at.u)
        u[channel], memory = self.command(at, u[channel], (window[1] - window[0]) * step)
        return u, memory

    @abstractmethod
    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        """What arrives of a command over a part of the step (s), and the memory after it."""


@dataclass(frozen=True, kw_only=True)
class ActuatorLag(InputEffect):
    """First-order lag between the command of a rotor and its motor: ``τ v̇ = u − v``.

    An amplifier with a filter, or a speed loop inside it.
    """

    time_constant: NotNegative | None = None  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("time_constant", "s", (0.005, 0.1), "time constant τ"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("lagged", "V", "command after the lag"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        return first_order(at.own[0], u, at.sizes["time_constant"], duration)


@dataclass(frozen=True, kw_only=True)
class Backlash(InputEffect):
    """Backlash of a drive: its output follows the command only when that has crossed the play.

    ``v⁺ = clip(v, u − b, u + b)``: the play operator (Krasnosel'skii & Pokrovskii 1989).
    """

    width: NotNegative | None = None  #: b, V: half of the play

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("width", "V", (0.025, 0.15), "half width b"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("engaged", "V", "command behind the play"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        width = at.sizes["width"]
        engaged = ca.fmin(ca.fmax(at.own[0], u - width), u + width)
        return engaged, engaged


@dataclass(frozen=True, kw_only=True)
class DeadZone(InputEffect):
    """Dead zone of a rotor's drive: a command below a size has no effect.

    ``v = u − clip(u, −d, d)``: what is beyond the dead zone reaches the motor, less its width (a
    drive that needs ``d`` before it moves), so that the drive stays continuous.
    """

    width: NotNegative | None = None  #: d, V: to either side of zero

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("width", "V", (0.025, 0.15), "half width d"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        width = at.sizes["width"]
        return u - ca.fmin(ca.fmax(u, -width), width), at.own


@dataclass(frozen=True, kw_only=True)
class RateLimit(InputEffect):
    """Rate limit of a drive: ``|v̇| ≤ U/τ``, with full command U and the time τ to it from zero.

    For τ = 0 there is no limit, bit for bit.
    """

    rise_time: NotNegative | None = None  #: τ, s: from zero to full command

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("rise_time", "s", (0.1, 1.0), "time τ from zero to full command"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("limited", "V", "command behind the rate limit"),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        full, rise_time = _full_command(at, self.rotor), at.sizes["rise_time"]
        most = full * duration / ca.fmax(rise_time, _SHORTEST)
        wanted = u - at.own[0]
        short = wanted - ca.fmin(ca.fmax(wanted, -most), most)  # zero where it arrives
        moved = wanted - short
        # It is on the ramp for |moved|/most of the window, and lacks half of the way meanwhile.
        lacking = moved * ca.fabs(moved) * rise_time / (2 * full * duration)
        return u - short - lacking, u - short


@dataclass(frozen=True, kw_only=True)
class GainDrift(InputEffect):
    """The gain of a drive drifts: ``v = u (1 + g (1 − exp(−t/τ)))``, t from the first sample.

    A drive that warms up or a battery that empties, whatever is asked of it; what sags with the
    load is :class:`SupplyDerating`.
    """

    drift: Annotated[float, Meta(ge=-1, le=1)] | None = None  #: g: relative change in the end
    time_constant: Annotated[float, Meta(ge=1)] = 60.0  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size("drift", "1", (-0.15, 0.15), "relative change g of the gain"),)

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("course", "1", "0 at the first sample, 1 in the end", begins_cold=True),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        course, after = first_order(at.own[0], ca.SX(1), ca.SX(self.time_constant), duration)
        return u * (1 + at.sizes["drift"] * course), after


@dataclass(frozen=True, kw_only=True)
class SupplyDerating(InputEffect):
    """The drive of a rotor weakens as it warms up, or as its supply sags under load.

    The warmth ``θ``, cold at first, follows the load, the square of the command over its limit,
    with a first-order lag, and takes gain away::

        v = u (1 − depth θ)        τ θ̇ = (u/u_max)² − θ

    A long time constant (10 to 300 s) is a gain that falls with time in use, a zero one a supply
    that sags at once. Full command for ever ends at a gain of ``1 − depth``.
    """

    #: Share of the gain that is lost at full load for ever
    depth: Annotated[float, Meta(ge=0, le=1)]
    time_constant: NotNegative  #: τ, s

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("depth", "1", (0.0, 0.1), "gain lost at full load"),
            self.size("time_constant", "s", (10.0, 300.0), "time constant τ"),
        )

    def memory(self, step: float) -> tuple[Signal, ...]:
        return (Signal("warmth", "1", "0 cold, 1 after full load for ever", begins_cold=True),)

    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        load = (u / _full_command(at, self.rotor)) ** 2
        warmth, after = first_order(at.own[0], load, at.sizes["time_constant"], duration)
        return u * (1 - at.sizes["depth"] * warmth), after


def _full_command(at: EffectContext, rotor: str) -> float:
    return at.model.input_limits[names(at.model.inputs)[rotor_input(at.model, rotor)]]


@dataclass(frozen=True, kw_only=True)
class InputDelay(Effect):
    """Transport delay between the command of a rotor and its motor, of any fraction of a sample.

    The delayed command is piecewise constant like the command itself, but switches inside the
    sample. With its exact mean over each integration step the delay is continuous (and
    differentiable almost everywhere) as a parameter.
    """

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
