"""A real rig looked at before it is driven: what its channels read, where zero is, which way is up.

Signs are found by a small pulse on one rotor: a person says which way the beam went, as the
convention of docs/model.md has it (pitch up, yaw counter-clockwise seen from above), and the
readings say which way they went.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, cast

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.model import Model, names
from trms_cli.plants.envelope import EnvelopeSetup, envelope_of
from trms_cli.plants.hardware import HardwareRig
from trms_cli.plants.landing import landing_of
from trms_cli.plants.plant import Plant, PlantSetup
from trms_cli.plants.wiring import Wire, zeroed
from trms_cli.simulation.pace import LatePolicy, Pace
from trms_cli.simulation.rig_life import RigLanded, RigLife
from trms_cli.simulation.stop import StopRequest

#: The angle that each rotor moves, and the speed of that rotor.
MOVED_BY = {"u_v": ("alpha_v", "omega_v"), "u_h": ("alpha_h", "omega_h")}
#: Least change that counts, by unit: three steps of an encoder of 4096, some of a tacho's noise.
_LEAST = {"rad": 0.005, "rad/s": 5.0}
#: s of readings from which rest and scatter before a pulse are taken: half a swing of pitch, so
#: that a turning point is not taken for rest.
_BEFORE = 1.6
#: s, for which movement is waited for after a pulse and its landing.
_AFTER = 0.5
#: Called with the time (s), the raw numbers by channel, and the readings (n_y,) in SI.
Shown = Callable[[float, Mapping[int | str, float] | None, FloatArray], None]


@dataclass(frozen=True, kw_only=True)
class RigCheckRequest:
    """What is looked at, and for how long."""

    duration: Positive = 5.0  #: s, for which readings are shown
    step: Positive = 0.02  #: s, between two readings
    every: Positive = 0.5  #: s, between two lines of them
    zero: bool | None = None  #: Whether the present angles are those of `rest`; None: ask
    rest: Mapping[str, float] = field(default_factory=dict)  #: rad, angles where it hangs still
    pulse: NotNegative = 0.0  #: V above the safe command; 0: nothing moves
    pulse_time: Positive = 0.5  #: s
    settle: Positive = 60.0  #: s, for which the rig may swing before a pulse
    out: str | None = None  #: File for the wiring

    def __post_init__(self) -> None:
        for name in self.rest:
            if name not in ("alpha_v", "alpha_h"):
                raise ConfigurationError(
                    f"{name!r} given",
                    where=f"rest.{name}",
                    remedy="alpha_v and alpha_h have a rest",
                )
        if self.duration < self.step:
            raise ConfigurationError(
                f"{self.duration:g} s given", where="duration", remedy=f"at least {self.step:g} s"
            )


@dataclass
class RigReadings:
    """Readings over a time."""

    signals: tuple[str, ...]
    raw: list[list[float]] = field(default_factory=list)  #: A row a reading; NaN where lost
    values: list[list[float]] = field(default_factory=list)  #: The same in SI
    answers: list[float] = field(default_factory=list)  #: s, that each reading took

    def mean(self, name: str, which: str = "values") -> float:
        """Of a channel; NaN where it was never read."""
        column = np.array(getattr(self, which))[:, self.signals.index(name)]
        column = column[np.isfinite(column)]
        return float(column.mean()) if column.size else float("nan")

    def scatter(self, name: str) -> float:
        """Largest departure of a channel from its mean, SI; 0 where it was never read."""
        column = np.array(self.values)[:, self.signals.index(name)]
        column = column[np.isfinite(column)]
        return float(np.abs(column - column.mean()).max()) if column.size else 0.0

    def lost(self, name: str) -> int:
        """Readings of a channel that did not come, or were none."""
        return int(
            np.count_nonzero(~np.isfinite(np.array(self.values)[:, self.signals.index(name)]))
        )


@dataclass(frozen=True)
class Movement:
    """What a channel did during a pulse."""

    name: str
    change: float  #: Largest departure from the rest before, with its sign, SI
    scatter: float  #: Largest departure before, SI
    least: float  #: Departure that counts, SI

    @property
    def counts(self) -> bool:
        """Whether it moved by more than it scatters."""
        return abs(self.change) > max(3.0 * self.scatter, self.least)


class RigCheck:
    """A rig that is opened, looked at, pulsed, and in any case landed and closed.

    Used as a context: ``with RigCheck(plant, request) as check: …``. ``model``: one with signals of
    its own; None: a twin rotor's.
    """

    def __init__(
        self, plant: HardwareRig, request: RigCheckRequest, model: Model | None = None
    ) -> None:
        self._request, self._plant = request, plant
        step, driver = request.step, cast(Plant, plant)
        self.run = driver.init(PlantSetup(step, round(request.duration / step), 0, model))
        self.outputs, self.inputs = names(self.run.outputs), names(self.run.inputs)
        #: Angles and positions, which have a zero and rest
        self.angles = [
            name
            for name in self.outputs
            if (name.startswith("alpha") if model is None else name in _positions(model))
        ]
        self._landing = landing_of(plant).init(self.inputs, self.run.input_limits, step)
        self._pace = Pace(step, LatePolicy())
        self._life = RigLife(self.run, self._landing, self._pace)
        setup = EnvelopeSetup(step, self.inputs, self.outputs, {})
        # bounds of readings are for a wiring that is right, which is what is not known yet
        envelope = replace(envelope_of(plant), readings={}, rates={}, beyond_stops=None)
        self._channels = [plant.wiring[name].channel for name in self.outputs]
        self._u = self._landing.safe.copy()
        for i, name in enumerate(self.inputs):
            most = self.run.input_limits[1][i] - self._u[i]
            if request.pulse > most:
                raise ConfigurationError(
                    f"{request.pulse:g} V given, and {name} goes up to {most:g} V above the safe "
                    "command",
                    where="pulse",
                    remedy="a smaller pulse, or another plant.limits",
                )
        self._envelope = envelope.init(setup)

    def __enter__(self) -> RigCheck:
        try:
            self._life.connect()
        except BaseException:
            self._envelope.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        ending = "interrupted" if kind and issubclass(kind, KeyboardInterrupt) else "failed"
        try:
            self._life.close(ending if kind else "completed")
        finally:
            self._envelope.close()

    def look(self, duration: float, stop: StopRequest, show: Shown | None = None) -> RigReadings:
        """Read for a time (s); commands nothing.

        Raises KeyboardInterrupt where `stop` asks for it, RigLost for a rig that falls silent.
        """
        readings = RigReadings(self.outputs)
        self._pace.begin()
        for k in range(max(1, round(duration / self._request.step))):
            self._pace.step()
            if stop.requests:
                raise stop.error()
            begin = perf_counter()
            y = self.run.measure()
            readings.answers.append(perf_counter() - begin)
            self._note(readings, y)
            if show is not None:
                show(k * self._request.step, self.run.raw_reading, y)
        return readings

    def wait_for_rest(self, stop: StopRequest) -> RigReadings:
        """Look until the angles are at rest; the last readings.

        Raises ConfigurationError for a rig that swings on.
        """
        motion = self._plant.rest.motion
        end = perf_counter() + self._request.settle
        while True:
            readings = self.look(_BEFORE, stop)
            if all(2 * readings.scatter(name) < motion for name in self.angles):
                return readings
            if perf_counter() > end:
                raise ConfigurationError(
                    f"the rig still swings after {self._request.settle:g} s",
                    where="settle",
                    remedy=f"hold it still (plant.rest.motion: {motion:g} rad), or a longer settle",
                )

    def pulse(self, name: str, stop: StopRequest) -> list[Movement]:
        """Pulse a rotor once, land, disarm; what each channel did.

        Called where a person has agreed. Raises KeyboardInterrupt where `stop` asks for it, and
        RigLanded where the heartbeat stops; the rig is landed by then.
        """
        self._envelope.wait()
        before = self.wait_for_rest(stop)
        readings = RigReadings(self.outputs)

        def sample(u: FloatArray, y: FloatArray) -> None:
            self._u = u
            self._note(readings, y)

        self._life.prepare(lambda question: True)
        self._life.start(self._landing.safe, sample)
        try:
            self._pace.begin()
            for u in self._pulse_commands(name):
                self._pace.step()
                if stop.requests:
                    raise stop.error()
                y = self._envelope.screen(self.run.measure(), _ignored)
                if self._envelope.landing_reason:
                    raise RigLanded(self._envelope.landing_reason, where="plant.envelope")
                limited = self._envelope.limited(u, self._u, _ignored)
                self.run.advance(limited)
                sample(limited, y)
        finally:
            self._life.land(self._u, sample, lambda: stop.at_once)
            disarm = getattr(self.run, "disarm", None)
            if disarm is not None:
                disarm()
        after = self.look(_AFTER, stop)
        readings.raw += after.raw
        readings.values += after.values
        return list(_movements(before, readings, self.run.outputs))

    def _pulse_commands(self, name: str) -> Iterator[FloatArray]:
        u = self._landing.safe.copy()
        u[self.inputs.index(name)] += self._request.pulse
        for _ in range(max(1, round(self._request.pulse_time / self._request.step))):
            yield u.copy()

    def _note(self, readings: RigReadings, y: FloatArray) -> None:
        raw = self.run.raw_reading
        readings.raw.append(
            [float("nan") if raw is None else float(raw[channel]) for channel in self._channels]
        )
        readings.values.append(y.tolist())


def _positions(model: Model) -> set[str]:
    return {axis.angle for axis in model.axes.values()}


def _ignored(*event: object) -> None:
    """Events of an envelope, where there is no log."""


def _movements(
    before: RigReadings, during: RigReadings, signals: Sequence[Any]
) -> Iterator[Movement]:
    for i, signal in enumerate(signals):
        change = np.array(during.values)[:, i] - before.mean(signal.name)
        change = change[np.isfinite(change)]
        largest = float(change[np.argmax(np.abs(change))]) if change.size else 0.0
        least = _LEAST.get(signal.unit, 0.0)
        yield Movement(signal.name, largest, before.scatter(signal.name), least)


def signs_to_turn(command: str, direction: int, movements: Sequence[Movement]) -> tuple[str, ...]:
    """Signals of a rotor whose sign in the wiring is wrong.

    ``direction``: 1 where a person saw the beam go up (turn counter-clockwise) under a positive
    pulse of `command`, −1 where it went the other way. Positive commands, speeds and motions go
    together (docs/model.md, Signals).
    """
    changes = {m.name: m.change for m in movements if m.counts}
    turned = [name for name in MOVED_BY[command] if changes.get(name, direction) * direction < 0]
    return ((command,) if direction < 0 else ()) + tuple(turned)


def remarks_on(command: str, movements: Sequence[Movement]) -> list[str]:
    """What is strange in the movements under a pulse of a command."""
    by_name = {m.name: m for m in movements}
    other = "u_h" if command == "u_v" else "u_v"
    remarks = []
    speed, other_speed = (by_name.get(MOVED_BY[c][1]) for c in (command, other))
    if other_speed is not None and other_speed.counts and not (speed is not None and speed.counts):
        remarks.append(
            f"{command} turned {other_speed.name}: are the channels of the commands, or those of "
            "the speeds, exchanged?"
        )
    for name in MOVED_BY[command]:
        movement = by_name.get(name)
        if movement is not None and not movement.counts:
            remarks.append(
                f"{name} did not move by more than it scatters: its sign is left as it is; a "
                "larger pulse, or a longer pulse_time"
            )
    return remarks


def corrected_wires(
    wires: Mapping[str, Wire],
    turned: Sequence[str],
    rest: Mapping[str, float],
    rest_raw: Mapping[str, float],
) -> dict[str, Wire]:
    """Wires with some signs turned, and angles whose raw number at rest stands for `rest` (rad)."""
    corrected = {
        name: replace(wire, sign=-wire.sign) if name in turned else wire
        for name, wire in wires.items()
    }
    for name, value in rest.items():
        corrected[name] = zeroed(corrected[name], name, rest_raw[name], value)
    return corrected


def wiring_yaml(wires: Mapping[str, Wire], first_line: str) -> str:
    """An option of the group wiring."""
    lines = [
        f"# {first_line}",
        "# value = sign · unit · scale · (raw − offset), or by table: [[raw, value], …]",
    ]
    for name, wire in wires.items():
        limit = "null" if wire.limit is None else f"[{wire.limit[0]!r}, {wire.limit[1]!r}]"
        table = ", ".join(f"[{raw!r}, {value!r}]" for raw, value in wire.table)
        channel = wire.channel if isinstance(wire.channel, int) else f"'{wire.channel}'"
        unit = "null" if wire.unit is None else f"'{wire.unit}'"
        lines.append(
            f"{name}: {{channel: {channel}, sign: {wire.sign}, scale: {wire.scale!r}, "
            f"offset: {round(wire.offset, 9)!r}, unit: {unit}, limit: {limit}, table: [{table}]}}"
        )
    return "\n".join(lines) + "\n"
