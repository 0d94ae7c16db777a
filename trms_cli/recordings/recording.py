"""A recording: what a rig did, on one time grid, in SI units, wherever it came from.

A filter in discrete time needs a uniform grid. Every row goes to the grid point that its step leads
to; points without a row are missing samples (NaN). Steps that lie between two points are refused: a
filter that took them for whole samples would misread every rate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.channels import STANDARD, Vocabulary

#: A step longer than this many sample times is a gap: at least one sample is not there.
GAP_FACTOR = 1.5
#: The same where the clock jitters by so much that a step of one sample may be as long.
JITTERING_GAP_FACTOR = 2.5
#: rad. Cables and stops keep either axis of a twin rotor below it.
FULL_TURN = 2 * np.pi
#: Deviations of the step below this share of the sample time are not worth a word.
JITTER_SHARE = 0.01
#: s; rigs of this kind swing within seconds, so a longer sample time is a slip of the unit.
SLOW_SAMPLE = 1.0


@dataclass(frozen=True)
class Recording:
    """Signals of a rig over time. Missing samples are NaN, gaps are steps of ``time``."""

    time: np.ndarray  #: (n,) float array [s]; strictly rising, n >= 2
    #: dict of str to (n,) float array; by name, in SI; commands in V, or in "1" when normalised to
    #: full scale
    channels: dict[str, np.ndarray]
    units: dict[str, str]  #: SI unit per channel
    metadata: dict[str, str] = field(default_factory=dict)  #: What the file says about itself
    source: Path = Path()  #: Where it was read from
    remarks: tuple[str, ...] = ()  #: What the reader found worth telling
    vocabulary: Vocabulary = STANDARD  #: What its channels are

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def sample_time(self) -> float:
        """Median step of time [s], to the picosecond: 0.02, not 0.0199999999."""
        return round(float(np.median(np.diff(self.time))), 12)

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last [s]."""
        return round(float(self.time[-1] - self.time[0]), 9)

    @cached_property
    def gaps(self) -> list[tuple[float, float]]:
        """The last time before each gap and the first after it [s]; not what the clock jitters."""
        factor = JITTERING_GAP_FACTOR if self.jitters else GAP_FACTOR
        wide = np.flatnonzero(np.diff(self.time) > factor * self.sample_time)
        return [(float(self.time[i]), float(self.time[i + 1])) for i in wide]

    @property
    def jitters(self) -> bool:
        """Whether long steps are made up for by short ones, which lost samples never are."""
        long, short = self._uneven
        return short > 0 and short >= 0.5 * long > 0

    @cached_property
    def _uneven(self) -> tuple[int, int]:
        """Steps as long as a gap of one sample, and steps that are short by as much."""
        steps = np.diff(self.time) / self.sample_time
        long = (steps > GAP_FACTOR) & (steps <= JITTERING_GAP_FACTOR)
        return int(np.count_nonzero(long)), int(np.count_nonzero(steps < 2 - GAP_FACTOR))

    @cached_property
    def missing(self) -> dict[str, int]:
        """How many samples each channel lacks within the rows; only channels that lack any."""
        counts = {name: int(np.isnan(values).sum()) for name, values in self.channels.items()}
        return {name: count for name, count in counts.items() if count}

    def names(self, role: str) -> list[str]:
        """Names of the channels of a role, as "input" or "output", in the file's order."""
        return self.vocabulary.of_role(self.channels, role)

    @property
    def held_channels(self) -> set[str]:
        """Names of the channels that are held from row to row: commands and references."""
        return {*self.names("input"), *self.names("reference")}

    def select_rows(self, rows: np.ndarray | slice, *remarks: str) -> Recording:
        """The recording of some rows, with what there is to say of that."""
        channels = {name: values[rows] for name, values in self.channels.items()}
        return self.with_remarks(*remarks, time=self.time[rows], channels=channels)

    def with_remarks(self, *remarks: str, **changed: Any) -> Recording:
        """The recording with further remarks, and other fields where they have changed."""
        return replace(self, remarks=(*self.remarks, *remarks), **changed)

    def notes(self) -> list[str]:
        """Tell in sentences what a user should know before trusting the numbers."""
        lines = list(self.remarks)
        if self.sample_time > SLOW_SAMPLE:
            lines.append(f"{self.sample_time:.4g} s a sample: is t in ms? Then write t[ms]")
        if self.gaps:
            lost_samples = sum(round((b - a) / self.sample_time) - 1 for a, b in self.gaps)
            start, end = max(self.gaps, key=lambda gap: gap[1] - gap[0])
            number = "a gap" if len(self.gaps) == 1 else f"{len(self.gaps)} gaps"
            lines.append(
                f"{number} in t, about {lost_samples} samples in all; "
                f"the longest from {start:.6g} to {end:.6g} s"
            )
        for name, count in self.missing.items():
            lines.append(f"{name}: {count} of {len(self)} samples missing")
        for name in self.names("output"):
            largest = float(np.nanmax(np.abs(self.channels[name]), initial=0.0))
            bench = self.vocabulary.origin == "standard"
            if bench and self.units[name] == "rad" and largest > FULL_TURN:
                lines.append(
                    f"{name} reaches {largest:.4g} rad ({np.degrees(largest):.4g}°), more than a "
                    "full turn, which no rig of this kind makes: is its unit right?"
                )
        steps = np.diff(self.time)
        longest = JITTERING_GAP_FACTOR if self.jitters else GAP_FACTOR
        steps = steps[steps <= longest * self.sample_time]
        jitter = float(np.max(np.abs(steps - self.sample_time)))
        if jitter > JITTER_SHARE * self.sample_time:
            lines.append(
                f"uneven sampling: steps from {steps.min() * 1e3:.4g} to {steps.max() * 1e3:.4g} "
                f"ms around {self.sample_time * 1e3:.4g} ms" + self._jitter_words()
            )
        return lines

    def _jitter_words(self) -> str:
        if not self.jitters:
            return ""
        long, short = self._uneven
        # What is lost shows only beyond the chance of as many long steps as short ones.
        beyond = long - short > 2 * (long + short) ** 0.5
        loss = f"about {long - short}" if beyond else "hardly any"
        return (
            f"; {long} are as long as a gap and {short} as much too short, so the clock jitters "
            f"and {loss} samples are lost "
            "(--resample, or data.resample, evens it)"
        )


