"""A missing force, sample by sample, with what the rig did meanwhile: plain data.

The smoother of the pipeline estimates it; everything of this package reads it and nothing else.
Several recordings of one rig stand one after another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray

#: The largest part of a mean square that is taken for noise, whatever the smoother says of it.
MOST_NOISE = 0.8


@dataclass(frozen=True, kw_only=True)
class ForceRecord:
    """A smoothed force at one place of the block diagram.

    Raises ValueError: Series of different lengths.
    """

    location: str  #: One of :data:`trms_cli.gap.diagnosis.LOCATIONS`
    unit: str  #: Of the force: N*m, V, rad, rad/s
    time: FloatArray  #: (k,) array; s, rising within a recording
    #: (k,) array of int; which recording a sample belongs to; the samples of one stand together
    recording: IntArray
    #: ``force``, ``sd``: (k,) arrays; smoothed estimate and its standard deviation
    force: FloatArray
    sd: FloatArray
    #: dict of str to (k,) array; ``pitch`` and ``yaw``, rad and rad/s
    angles: Mapping[str, FloatArray] = field(default_factory=dict)
    rates: Mapping[str, FloatArray] = field(default_factory=dict)  #: likewise
    #: dict of str to (k,) array; ``main`` and ``tail``, rad/s; may be absent
    speeds: Mapping[str, FloatArray] = field(default_factory=dict)
    #: dict of str to (k,) array; ``main`` and ``tail``, V
    commands: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        series = [self.time, self.recording, self.force, self.sd]
        for group in (self.angles, self.rates, self.speeds, self.commands):
            series.extend(group.values())
        lengths = {np.shape(values) for values in series}
        if len(lengths) != 1 or len(next(iter(lengths))) != 1:
            raise ValueError(f"series of a force record differ in shape: {sorted(lengths)}")

    @property
    def axis(self) -> str:
        """Axis that a force at this place moves: ``pitch`` or ``yaw``."""
        return {"main": "pitch", "tail": "yaw"}.get(self.side, self.side)

    @property
    def side(self) -> str:
        """First word of the location: ``main``, ``tail``, ``pitch`` or ``yaw``."""
        return self.location.split("_", 1)[0]

    @property
    def variables(self) -> dict[str, FloatArray]:
        """All that the force may depend on, by the names that sentences use."""
        return {
            **{f"{axis} angle": values for axis, values in self.angles.items()},
            **{f"{axis} rate": values for axis, values in self.rates.items()},
            **{f"{rotor} rotor speed": values for rotor, values in self.speeds.items()},
            **{f"{rotor} command": values for rotor, values in self.commands.items()},
        }

    def taken(self, rows: IntArray) -> ForceRecord:
        """Only these samples of it."""
        taken: dict[str, Any] = {}
        for name in ("time", "recording", "force", "sd"):
            taken[name] = getattr(self, name)[rows]
        for name in ("angles", "rates", "speeds", "commands"):
            taken[name] = {key: values[rows] for key, values in getattr(self, name).items()}
        return replace(self, **taken)

    @cached_property
    def sample_time(self) -> float:
        """Median step between samples of one recording, s; 1 for a single sample."""
        steps = np.diff(self.time)[np.diff(self.recording) == 0]
        return float(np.median(steps)) if steps.size else 1.0

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """Stretches without a gap: within one recording, steps under 1.5 sample times."""
        broken = np.diff(self.time) > 1.5 * self.sample_time
        broken |= np.diff(self.recording) != 0
        edges = [0, *(np.flatnonzero(broken) + 1).tolist(), self.time.size]
        return tuple(slice(a, b) for a, b in pairwise(edges) if b > a)

    def thinned(self, rate: float) -> ForceRecord:
        """Every so-manieth sample, at least ``rate`` [Hz] of them; a smoothed force has no more.

        Samples are picked, not averaged, so that their standard deviation stays what it is.
        """
        stride = max(int(1.0 / (rate * self.sample_time) + 1e-9), 1)
        rows = [np.arange(part.start, part.stop, stride) for part in self.segments]
        return self.taken(np.concatenate(rows))

    def blocks(self, length: float) -> IntArray:
        """Number of the block that each sample belongs to, rising, about ``length`` [s] each.

        A stretch is cut into equal blocks, one at least.
        """
        number = np.empty(self.time.size, dtype=np.int64)
        first = 0
        for part in self.segments:
            samples = part.stop - part.start
            count = max(round(samples * self.sample_time / length), 1)
            number[part] = first + np.arange(samples) * count // samples
            first += count
        return number

    def correlation_time(self, values: FloatArray, power: int = 1) -> float:
        """Time over which a series forgets itself, s: the integral of its autocorrelation.

        Up to where that first falls below a tenth; not below one sample time. With ``power`` 2, of
        the autocorrelation's square: what decides how much of one series another explains by chance
        when both remember alike (Bartlett 1946).
        """
        longest = max((part.stop - part.start for part in self.segments), default=1)
        size = 1 << (2 * longest - 1).bit_length()
        spectrum = np.zeros(size // 2 + 1)
        for part in self.segments:
            spectrum += np.abs(np.fft.rfft(values[part] - values.mean(), size)) ** 2
        correlation = np.fft.irfft(spectrum)[:longest]
        if correlation[0] <= 0:
            return self.sample_time
        correlation = correlation / correlation[0]
        below = np.flatnonzero(correlation < 0.1)
        end = int(below[0]) if below.size else longest
        return float(self.sample_time * max(2 * np.sum(correlation[:end] ** power) - 1, 1.0))

    def signal_power(self, mean_square: float) -> float:
        """A mean square of the force less that of its noise; a fifth of it is always left."""
        noise = float(np.mean(self.sd**2))
        return mean_square - min(noise, MOST_NOISE * mean_square)
