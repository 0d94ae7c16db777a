"""What a rig may do, and what happens where it does more: a warning, a cut command, a landing.

Bounds on readings (angles, speeds of rotors), on how fast they change, on commands and on how fast
these change. A reading that no rig can give, infinite or far beyond a mechanical stop, is kept from
the observer, and lands the rig where it lasts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.plants.heartbeat import Heartbeat, HeartbeatMonitor

#: Takes kind, source, sentence and value of an event.
Tell = Callable[[str, str, str, float], None]
Action = Literal["warn", "clamp", "land"]
_BEYOND_STOPS = 0.5


@dataclass(frozen=True, kw_only=True)
class Bound:
    """A range, and what is done where it is left."""

    lower: float = -math.inf  #: In the signal's own unit, of rates per second
    upper: float = math.inf  #: Likewise
    action: Action = "land"  #: clamp for commands alone: a reading is what it is
    after: NotNegative = 0.0  #: s without a break, after which what is outside lands the rig

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ConfigurationError(
                f"lower {self.lower:g} and upper {self.upper:g} given",
                where="lower",
                remedy="the lower bound lies below the upper one",
            )


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """Bounds by the name of a signal."""

    #: Of measured channels: angles (rad), speeds of rotors (rad/s)
    readings: Mapping[str, Bound] = field(default_factory=dict)
    #: Of the change of measured channels from one reading to the next, per second
    rates: Mapping[str, Bound] = field(default_factory=dict)
    #: Of commands (V), within the rig's own limits
    commands: Mapping[str, Bound] = field(default_factory=dict)
    #: Largest change of commands, V/s; they are cut to it
    slew: Mapping[str, Positive] = field(default_factory=dict)
    #: rad beyond a mechanical stop from which on a reading is impossible; None: no such bound. Of a
    #: model of a user's it is, as it stands here, a share of the stop.
    beyond_stops: Positive | None = _BEYOND_STOPS
    impossible_after: NotNegative = 0.1  #: s of impossible readings, then the rig is landed
    heartbeat: Heartbeat = field(default_factory=Heartbeat)  #: Datagrams that must not stop

    def __post_init__(self) -> None:
        for group, bounds in (("readings", self.readings), ("rates", self.rates)):
            for name, bound in bounds.items():
                if bound.action == "clamp":
                    raise ConfigurationError(
                        "'clamp' given, and a reading cannot be cut",
                        where=f"envelope.{group}.{name}.action",
                        remedy="warn, or land",
                    )

    def init(self, setup: EnvelopeSetup) -> EnvelopeWatch:
        """Ready for the first sample.

        Raises ConfigurationError for a signal that the rig does not have.
        """
        for group, known in (
            ("readings", setup.outputs),
            ("rates", setup.outputs),
            ("commands", setup.inputs),
            ("slew", setup.inputs),
        ):
            for name in getattr(self, group):
                words = f"the rig has no {name!r} among {', '.join(known)}"
                require_known(name, known, words, f"plant.envelope.{group}.{name}")
        return EnvelopeWatch(self, setup)

    def reach(self, name: str, stop: float) -> tuple[float, float]:
        """What a reference for an angle with a mechanical stop (rad) may ask for, rad."""
        bound = self.readings.get(name, Bound())
        return max(-stop, bound.lower), min(stop, bound.upper)


@dataclass(frozen=True)
class EnvelopeSetup:
    """What an envelope is told before a run."""

    sample_time: float  #: s
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]  #: Measured channels, the order of y
    stops: Mapping[str, float]  #: Mechanical stops of angles to either side, rad
    bench_sizes: bool = True  #: Whether the rig is as large as small benches with two rotors


class EnvelopeWatch:
    """An envelope during one run."""

    def __init__(self, envelope: Envelope, setup: EnvelopeSetup) -> None:
        self._outputs, self._inputs = setup.outputs, setup.inputs
        self._period = setup.sample_time
        margin = math.inf if envelope.beyond_stops is None else envelope.beyond_stops
        stops = [setup.stops.get(name, math.inf) for name in setup.outputs]
        is_share = margin == _BEYOND_STOPS and not setup.bench_sizes
        self._possible = [stop + margin * (stop if is_share else 1.0) for stop in stops]
        self._bounded = [(i, at) for i, at in enumerate(self._possible) if at < math.inf]
        self._impossible_after = round(envelope.impossible_after / setup.sample_time)
        self._impossible = [0] * len(setup.outputs)
        self._readings = _by_position(envelope.readings, setup.outputs)
        self._rates = _by_position(envelope.rates, setup.outputs)
        self._commands = _by_position(envelope.commands, setup.inputs)
        self._slew = [
            (i, envelope.slew[name] * setup.sample_time)
            for i, name in enumerate(setup.inputs)
            if name in envelope.slew
        ]
        self._last: list[float] = [math.nan] * len(setup.outputs)
        self._outside: dict[tuple[str, str], int] = {}
        self._heartbeat_config = envelope.heartbeat
        self._heartbeat: HeartbeatMonitor | None = None
        self.landing_reason = ""  #: Why the rig has to land; empty while it need not

    def wait(self) -> None:
        """Wait for the heartbeat, where there is to be one, before the rig moves.

        Raises ConfigurationError where it does not come.
        """
        if self._heartbeat is None:
            self._heartbeat = self._heartbeat_config.init()
        if self._heartbeat is not None:
            self._heartbeat.wait()

    def close(self) -> None:
        """Listen no longer."""
        if self._heartbeat is not None:
            self._heartbeat.close()

    def screen(self, y: FloatArray, tell: Tell) -> FloatArray:
        """The reading (n_y,) without what no rig can give, which is NaN like a lost sample.

        Raises SimulationError for what is no reading: a mistake in a plant's code.
        """
        if self._heartbeat is not None and (silence := self._heartbeat.silence()):
            self.landing_reason = f"no heartbeat for {silence:.2f} s"
        try:
            values = y.tolist()
            count = len(values)
        except (AttributeError, TypeError):
            count = -1
        if count != len(self._outputs):
            raise SimulationError(
                f"the plant's measure() returned {y!r:.60}",
                where="plant",
                remedy=f"a float array of shape ({len(self._outputs)},) at every sample: "
                f"{', '.join(self._outputs)}",
            )
        is_usual = math.isfinite(sum(values))
        for i, limit in self._bounded:
            is_usual = is_usual and -limit <= values[i] <= limit
        if is_usual:
            if any(self._impossible):
                self._end_impossible(values, tell)
        elif all(map(_is_possible, values, self._possible)):  # samples were lost
            self._end_impossible(values, tell)
        else:
            y = self._without_impossible(y, values, tell)
            values = y.tolist()
        if self._readings or self._rates:
            self._judge(values, tell)
        return y

    def limited(self, u: FloatArray, previous: FloatArray, tell: Tell) -> FloatArray:
        """The command (n_u,) within the envelope, after ``previous``, V."""
        if not (self._slew or self._commands):
            return u
        u = u.copy()
        for i, step in self._slew:
            u[i] = min(max(u[i], previous[i] - step), previous[i] + step)
        for i, bound in self._commands:
            name, value = self._inputs[i], float(u[i])
            is_outside = not bound.lower <= value <= bound.upper
            self._note("command", name, is_outside, value, bound, tell)
            if is_outside and bound.action != "warn":  # what lands is not applied either
                u[i] = min(max(value, bound.lower), bound.upper)
        return u

    def _without_impossible(self, y: FloatArray, values: list[float], tell: Tell) -> FloatArray:
        y = y.copy()
        for i, (value, limit) in enumerate(zip(values, self._possible, strict=True)):
            name = self._outputs[i]
            if _is_possible(value, limit):
                if value == value and self._impossible[i]:
                    self._end(i, value, tell)
                continue
            y[i] = math.nan
            self._impossible[i] += 1
            if self._impossible[i] == 1:
                words = f"{name} reads {value:g}, which no rig can show; it is left out"
                tell("impossible_begin", name, words, value)
            if self._impossible[i] > self._impossible_after and not self.landing_reason:
                self.landing_reason = f"{name} reads {value:g}, which no rig can show"
        return y

    def _end_impossible(self, values: list[float], tell: Tell) -> None:
        for i, value in enumerate(values):
            if self._impossible[i] and value == value:
                self._end(i, value, tell)

    def _end(self, i: int, value: float, tell: Tell) -> None:
        self._impossible[i] = 0
        tell("impossible_end", self._outputs[i], f"{self._outputs[i]} is possible again", value)

    def _judge(self, values: list[float], tell: Tell) -> None:
        for i, bound in self._readings:
            value = values[i]
            if value == value:
                is_outside = not bound.lower <= value <= bound.upper
                self._note("reading", self._outputs[i], is_outside, value, bound, tell)
        for i, bound in self._rates:
            value, last = values[i], self._last[i]
            if value == value and last == last:
                rate = (value - last) / self._period
                is_outside = not bound.lower <= rate <= bound.upper
                self._note("rate", self._outputs[i], is_outside, rate, bound, tell)
        self._last = values

    def _note(
        self, group: str, name: str, is_outside: bool, value: float, bound: Bound, tell: Tell
    ) -> None:
        """Count samples outside a bound; tell when they begin and end; ask for a landing."""
        key = (group, name)
        count = self._outside.get(key, 0)
        if not is_outside:
            if count:
                self._outside[key] = 0
                tell("envelope_end", name, f"the {group} of {name} is within its bounds", value)
            return
        self._outside[key] = count + 1
        words = f"the {group} of {name} is {value:g}, bounds {bound.lower:g} to {bound.upper:g}"
        if not count:
            tell("envelope_begin", name, words, value)
        patience = round(bound.after / self._period)
        if bound.action == "land" and count >= patience and not self.landing_reason:
            self.landing_reason = words


def envelope_of(plant: object) -> Envelope:
    """A rig's envelope; one that says nothing of it has that of the mechanical stops."""
    envelope = getattr(plant, "envelope", None)
    return envelope if isinstance(envelope, Envelope) else Envelope()


def _is_possible(value: float, limit: float) -> bool:
    """Whether a rig can show it; a lost sample (NaN) is possible."""
    return value != value or (-limit <= value <= limit and value not in (math.inf, -math.inf))


def _by_position(bounds: Mapping[str, Bound], names: Sequence[str]) -> list[tuple[int, Bound]]:
    return [(names.index(name), bound) for name, bound in bounds.items()]


def beyond_reach(
    references: FloatArray,
    controlled: Sequence[str],
    envelope: Envelope,
    stops: Mapping[str, float],
    units: Mapping[str, str],
) -> list[str]:
    """A sentence for each angle whose reference (samples, n_r) a rig cannot follow."""
    sentences = []
    for column, name in enumerate(controlled):
        low, high = envelope.reach(name, stops.get(name, math.inf))
        least, most = float(np.min(references[:, column])), float(np.max(references[:, column]))
        if least < low or most > high:
            worst = most if most - high >= low - least else least
            sentences.append(
                f"the reference of {name} goes to {worst:.4g} {units[name]}, the rig from "
                f"{low:.4g} to {high:.4g} {units[name]}"
            )
    return sentences
