"""Recordings for a model: the channels it needs, in its units, on a uniform grid.

What fits, validations, diagnoses and replays read. A row's command acts from the row's time until
the next one, as in this program's own logs; a recorder that writes down what it is about to send
has it act some samples later. The recording brings its sample time; what it lacks is missing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from trms_cli.core.arrays import FloatArray, hold_last, stretches
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model, Signal, names
from trms_cli.recordings.channels import STANDARD, Vocabulary, reference_of
from trms_cli.recordings.mcap_recording import sha256_of
from trms_cli.recordings.preparation import Preparation
from trms_cli.recordings.read import read_recording
from trms_cli.recordings.recording import GriddedRecording, Recording, on_grid

#: A channel with more runs of missing samples than this gets one event instead of one each.
_MOST_EVENTS = 20


class RecordingEvent(NamedTuple):
    """Something in the recording that a reader of the log should know."""

    sample: int  #: index of the sample
    kind: str  #: gap, missing
    source: str  #: the channel, or ``recording``
    message: str
    value: float  #: how long it lasts, s


@dataclass(frozen=True)
class RecordedRun:
    """What a recording holds, in the order of a model's signals."""

    sample_time: float  #: s
    time: FloatArray  #: (n,) array; s, the rig's own
    #: ``inputs``, ``outputs``: Outputs are those that the model has and the recording measured
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    #: (n, n_u) array; as they act from each sample on, in the model's units; the last one is held
    #: where the recording has none
    commands: FloatArray
    measurements: FloatArray  #: (n, n_y) array; NaN where missing
    #: dict of str to (n,) arrays; recorded references by the angle they are for, rad; empty if
    #: there are none
    references: Mapping[str, FloatArray]
    noise_sd: Mapping[str, float]  #: Declared noise of each output, quantum included
    input_limits: tuple[FloatArray, FloatArray]  #: Lower and upper bounds of the model's inputs
    happenings: tuple[RecordingEvent, ...]
    remarks: tuple[str, ...]  #: Sentences for the user: what was found, what has no part in it
    recording: Recording  #: As it was read

    @property
    def sha256(self) -> str:
        """Of the file's bytes, hexadecimal."""
        return sha256_of(self.recording.source)

    #: A recording does not tell what was true.
    states: tuple[Signal, ...] = ()

    def __len__(self) -> int:
        return len(self.time)


class MeasuredChannels(Protocol):
    """Which channels are used, and their declared noise."""

    @property
    def channels(self) -> tuple[str, ...] | None:
        """Those that are asked for; None: all."""

    def measured(self, available: tuple[str, ...]) -> tuple[str, ...]:
        """Those of the available channels that are used."""

    def declared_noise(self, channels: tuple[str, ...]) -> dict[str, float]:
        """Standard deviation of each, quantum included."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What of a recording a model takes, and what its signals are in the model's units."""

    sensors: MeasuredChannels
    start: float | None = None  #: Part of the recording to take, s in its own time
    end: float | None = None  #: None for all
    #: Name of a signal's column in the file, where it has another one
    names: Mapping[str, str] = field(default_factory=dict)
    #: By input: what a recorded 1 is in the model's unit, where the units differ
    input_scale: Mapping[str, float] = field(default_factory=dict)
    command_delay: int = 0  #: Samples from a row's time until its command acts
    #: Largest deviation of a step from whole sample times, as a share of one
    jitter: float = 0.2

    def __post_init__(self) -> None:
        for name, scale in self.input_scale.items():
            if not (np.isfinite(scale) and scale != 0):
                raise ConfigurationError(
                    f"{scale!r} given",
                    where=f"input_scale.{name}",
                    remedy="what a recorded 1 is in the model's unit, not 0",
                )

    def read(
        self, file: str, model: Model, preparation: Preparation | None = None
    ) -> list[RecordedRun]:
        """Read a file (CSV, MAT or MCAP) for a model, made ready on request.

        Gives one, unless the recording is split; their remarks tell what was found and done.

        Raises RecordingError if it cannot be read or is not evenly sampled, or what is asked for
        cannot be done, and ConfigurationError if its channels or units are not those of the model.
        """
        vocabulary = Vocabulary.of(model, self.names, self.sensors.channels or ())
        part = self.part_of(read_recording(Path(file).expanduser(), vocabulary))
        parts = [part] if preparation is None else preparation.apply(part)
        return [self.take(each, model) for each in parts]

    def take(self, recording: Recording, model: Model) -> RecordedRun:
        """Check a recording in memory, all of it, against the model.

        ``start`` and ``end`` have no part in it: see :meth:`part_of`.

        Raises RecordingError, ConfigurationError as :meth:`read` does.
        """
        inputs = self._inputs(recording, model)
        available = tuple(name for name in names(model.outputs) if name in recording.channels)
        if not available:
            raise ConfigurationError(
                f"the recording measures {_listed(recording.names('output'))}, the model "
                f"{model.name!r} {_listed(names(model.outputs))}",
                where="plant.file",
                remedy="choose a model that has one of the recorded channels",
            )
        channels = self.sensors.measured(available)
        outputs = tuple(s for name in channels for s in model.outputs if s.name == name)
        gridded = on_grid(recording, self.jitter)
        commands = np.column_stack(
            [gridded.channels[s.name] * self.input_scale.get(s.name, 1.0) for s in inputs]
        )
        # some samples later, until which the first one acts
        acting = np.maximum(np.arange(len(commands)) - self.command_delay, 0)
        references = {
            signal: gridded.channels[reference_of(signal)]
            for signal in model.controlled
            if reference_of(signal) in gridded.channels
        }
        return RecordedRun(
            gridded.sample_time,
            gridded.time,
            inputs,
            outputs,
            _hold_commands(commands, names(inputs), gridded)[acting],
            np.column_stack([gridded.channels[name] for name in channels]),
            references,
            self.sensors.declared_noise(channels),
            model.input_bounds(),
            tuple(_happenings(gridded, channels, names(inputs))),
            (*recording.notes(), *_left_out(recording, model, channels)),
            recording,
        )

    def part_of(self, recording: Recording) -> Recording:
        """The rows from ``start`` to ``end``.

        Raises ConfigurationError if fewer than two are left.
        """
        start = -np.inf if self.start is None else self.start
        end = np.inf if self.end is None else self.end
        mask = (recording.time >= start) & (recording.time <= end)
        if np.count_nonzero(mask) < 2:
            raise ConfigurationError(
                f"fewer than two samples lie from {start:g} to {end:g} s",
                where="plant.start" if self.start is not None else "plant.end",
                remedy=f"the recording goes from {recording.time[0]:g} to {recording.time[-1]:g} s",
            )
        if mask.all():
            return recording
        return recording.select_rows(mask)

    def _inputs(self, recording: Recording, model: Model) -> tuple[Signal, ...]:
        """The model's inputs, all recorded, all in the model's unit or scaled to it."""
        input_names = names(model.inputs)
        missing = [name for name in input_names if name not in recording.channels]
        if missing:
            raise ConfigurationError(
                f"the recording has no {_listed(missing)}; its inputs are "
                f"{_listed(recording.names('input'))}",
                where="plant.file",
                remedy=f"model {model.name!r} needs {_listed(input_names)}; "
                + (
                    "with one rotor at rest choose a model of one axis, as model=newtonian_vertical"
                    if STANDARD.knows(input_names)
                    else "plant.names={SIGNAL: COLUMN} tells which columns they are"
                ),
            )
        unknown = [name for name in self.input_scale if name not in input_names]
        if unknown:
            raise ConfigurationError(
                f"the model has no input {unknown[0]!r}",
                where=f"plant.input_scale.{unknown[0]}",
                remedy=f"its inputs are {_listed(input_names)}",
            )
        differing = [
            signal
            for signal in model.inputs
            if recording.units[signal.name] != signal.unit and signal.name not in self.input_scale
        ]
        if differing:
            recorded, own = recording.units[differing[0].name], differing[0].unit
            other = {"1": "model=tras takes 1", "V": "model=newtonian takes V"}.get(recorded, "")
            other = f" ({other})" if STANDARD.knows(input_names) else ""
            # A normalised record's full scale is likely the model's; volts, likely the TRAS's 24.
            scale = ", ".join(
                f"{s.name}: {1 / 24 if own == '1' else model.input_limits[s.name]:.4g}"
                for s in differing
            )
            raise ConfigurationError(
                f"{recording.source} gives {_listed(names(differing))} in [{recorded}]"
                f"{' (share of the full command)' if recorded == '1' else ''}, the model "
                f"{model.name!r} takes [{own}]",
                where="plant.file",
                remedy=f"choose the model of that rig{other}, or tell what a recorded "
                f"1 is in {own}, as 'plant.input_scale={{{scale}}}'",
            )
        return model.inputs


