"""What is to be diagnosed: a model, recordings of one rig, and the effects that are suspected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.effect import Effect
from trms_cli.identification.data import noise_estimate
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model

Effort = Literal["quick", "normal", "thorough"]

#: s. Lengths of the free runs that the gap is told at.
HORIZONS = (0.1, 0.5, 2.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class GapProblem:
    """A model, recordings of one rig, candidates."""

    model: Model  #: The nominal model, with the effects that it has already
    model_name: str  #: As the user named it
    #: Whole recordings with one sample time; they measure some or all of the model's outputs
    datasets: tuple[Dataset, ...]
    #: The library: effects that may be the cause, by name, at their typical sizes
    candidates: Mapping[str, Effect]
    #: s, of the blocks that are fitted, compared and resampled
    block: Annotated[float, Meta(gt=0)] = 10.0
    #: Share of the recordings that nothing is chosen on and the shrink is measured on
    sealed_share: Annotated[float, Meta(gt=0, lt=1)] = 0.25
    effort: Effort = "normal"
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    warnings: tuple[str, ...] = field(default=())  #: Of the admission, to stand in the report


#: s. Recordings that are sampled faster are thinned: no effect of the library needs more, and a
#: filter's cost goes with the number of samples.
_FINEST = 0.0095
#: s. A sealed part shorter than this cannot show a free run of ten seconds.
_LEAST_SEALED = 12.0
#: An angle beyond this share of its mechanical range touches the stop.
_AT_STOP = 0.995
#: From so many recordings on, whole ones are sealed.
_SEVERAL = 3
#: In the outputs' units: a reader of recordings that is told no noise gives less than this.
_NOT_DECLARED = 1e-5
#: Ripple below so many times a step's own share is that share.
_RIPPLE = 1.4
#: Blocks that must be left to fit: fewer cannot be compared in pairs.
_FEWEST_BLOCKS = 4


@dataclass(frozen=True)
class Parts:
    """Recordings, divided."""

    #: Everything is fitted, chosen and compared on these, block by block
    fitted: tuple[Dataset, ...]
    whole: tuple[Dataset, ...]  #: As they were given, thinned
    #: tuple of (recording, first, last); spans of ``whole`` that are opened once
    sealed: tuple[tuple[int, int, int], ...]
    block: float  #: s


def divide(
    datasets: Sequence[Dataset], block: float, share: float, stops: Mapping[str, float]
) -> Parts:
    """Seal the end of each recording, or the last recordings where there are several.

    ``block``: s; shortened for short recordings. ``share``: of the time, to be sealed. ``stops``:
    mechanical range of angles, rad: from a contact with a stop to the end of its block nothing is
    compared, for no model of free motion follows there. Raises ConfigurationError if hardly
    anything would be left.
    """
    whole = tuple(thinned(with_noise(dataset)) for dataset in datasets)
    total = sum(dataset.duration for dataset in whole)
    if len(whole) >= _SEVERAL:
        count = max(1, round(share * len(whole)))
        kept = len(whole) - count
        fitted = whole[:kept]
        sealed = tuple((i, 0, len(whole[i])) for i in range(kept, len(whole)))
    else:
        parts, spans = [], []
        for i, dataset in enumerate(whole):
            length = max(share * dataset.duration, min(_LEAST_SEALED, dataset.duration / 3))
            cut = round((dataset.duration - length) / dataset.sample_time)
            parts.append(dataset.part(0, cut))
            spans.append((i, cut, len(dataset)))
        fitted, sealed = tuple(parts), tuple(spans)
    left = sum(dataset.duration for dataset in fitted)
    block = min(block, left / _FEWEST_BLOCKS)
    if block < 2.0:
        raise ConfigurationError(
            f"{total:.3g} s of recording are too short to fit, compare and seal",
            where="real",
            remedy="record at least 20 s, better 120 s; or give several recordings of the rig",
        )
    fitted = tuple(_without_contacts(dataset, block, stops) for dataset in fitted)
    return Parts(fitted, whole, sealed, block)


def _without_contacts(dataset: Dataset, block: float, stops: Mapping[str, float]) -> Dataset:
    samples = max(2, round(block / dataset.sample_time))
    touching = np.zeros(len(dataset), dtype=bool)
    for i, signal in enumerate(dataset.outputs):
        if signal.name in stops:
            touching |= np.abs(dataset.measurements[:, i]) >= _AT_STOP * stops[signal.name]
    if not touching.any():
        return dataset
    measurements = dataset.measurements.copy()
    for first in range(0, len(dataset), samples):
        hits = np.flatnonzero(touching[first : first + samples])
        if len(hits):
            measurements[first + hits[0] : first + samples] = np.nan
    lost = float(np.mean(np.isnan(measurements).all(axis=1)))
    remark = f"{100 * lost:.0f} % of the samples left out, from contacts with a stop on"
    return replace(dataset, measurements=measurements, remarks=(*dataset.remarks, remark))


def with_noise(dataset: Dataset) -> Dataset:
    """The recording with its noise told: as declared, or read from its steps and its ripple."""
    quanta = np.array([quantum_of(column) for column in dataset.measurements.T])
    ripple, rounding = noise_estimate(dataset.measurements), quanta / np.sqrt(12)
    # what a step makes of a moving angle is not quite white, and looks like a little more of it
    read = np.where(ripple < _RIPPLE * rounding, rounding, np.maximum(ripple, rounding))
    told = dataset.noise_sd > _NOT_DECLARED
    return replace(dataset, noise_sd=np.where(told, dataset.noise_sd, np.maximum(read, 1e-9)))


def quantum_of(values: FloatArray) -> float:
    """Step of a sensor: the smallest that is common between its values; 0 if they are smooth."""
    levels = np.unique(np.round(values[np.isfinite(values)], 9))
    steps = np.diff(levels)
    # a recording has few digits, so that a step is met a little too small or too large
    steps = steps[steps > 1e-6]
    if len(steps) < 5:
        return 0.0
    quantum = float(np.quantile(steps, 0.1))
    near = steps[steps < 1.5 * quantum]
    quantum = float(np.mean(near))
    whole = np.abs(steps / quantum - np.round(steps / quantum)) < 0.1
    return quantum if whole.mean() > 0.9 else 0.0


def thinned(dataset: Dataset) -> Dataset:
    """Every few samples of a fast recording; commands are averaged over the new step.

    Not every effect stands a coarse step: a delay does, for the commands' average moves with it.
    """
    factor = int(np.ceil(_FINEST / dataset.sample_time - 1e-9))
    if factor < 2:
        return dataset
    n = len(dataset) // factor * factor
    commands = dataset.commands[:n].reshape(-1, factor, dataset.commands.shape[1]).mean(axis=1)
    return replace(
        dataset,
        sample_time=dataset.sample_time * factor,
        time=dataset.time[:n:factor],
        commands=np.ascontiguousarray(commands),
        measurements=np.ascontiguousarray(dataset.measurements[:n:factor]),
        remarks=(*dataset.remarks, f"every {factor}th sample is used, commands averaged between"),
    )
