"""A real rig behind a wire, whatever carries the frames: its life, its readings, its commands."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.model import Signal
from trms_cli.plants.envelope import Envelope
from trms_cli.plants.landing import Landing
from trms_cli.plants.link.frames import (
    SEQUENCE_RANGE,
    BadFrame,
    Frame,
    Kind,
    RigStatus,
    all_finite,
    decode,
)
from trms_cli.plants.link.transport import Transport
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.wiring import Wire, Wiring, check_wires

#: s between two tries of what has to be answered.
_AGAIN = 0.1
_READINGS = ("alpha_v", "alpha_h", "omega_v", "omega_h")
_COMMANDS = ("u_v", "u_h")


class RigLost(SimulationError):
    """A rig that no longer answers, or no longer obeys."""


@dataclass(frozen=True, kw_only=True)
class RestCheck:
    """What a rig has to show before it is armed."""

    duration: NotNegative = 0.5  #: s, for which it is looked at; 0: not at all
    #: rad, by which an angle may move meanwhile: more than that is not at rest
    motion: Positive = 0.05


@dataclass(frozen=True, kw_only=True)
class HardwareRig:
    """What every real rig's configuration holds."""

    #: Wires by signal: readings alpha_v, alpha_h, omega_v, omega_h; commands u_v, u_h
    wiring: Annotated[Mapping[str, Wire], Meta(min_length=1)]
    sensors: Sensors = field(default_factory=Sensors)  #: Declared noise and quanta of the readings
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)  #: Of commands, V
    first_command: Mapping[str, float] = field(default_factory=dict)  #: V; ramped to before a run
    landing: Landing = field(default_factory=lambda: Landing(hold=0.5))
    envelope: Envelope = field(default_factory=Envelope)
    rest: RestCheck = field(default_factory=RestCheck)
    arm: bool = False  #: Whether to arm without asking a person
    lost_after: Positive = 0.25  #: s without a reading, after which the rig is given up

    @property
    def real_time(self) -> bool:
        """A real rig does not wait."""
        return True

    def __post_init__(self) -> None:
        check_wires(self.wiring, "wiring")
        for names, what in ((_READINGS, "readings"), (_COMMANDS, "commands")):
            if not any(name in self.wiring for name in names):
                raise ConfigurationError(
                    f"no {what} are wired",
                    where="wiring",
                    remedy=f"a channel and a sign for at least one of {', '.join(names)}",
                )


class HardwareRun:
    """What every real rig does during a run; a driver adds how it reads and writes.

    A driver defines ``_read() -> list of raw numbers, or None where none came in time``, ``_write
    (raw)``, and ``connect``, ``arm``, ``disarm``, ``close`` as it needs them.
    """

    states: tuple[Signal, ...] = ()
    state = np.zeros(0)
    known_disturbances: Mapping[str, FloatArray] = {}

    def __init__(self, rig: HardwareRig, setup: PlantSetup) -> None:
        self.rig, self._setup = rig, setup
        self._readings = Wiring(rig.wiring, _READINGS, "plant.wiring")
        self._commands = Wiring(rig.wiring, _COMMANDS, "plant.wiring")
        self.outputs, self.inputs = self._readings.signals, self._commands.signals
        self.noise_sd = rig.sensors.declared_noise(self._readings.names)
        self.first_command = np.zeros(len(self.inputs))
        lower, upper = self._commands.limits()
        for name, (low, high) in rig.limits.items():
            if name in _COMMANDS and name not in self._commands.names:
                continue  # a rig of one axis has the limits of the rotor that it has
            words = f"the rig has no command {name!r}"
            require_known(name, self._commands.names, words, f"plant.limits.{name}")
            i = self._commands.names.index(name)
            lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
        for i, name in enumerate(self._commands.names):
            if not (math.isfinite(lower[i]) and math.isfinite(upper[i])):
                raise ConfigurationError(
                    f"{name} has no limits",
                    where=f"plant.limits.{name}",
                    remedy=f"what the rig's amplifier takes: plant.limits.{name}=[-2.5,2.5]",
                )
        self.input_limits = (lower, upper)
        for name, value in rig.first_command.items():
            words = f"the rig has no command {name!r}"
            require_known(name, self._commands.names, words, f"plant.first_command.{name}")
            self.first_command[self._commands.names.index(name)] = value
        self._safe = rig.landing.init(
            self._commands.names, self.input_limits, setup.sample_time
        ).safe
        self._silent_since: float | None = None
        #: The last reading as it came, by channel; None where none came in time
        self.raw_reading: Mapping[int | str, float] | None = None

    @property
    def confirmation(self) -> str:
        """What a person confirms before the rig moves; empty where nobody is asked."""
        return "" if self.rig.arm else "the rig will move"

    def check(self) -> None:
        """Look at the rig for a while: readings are there, possible, and at rest.

        Raises ConfigurationError for a rig that is not as it has to be before a run.
        """
        rest = self.rig.rest
        if not rest.duration:
            return
        end = self._now() + rest.duration
        rows: list[FloatArray] = []
        while self._now() < end or not rows:
            y = self.measure()
            rows.append(y)
            self._pause(min(self._setup.sample_time, 0.02))
        readings = np.array(rows)
        for i, signal in enumerate(self.outputs):
            column = readings[:, i][np.isfinite(readings[:, i])]
            where = f"plant.wiring.{signal.name}"
            if not column.size:
                raise ConfigurationError(
                    f"no reading of {signal.name} in {rest.duration:g} s is a possible one",
                    where=where,
                    remedy="`trms rig check` shows what comes in; the wire's limit may be wrong",
                )
            moved = float(np.ptp(column))
            if signal.unit == "rad" and moved > rest.motion:
                raise ConfigurationError(
                    f"{signal.name} moved by {moved:.3g} rad in {rest.duration:g} s: the rig is "
                    "not at rest",
                    where="plant.rest.motion",
                    remedy="wait until it hangs still; plant.rest.duration=0 looks away",
                )

    def measure(self) -> FloatArray:
        """The readings (n_y,); NaN where none came in time.

        Raises RigLost where none has come for ``lost_after``.
        """
        raw = self.raw_reading = self._read()
        now = self._now()
        if raw is None:
            self._silent_since = now if self._silent_since is None else self._silent_since
            if now - self._silent_since >= self.rig.lost_after:
                raise RigLost(
                    f"the rig has not answered for {now - self._silent_since:.2f} s",
                    where="plant",
                    remedy="cable, power and the program of the other side; plant.lost_after "
                    f"({self.rig.lost_after:g} s) says how long to wait",
                )
            return np.full(len(self.outputs), np.nan)
        self._silent_since = None
        return self._readings.values([raw[channel] for channel in self._readings.channels])

    def advance(self, command: FloatArray) -> None:
        """Send a command (n_u,), V; one that is no number becomes the safe one."""
        values = command.tolist()
        if not all_finite(values):
            values = self._safe.tolist()
        self._write(dict(zip(self._commands.channels, self._commands.raw(values), strict=True)))

    def _read(self) -> Mapping[int | str, float] | None:
        raise NotImplementedError

    def _write(self, raw: Mapping[int | str, float]) -> None:
        raise NotImplementedError

    def _now(self) -> float:
        return time.perf_counter()

    def _pause(self, duration: float) -> None:
        time.sleep(duration)