def quantum(values: np.ndarray) -> float | None:
    """Estimate the step between the levels that a channel takes.

    An encoder or a rounded print-out takes few levels at equal distances. Returns None
    when the levels do not lie on one grid, or when all samples differ.

    ``values``: (n,) float array; NaN allowed.
    """
    levels = np.unique(values[np.isfinite(values)])
    scale = float(np.max(np.abs(levels), initial=0.0))
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * scale]
    if not len(steps):
        return None
    # Rounding to decimals blurs single steps, so the finest are averaged, then the grid is
    # fitted to all levels.
    finest = float(np.median(steps[steps < 1.5 * steps.min()]))
    counts = np.round((levels - levels[0]) / finest)
    step = float(counts @ (levels - levels[0]) / (counts @ counts))
    off_grid = np.abs(levels - levels[0] - step * np.round((levels - levels[0]) / step))
    return step if float(np.max(off_grid)) < 0.25 * step else None


def refuse(where: Path | str, problem: str, remedy: str = "") -> NoReturn:
    """Raise RecordingError of a file, or of a line in it."""
    raise RecordingError(problem, where=str(where), remedy=remedy)


#: How a file's own names are told.
_NAMES = "if another column is it, say so: 'data.names={SIGNAL: COLUMN}'"


def require_channels(
    names: Sequence[str], where: str, vocabulary: Vocabulary, others: Sequence[str] = ()
) -> None:
    """Raise when a file lacks the time, an input or an output among its names.

    ``others``: its columns that are none of the vocabulary's.
    """
    inputs, outputs = (
        f"at least one of {', '.join(vocabulary.of_role(vocabulary.channels, role))}"
        for role in ("input", "output")
    )
    for there, what, remedy in (
        ("t" in names, "time, the column t[s]", "every recording needs one"),
        (vocabulary.of_role(names, "input"), "an input", f"{inputs} is needed"),
        (vocabulary.of_role(names, "output"), "an output", outputs),
    ):
        if not there:
            problem = f"it lacks {what}; it has {', '.join((*names, *others)) or 'nothing'}"
            refuse(where, problem, remedy + (f"; {_NAMES}" if others else ""))


