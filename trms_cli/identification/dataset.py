"""A recording as fits and validation take it: plain arrays in the order of a model's signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Signal, index_of, names

#: An angle beyond this share of its mechanical range touches the stop.
_AT_STOP = 0.995


@dataclass(frozen=True)
class Dataset:
    """One recording, or a part of one, on a uniform grid."""

    name: str  #: Short, for tables and legends
    source: str  #: The file
    sha256: str  #: Of the file's bytes, hexadecimal
    sample_time: float  #: s
    time: FloatArray  #: (n,) array; s, the rig's own
    inputs: tuple[Signal, ...]  #: Columns of ``commands``
    outputs: tuple[Signal, ...]  #: Columns of ``measurements``
    #: (n, n_u) array; in the inputs' units, held from each sample to the next; finite
    commands: FloatArray
    measurements: FloatArray  #: (n, n_y) array; in the outputs' units, NaN where missing
    noise_sd: FloatArray  #: (n_y,) array; declared standard deviation, a quantum's share included
    remarks: tuple[str, ...] = ()  #: What was found in the recording and what was done to it

    def __len__(self) -> int:
        return len(self.time)

    @property
    def duration(self) -> float:
        """From the first sample to the end of the last, s."""
        return len(self) * self.sample_time

    def output(self, name: str) -> FloatArray:
        """The measured samples of an output, shape (n,)."""
        return self.measurements[:, index_of(self.outputs, name, f"measured in {self.source}")]

    def part(self, first: int, last: int) -> Dataset:
        """The samples from ``first`` up to, and without, ``last``."""
        return replace(
            self,
            time=self.time[first:last],
            commands=self.commands[first:last],
            measurements=self.measurements[first:last],
        )

    def split(self, share: float) -> tuple[Dataset, Dataset]:
        """The first ``share`` of the samples, and the rest."""
        cut = round(share * len(self))
        return self.part(0, cut), self.part(cut, len(self))

    def driven_by(self, channels: Sequence[str]) -> Dataset:
        """The recording for a model whose states ``channels`` are prescribed.

        Each channel moves from the outputs to the inputs. An input is constant over a step, so it
        takes the mean of the samples at the two ends of the step; missing samples are
        interpolated, and the remarks say how many.

        Raises ConfigurationError if the recording has no or hardly any sample of a channel.
        """
        columns, remarks = [self.commands], list(self.remarks)
        for name in channels:
            if name not in names(self.outputs):
                raise ConfigurationError(
                    f"{self.source} does not measure {name!r}",
                    where="driven",
                    remedy=f"it measures {', '.join(names(self.outputs))}",
                )
            values = self.output(name)
            present = np.isfinite(values)
            if np.count_nonzero(present) < len(values) / 2:
                raise ConfigurationError(
                    f"{name!r} is missing in {np.count_nonzero(~present)} of {len(values)} samples",
                    where="driven",
                    remedy="leave it out, so that the model's own rotor is used",
                )
            if not present.all():
                remarks.append(f"{np.count_nonzero(~present)} samples of {name} interpolated")
                values = np.interp(self.time, self.time[present], values[present])
            columns.append(np.append((values[:-1] + values[1:]) / 2, values[-1])[:, None])
        indices = [i for i, signal in enumerate(self.outputs) if signal.name not in channels]
        new_inputs = tuple(s for name in channels for s in self.outputs if s.name == name)
        return replace(
            self,
            inputs=(*self.inputs, *new_inputs),
            outputs=tuple(self.outputs[i] for i in indices),
            commands=np.ascontiguousarray(np.hstack(columns)),
            measurements=np.ascontiguousarray(self.measurements[:, indices]),
            noise_sd=self.noise_sd[indices],
            remarks=tuple(remarks),
        )

    def windows(self, length: float, stride: float | None = None) -> tuple[IntArray, IntArray]:
        """First sample and number of samples of windows of equal length, each (m,).

        ``length``: s; the whole recording where it is shorter. ``stride``: s between the starts of
        two windows; None: ``length``. A rest at the end that is at least half a window long is
        taken as a shorter window if windows do not overlap.
        """
        samples = min(len(self), max(2, round(length / self.sample_time)))
        hop = samples if stride is None else max(1, round(stride / self.sample_time))
        first = np.arange(0, len(self) - samples + 1, hop)
        count = np.full(len(first), samples)
        rest = len(self) - (first[-1] + samples)
        if stride is None and rest >= max(2, samples / 2):
            first = np.append(first, len(self) - rest)
            count = np.append(count, rest)
        return first.astype(np.int64), count.astype(np.int64)

    def thinned(self, step: float) -> Dataset:
        """Every few samples of a fast recording, at least ``step`` (s) apart.

        Commands are averaged over the new step. Not every effect stands a coarse one: a delay does,
        for the commands' average moves with it.
        """
        factor = int(np.ceil(step / self.sample_time - 1e-9))
        if factor < 2:
            return self
        n = len(self) // factor * factor
        commands = self.commands[:n].reshape(-1, factor, self.commands.shape[1]).mean(axis=1)
        return replace(
            self,
            sample_time=self.sample_time * factor,
            time=self.time[:n:factor],
            commands=np.ascontiguousarray(commands),
            measurements=np.ascontiguousarray(self.measurements[:n:factor]),
            remarks=(*self.remarks, f"every {factor}th sample is used, commands averaged between"),
        )

    def without_contacts(self, block: float, stops: Mapping[str, float]) -> Dataset:
        """Nothing measured from a contact with a stop to the end of its block (s).

        ``stops``: mechanical range of angles, rad.
        """
        samples = max(2, round(block / self.sample_time))
        touching = np.zeros(len(self), dtype=bool)
        for i, signal in enumerate(self.outputs):
            if signal.name in stops:
                touching |= np.abs(self.measurements[:, i]) >= _AT_STOP * stops[signal.name]
        if not touching.any():
            return self
        measurements = self.measurements.copy()
        for first in range(0, len(self), samples):
            hits = np.flatnonzero(touching[first : first + samples])
            if len(hits):
                measurements[first + hits[0] : first + samples] = np.nan
        missing_share = float(np.mean(np.isnan(measurements).all(axis=1)))
        remark = (
            f"{100 * missing_share:.0f} % of the samples left out, from contacts with a stop on"
        )
        return replace(self, measurements=measurements, remarks=(*self.remarks, remark))