def _listed(items: Sequence[str]) -> str:
    return ", ".join(items) or "nothing"


def _hold_commands(
    commands: FloatArray, inputs: Sequence[str], gridded: GriddedRecording
) -> FloatArray:
    """Commands with the last value held where none is recorded."""
    commands = commands.copy()
    for column, name in zip(commands.T, inputs, strict=True):
        present = ~np.isnan(column)
        if not present[0]:
            first = float(gridded.time[int(np.argmax(present))]) if present.any() else np.nan
            raise ConfigurationError(
                f"the recording begins without a value of {name}",
                where="plant.file",
                remedy=f"begin where it has one: plant.start={first:g}"
                if present.any()
                else f"{name} is empty throughout; choose a model without this input",
            )
        column[:] = hold_last(column)
    return commands


def _happenings(
    gridded: GriddedRecording, channels: Sequence[str], inputs: Sequence[str]
) -> list[RecordingEvent]:
    """Gaps and missing samples in order of time."""
    happenings: list[RecordingEvent] = []

    def add(begin: int, end: int, kind: str, source: str, words: str) -> None:
        count = end - begin
        message = f"{count} samples {words} (value in s)"
        duration = count * gridded.sample_time
        happenings.append(RecordingEvent(begin, kind, source, message, duration))

    for begin, end in stretches(~gridded.present):
        words = "are missing, the commands of the last one held"
        add(begin, end, "gap", "recording", words)
    for name in (*channels, *inputs):
        meaning = ", the last one held" if name in inputs else ""
        missing = stretches(np.isnan(gridded.channels[name]) & gridded.present)
        if len(missing) > _MOST_EVENTS:
            first = missing[0][0]
            missing = [(first, first + sum(end - begin for begin, end in missing))]
        for begin, end in missing:
            add(begin, end, "missing", name, f"of {name} are missing{meaning}")
    return sorted(happenings)


def _left_out(recording: Recording, model: Model, channels: Sequence[str]) -> list[str]:
    """What of the recording the observer does not see."""
    signals = {*channels, *names(model.inputs)}
    used = {*signals, *recording.names("reference")}
    unused = [name for name in recording.channels if name not in used]
    absent = [name for name in names(model.outputs) if name not in channels]
    remarks = []
    if unused:
        remarks.append(f"not used: {', '.join(unused)}")
    if absent:
        vocabulary = recording.vocabulary
        described = ", ".join(
            f"{name} ({channel.description})"
            if (channel := vocabulary.find(name)) and channel.description
            else name
            for name in absent
        )
        remarks.append(f"not measured: {described}")
    return remarks