def require_values(channels: Mapping[str, np.ndarray], where: str, vocabulary: Vocabulary) -> None:
    """Raise when no input, or no output, has a single value."""
    for role in ("input", "output"):
        mine = vocabulary.of_role(channels, role)
        if all(np.isnan(channels[name]).all() for name in mine):
            problem = f"no {role} has a single value: {', '.join(mine)} are empty throughout"
            refuse(where, problem, f"at least one {role} needs numbers")


def unit_fields(units: Mapping[str, str]) -> dict[str, str]:
    """Return ``name[unit]`` header cells by name."""
    return {name: f"{name}[{unit or '1'}]" for name, unit in units.items()}


#: More points than this, most of them missing, are a recording of several runs.
_MOST_POINTS = 5_000_000
_LEAST_SHARE_PRESENT = 0.1
#: Largest share of a sample time that a step is advised to be off by.
_MOST_JITTER = 0.4


@dataclass(frozen=True)
class GriddedRecording:
    """Channels of a recording at every sample time."""

    recording: Recording  #: As it was read
    sample_time: float  #: s, the median step
    time: np.ndarray  #: (n,) array; s, the rig's own; between the rows of a gap evenly spaced
    channels: dict[str, np.ndarray]  #: dict of str to (n,) arrays; NaN where there is no sample
    present: np.ndarray  #: (n,) bool array; whether the recording has a row at the point
    jitter: float  #: Largest deviation of a step from whole sample times, as a share of one

    def __len__(self) -> int:
        return len(self.time)


def on_grid(recording: Recording, tolerance: float) -> GriddedRecording:
    """Put a recording on the grid of its median step.

    ``tolerance``: largest deviation of a step from whole sample times, as a share of one, below
    0.5. Raises RecordingError if the steps are uneven beyond the tolerance, or hardly any point has
    a row.
    """
    step = recording.sample_time
    steps = np.diff(recording.time) / step
    whole = np.round(steps)
    off = np.abs(steps - whole)
    uneven = np.flatnonzero((off > tolerance) | (whole < 1))
    if len(uneven):
        worst = int(uneven[np.argmax(off[uneven])])
        # A step of a sample and a half could be one or two: no larger share can tell.
        rounded = float(off[uneven].max()) if np.all(whole[uneven] >= 1) else 1.0
        larger = np.ceil(100 * rounded) / 100
        jitters = (
            f"; a clock that only jitters passes with plant.jitter={larger:g} "
            f"(share of the sample time, now {tolerance:g})"
            if larger <= _MOST_JITTER
            else ""
        )
        raise RecordingError(
            f"the samples are not evenly spaced: {len(uneven)} of {len(steps)} steps are not whole "
            f"multiples of the median step {step * 1e3:.4g} ms; at t = "
            f"{recording.time[worst]:.6g} s one takes {steps[worst] * step * 1e3:.4g} ms",
            where=str(recording.source),
            remedy="resample it to a fixed rate before (trms import --resample SECONDS, or "
            f"data.resample=SECONDS; {step:.3g} keeps its rate){jitters}",
        )
    index = np.concatenate([[0], np.cumsum(whole)]).astype(np.int64)
    count = int(index[-1]) + 1
    if count > _MOST_POINTS and len(recording) < _LEAST_SHARE_PRESENT * count:
        start, end = max(recording.gaps, key=lambda gap: gap[1] - gap[0])
        raise RecordingError(
            f"{count} samples lie between the first time and the last, and {len(recording)} are "
            f"there; the longest gap is from {start:.6g} to {end:.6g} s",
            where=str(recording.source),
            remedy="split the file, or take a part of it: plant.start=… plant.end=…",
        )
    present = np.zeros(count, dtype=bool)
    present[index] = True
    channels = {}
    for name, values in recording.channels.items():
        channels[name] = np.full(count, np.nan)
        channels[name][index] = values
    time = np.interp(np.arange(count), index, recording.time)
    return GriddedRecording(
        recording, step, time, channels, present, float(np.max(off, initial=0.0))
    )