@dataclass(frozen=True, kw_only=True)
class LinkedRig(HardwareRig):
    """A rig that speaks the frames of docs/rig-frames.md."""

    connect_timeout: Positive = 3.0  #: s, for which the rig is called
    #: s, for which a reading is waited for; None: a quarter of the sample time
    reply_timeout: Positive | None = None
    watchdog: Positive = 0.1  #: s without a command, after which the rig lands by itself

    def __post_init__(self) -> None:
        super().__post_init__()
        for names in (_READINGS, _COMMANDS):
            count = sum(name in self.wiring for name in names)
            for name in names:
                wire = self.wiring.get(name)
                if wire is not None and not (
                    isinstance(wire.channel, int) and 0 <= wire.channel < 64
                ):
                    raise ConfigurationError(
                        f"{wire.channel!r} given",
                        where=f"wiring.{name}.channel",
                        remedy=f"the number's position in a frame, from 0: 0 to {count - 1} "
                        f"for {count} of them",
                    )


class LinkedRun(HardwareRun):
    """Such a rig during one run.

    ``open_transport``: called once, on ``connect``.
    """

    rig: LinkedRig

    def __init__(self, rig: LinkedRig, setup: PlantSetup) -> None:
        super().__init__(rig, setup)
        if rig.watchdog < 2 * setup.sample_time:
            raise ConfigurationError(
                f"{rig.watchdog:g} s given, and commands come every {setup.sample_time:g} s",
                where="plant.watchdog",
                remedy=f"at least two sample times: {2 * setup.sample_time:g} s",
            )
        self._patience = rig.reply_timeout or 0.25 * setup.sample_time
        self._n_u = 1 + max(int(c) for c in self._commands.channels)
        self._n_y = 1 + max(int(c) for c in self._readings.channels)
        self._session = int.from_bytes(os.urandom(4), "little")
        self._sequence = 0
        self._transport: Transport | None = None
        self._is_armed = False
        #: Frames that were no answer to what was asked: late, doubled, spoilt
        self.stray_frames = 0
        self.lost_readings = 0

    def _open(self) -> Transport:
        raise NotImplementedError

    def _address(self) -> tuple[str, str]:
        """What the rig is called by, and where that stands in the configuration."""
        raise NotImplementedError

    def connect(self) -> None:
        """Call the rig until it answers.

        Raises ConfigurationError for one that is silent, speaks another version, or has other
        commands and readings than the wiring.
        """
        address, where = self._address()
        self._transport = self._open()
        numbers = (self._setup.sample_time, self.rig.watchdog, float(self._n_u), float(self._n_y))
        end = self._now() + self.rig.connect_timeout
        refusal: BadFrame | None = None
        while self._now() < end:
            try:
                answer = self._ask(Kind.HELLO, numbers, _AGAIN, (Kind.WELCOME,), strict=True)
            except BadFrame as error:
                refusal = error
                self._pause(_AGAIN)
                continue
            if answer is not None and len(answer.numbers) >= 3:
                self._check_welcome(answer, where)
                return
        if refusal is not None:
            raise ConfigurationError(
                f"{address} answers with {refusal.problem}",
                where=where,
                remedy=refusal.remedy or "is it the rig's program that listens there?",
            )
        raise ConfigurationError(
            f"no answer from {address} within {self.rig.connect_timeout:g} s",
            where=where,
            remedy="start the rig's program (a simulated one: `trms rig serve`), and look at the "
            "address, the cable and the firewall",
        )

    def _check_welcome(self, answer: Frame, where: str) -> None:
        watchdog, n_u, n_y = answer.numbers[:3]
        for own, theirs, what in (
            (self._n_u, int(n_u), "commands"),
            (self._n_y, int(n_y), "readings"),
        ):
            if own > theirs:
                raise ConfigurationError(
                    f"the rig has {theirs} {what}, the wiring uses {own}",
                    where="plant.wiring",
                    remedy="`trms rig check` shows what each channel reads",
                )
        if not 0.0 < watchdog <= 1.001 * self.rig.watchdog:
            raise ConfigurationError(
                f"the rig's watchdog takes {watchdog:g} s, {self.rig.watchdog:g} s were asked for",
                where="plant.watchdog",
                remedy=f"plant.watchdog={watchdog:g}, or a rig that lands earlier by itself",
            )

    def arm(self) -> None:
        """From now on commands act.

        Raises RigLost where the rig does not say that they do.
        """
        self._change_state(Kind.ARM, RigStatus.ARMED)
        self._is_armed = True

    def disarm(self) -> None:
        """Commands act no longer; the rig holds its safe command."""
        self._is_armed = False
        if self._transport is not None:
            self._change_state(Kind.DISARM, RigStatus(0))

    def close(self, reason: str) -> None:
        """Let go of the wire."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None

    def _change_state(self, kind: Kind, wanted: RigStatus) -> None:
        end = self._now() + max(1.0, 3 * _AGAIN)
        while self._now() < end:
            answer = self._ask(kind, (), _AGAIN, (Kind.READING,))
            if answer is not None and RigStatus(answer.status) & RigStatus.ARMED == wanted:
                return
        status = "no answer" if answer is None else _status_words(RigStatus(answer.status))
        raise RigLost(
            f"the rig did not {kind.name.lower()} ({status})",
            where="plant",
            remedy="look at the emergency stop and at the rig's own display",
        )

    def _read(self) -> Mapping[int | str, float] | None:
        answer = self._ask(Kind.READ, (), self._patience, (Kind.READING,))
        if answer is None or len(answer.numbers) < self._n_y:
            self.lost_readings += 1
            return None
        status = RigStatus(answer.status)
        if status & (RigStatus.EMERGENCY | RigStatus.FAULT):
            raise RigLost(f"the rig reports: {_status_words(status)}", where="plant")
        if self._is_armed and not status & RigStatus.ARMED:
            raise RigLost(
                f"the rig is no longer armed: {_status_words(status)}",
                where="plant",
                remedy="its watchdog lands it where no command comes for "
                f"{self.rig.watchdog:g} s; `/timing` of the log shows late samples",
            )
        return dict(enumerate(answer.numbers))

    def _write(self, raw: Mapping[int | str, float]) -> None:
        numbers = [0.0] * self._n_u
        for channel, value in raw.items():
            numbers[int(channel)] = value
        self._send(Kind.COMMAND, tuple(numbers))

    def _send(self, kind: Kind, numbers: tuple[float, ...]) -> int:
        assert self._transport is not None
        self._sequence = (self._sequence + 1) % SEQUENCE_RANGE
        time_us = int(self._now() * 1e6)
        frame = Frame(kind, self._sequence, self._session, time_us, 0, 0, numbers)
        self._transport.send(frame.encode())
        return self._sequence

    def _ask(
        self,
        kind: Kind,
        numbers: tuple[float, ...],
        patience: float,
        kinds: tuple[Kind, ...],
        *,
        strict: bool = False,
    ) -> Frame | None:
        """Send, and wait for the answer; None where it did not come in time.

        Raises BadFrame, where ``strict``, for bytes that are no frame of this version.
        """
        assert self._transport is not None
        sequence = self._send(kind, numbers)
        end = self._now() + patience
        while True:
            data = self._transport.receive(end - self._now())
            if data is None:
                return None
            try:
                frame = decode(data)
            except BadFrame:
                self.stray_frames += 1
                if strict:
                    raise
                continue
            if (
                frame.session == self._session
                and frame.sequence == sequence
                and frame.kind in kinds
            ):
                return frame
            self.stray_frames += 1


def _status_words(status: RigStatus) -> str:
    words = {
        RigStatus.EMERGENCY: "emergency stop",
        RigStatus.FAULT: "fault",
        RigStatus.WATCHDOG: "watchdog",
        RigStatus.ARMED: "armed",
    }
    return ", ".join(text for flag, text in words.items() if status & flag) or "disarmed"
