"""What every real rig has: wiring, limits, a landing, an envelope; how it is read and commanded."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
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
from trms_cli.plants.landing import ROTOR_COMMANDS, Landing
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.wiring import Wire, Wiring, check_wires
from trms_cli.recordings.channels import STANDARD, Vocabulary

#: Signals of a twin rotor that can be wired, in their order.
READINGS = tuple(STANDARD.of_role(STANDARD.channels, "output"))
COMMANDS = ROTOR_COMMANDS


class RigLost(SimulationError):
    """A rig that no longer answers, or no longer obeys."""


@dataclass(frozen=True, kw_only=True)
class RestCheck:
    """What a rig has to show before it is armed."""

    duration: NotNegative = 0.5  #: s, for which it is looked at; 0: not at all
    #: rad or m, by which an angle or position may move meanwhile: more than that is not at rest
    motion: Positive = 0.05


@dataclass(frozen=True, kw_only=True)
class HardwareRig:
    """What every real rig's configuration holds."""

    #: Wires by signal: outputs and inputs of the model; of a twin rotor alpha_v, alpha_h, omega_v,
    #: omega_h, and u_v, u_h
    wiring: Annotated[Mapping[str, Wire], Meta(min_length=1)]
    sensors: Sensors = field(default_factory=Sensors)  #: Declared noise and quanta of the readings
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)  #: Of commands, SI
    first_command: Mapping[str, float] = field(default_factory=dict)  #: SI; ramped to before a run
    landing: Landing = field(default_factory=lambda: Landing(hold=0.5))
    envelope: Envelope = field(default_factory=Envelope)
    rest: RestCheck = field(default_factory=RestCheck)
    arm: bool = False  #: Whether to arm without asking a person
    lost_after: Positive = 0.25  #: s without a reading, after which the rig is given up

    @property
    def real_time(self) -> bool:
        """A real rig does not wait."""
        return True


class HardwareRun(ABC):
    """What every real rig does during a run; a driver adds how it reads and writes.

    Beside what is abstract here it defines ``connect``, ``arm``, ``disarm`` and ``close`` as it
    needs them.
    """

    states: tuple[Signal, ...] = ()
    state = np.zeros(0)
    known_disturbances: Mapping[str, FloatArray] = {}

    def __init__(self, rig: HardwareRig, setup: PlantSetup) -> None:
        self.rig, self._setup = rig, setup
        vocabulary = STANDARD if setup.model is None else Vocabulary.of(setup.model)
        where = "plant.wiring"
        known = vocabulary.channels if vocabulary.origin == "standard" else vocabulary.needed
        names = [vocabulary.of_role(known, role) for role in ("output", "input")]
        check_wires(rig.wiring, where, [*names[1], *names[0]])
        for own, what in zip(names, ("readings", "commands"), strict=True):
            if not any(name in rig.wiring for name in own):
                raise ConfigurationError(
                    f"no {what} are wired",
                    where=where,
                    remedy=f"a channel and a sign for at least one of {', '.join(own)}",
                )
        self._readings, self._commands = (
            Wiring(rig.wiring, own, where, vocabulary) for own in names
        )
        self.outputs, self.inputs = self._readings.signals, self._commands.signals
        self.noise_sd = rig.sensors.declared_noise(self._readings.names)
        self.first_command = np.zeros(len(self.inputs))
        lower, upper = self._commands.limits()
        for name, (low, high) in rig.limits.items():
            if name in COMMANDS and name not in self._commands.names:
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
            if signal.unit in ("rad", "m") and moved > rest.motion:
                raise ConfigurationError(
                    f"{signal.name} moved by {moved:.3g} {signal.unit} in {rest.duration:g} s: the "
                    "rig is not at rest",
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
        """Send a command (n_u,), SI; one that is no number becomes the safe one."""
        values = command.tolist()
        if not all(map(math.isfinite, values)):
            values = self._safe.tolist()
        self._write(dict(zip(self._commands.channels, self._commands.raw(values), strict=True)))

    @abstractmethod
    def _read(self) -> Mapping[int | str, float] | None:
        """Raw numbers by channel; None where none came in time."""

    @abstractmethod
    def _write(self, raw: Mapping[int | str, float]) -> None:
        """Send raw numbers by channel."""

    def _now(self) -> float:
        return time.perf_counter()

    def _pause(self, duration: float) -> None:
        time.sleep(duration)
