"""From samples to regressors and targets, and a stored network played along recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import RecordingError
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import names
from trms_cli.models.network import NarxStructure, Network

#: A signal whose spread is below this share of its size never moves, rounding apart.
_LEAST_SPREAD = 1e-9


@dataclass(frozen=True)
class Samples:
    """One recording at a network's sample time."""

    outputs: FloatArray  #: (n, n_y) array; NaN where a sample is missing
    inputs: FloatArray  #: (n, n_u) array; constant from each sample to the next
    name: str = ""

    def __len__(self) -> int:
        return len(self.outputs)


@dataclass(frozen=True)
class Scaling:
    """Mean and spread of regressors and targets, over the data that a network is fitted to."""

    regressor_mean: FloatArray  #: (n_phi,) arrays
    regressor_sd: FloatArray  #: (n_phi,) arrays
    #: ``output_mean``, ``output_sd``: (n_y,) arrays; of the target: of increments, where the
    #: network gives increments
    output_mean: FloatArray
    output_sd: FloatArray
    level_sd: FloatArray  #: (n_y,) array; of the outputs themselves: the scale of simulation errors


def sampled(dataset: Dataset, structure: NarxStructure, smoothing: float = 0.0) -> Samples:
    """The signals of a structure from a recording, at the structure's sample time.

    Of the outputs every d-th sample is taken; a command is the mean over the d samples.

    ``smoothing``: s, length of a cubic Savitzky–Golay window over the outputs before samples are
    taken; 0 for none. It looks ahead, so it is for fitting only. Raises RecordingError if the
    sample times have no whole ratio, a signal is missing, or a channel has no sample.
    """
    ratio = structure.sample_time / dataset.sample_time
    step = round(ratio)
    if step < 1 or abs(ratio - step) > 1e-6 * ratio:
        raise RecordingError(
            f"the recording is sampled each {dataset.sample_time:g} s and the network each "
            f"{structure.sample_time:g} s",
            where=dataset.source,
            remedy="choose a whole multiple: method.regressors.sample_time="
            f"{max(1, step) * dataset.sample_time:g}",
        )
    outputs = _columns(dataset, structure.outputs, dataset.measurements, names(dataset.outputs))
    inputs = _columns(dataset, structure.inputs, dataset.commands, names(dataset.inputs))
    if smoothing > 0:
        outputs = smoothed(outputs, round(smoothing / dataset.sample_time))
    n = len(outputs) // step
    means = inputs[: n * step].reshape(n, step, -1).mean(axis=1) if step > 1 else inputs[:n]
    return Samples(outputs[: n * step : step], means, dataset.name)


def _columns(
    dataset: Dataset, wanted: Sequence[str], values: FloatArray, known: Sequence[str]
) -> FloatArray:
    for name in wanted:
        if name not in known:
            raise RecordingError(
                f"{name!r} is not recorded",
                where=dataset.source,
                remedy=f"there are: {', '.join(known)}; choose a model that has no more",
            )
    result = values[:, [list(known).index(name) for name in wanted]]
    for name, column in zip(wanted, result.T, strict=True):
        if not np.any(np.isfinite(column)):
            raise RecordingError(
                f"{name!r} has no sample", where=dataset.source, remedy="leave it out or record it"
            )
    return result


def smoothed(outputs: FloatArray, window: int) -> FloatArray:
    """Each column through a cubic Savitzky–Golay filter of (about) so many samples.

    A column with missing samples is smoothed between them as if they lay on a straight line, and
    they stay missing.
    """
    from scipy.signal import savgol_filter

    window = min(window, len(outputs)) // 2 * 2 + 1
    if window > len(outputs):
        window -= 2
    if window < 5:
        return outputs
    result = outputs.copy()
    index = np.arange(len(outputs))
    for column in result.T:  # views
        there = np.isfinite(column)
        filled = np.interp(index, index[there], column[there])
        column[there] = savgol_filter(filled, window, 3)[there]
    return result


def rows(structure: NarxStructure, samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Regressors (n, n_phi) and targets (n, n_y), without those that lack a sample."""
    regressors, targets, _ = placed_rows(structure, samples)
    return regressors, targets


def placed_rows(
    structure: NarxStructure, samples: Samples
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """:func:`rows`, and the sample k that each row predicts."""
    first, n = structure.longest_lag, len(samples)
    lagged = [samples.outputs[first - lag : n - lag] for lag in structure.output_lags]
    lagged += [samples.inputs[first - lag : n - lag] for lag in structure.input_lags]
    regressors = np.hstack(lagged) @ structure.arrangement().T
    targets = samples.outputs[first:].copy()
    if structure.incremental:
        targets -= samples.outputs[first - 1 : n - 1]
    complete = np.isfinite(regressors).all(axis=1) & np.isfinite(targets).all(axis=1)
    return regressors[complete], targets[complete], np.arange(first, n)[complete]


def scaling(structure: NarxStructure, recordings: Sequence[Samples]) -> Scaling:
    """Scales from the recordings that a network is fitted to.

    Raises RecordingError if there are fewer rows than regressors, or an input or output never
    moves.
    """
    pairs = [rows(structure, samples) for samples in recordings]
    regressors = np.vstack([pair[0] for pair in pairs])
    targets = np.vstack([pair[1] for pair in pairs])
    where = ", ".join(samples.name for samples in recordings)
    if len(regressors) < 2 * structure.n_regressors:
        raise RecordingError(
            f"only {len(regressors)} complete samples for {structure.n_regressors} regressors",
            where=where,
            remedy=f"record at least {100 * structure.n_regressors * structure.sample_time:.0f} s",
        )
    for kind, signals in (("inputs", structure.inputs), ("outputs", structure.outputs)):
        everything = np.vstack([getattr(samples, kind) for samples in recordings])
        for name, column in zip(signals, everything.T, strict=True):
            spread = float(np.nanstd(column))
            if not spread > _LEAST_SPREAD * max(1.0, float(np.nanmax(np.abs(column)))):
                raise RecordingError(
                    f"{name!r} never moves",
                    where=where,
                    remedy="record with an excitation that moves it, for instance a multilevel "
                    "random command (`trms excite`)",
                )
    levels = np.vstack([samples.outputs for samples in recordings])
    return Scaling(
        regressors.mean(axis=0),
        _spread(regressors),
        targets.mean(axis=0),
        _spread(targets),
        np.nanstd(levels, axis=0),
    )


def _spread(values: FloatArray) -> FloatArray:
    """Standard deviations, 1 where a column is constant (it is then zero when normalised)."""
    spread = values.std(axis=0)
    return np.asarray(np.where(spread > 0, spread, 1.0))


def predicted(structure: NarxStructure, network: Network, samples: Samples) -> FloatArray:
    """Each sample from the measured ones before it, (n, n_y); NaN where one is missing."""
    regressors, _, place = placed_rows(structure, samples)
    result = np.full_like(samples.outputs, np.nan)
    result[place] = network.evaluate(regressors)
    if structure.incremental:
        result[place] += samples.outputs[place - 1]
    return result


def free_run(
    structure: NarxStructure, network: Network, past: FloatArray, inputs: FloatArray
) -> FloatArray:
    """Simulate windows side by side on the network's own outputs, (K, m, n_y).

    ``past``: (L, m, n_y) array; the ``structure.longest_lag`` samples before each of m windows.
    ``inputs``: (L + K, m, n_u) array; commands of the same samples and of the windows. The result
    is not finite after a divergence.
    """
    first = structure.longest_lag
    levels = np.empty((len(inputs), *past.shape[1:]))
    levels[:first] = past
    arrangement = structure.arrangement().T
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(first, len(inputs)):
            lagged = [levels[k - lag] for lag in structure.output_lags]
            lagged += [inputs[k - lag] for lag in structure.input_lags]
            levels[k] = network.evaluate(np.hstack(lagged) @ arrangement)
            if structure.incremental:
                levels[k] += levels[k - 1]
    return levels[first:]


def simulated(
    structure: NarxStructure, network: Network, samples: Samples, start: Samples | None = None
) -> FloatArray:
    """One free run over a whole recording, (n, n_y); the first samples are the measured ones.

    ``start`` gives those first samples, where they are not to be taken as measured.
    """
    first = structure.longest_lag
    past = (start or samples).outputs[:first]
    run = free_run(structure, network, past[:, None], samples.inputs[:, None])
    return np.vstack([past, run[:, 0]])


def rms(errors: FloatArray) -> FloatArray:
    """Root mean square of each column over the samples that are there, (n, n_y) -> (n_y,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.nanmean(errors**2, axis=0)))


def normalised_rms(errors: FloatArray, measured: FloatArray) -> float:
    """Root mean square over all outputs, each in units of its own spread; 1: as good as the mean.

    Infinite after a divergence.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        value = float(np.sqrt(np.mean((rms(errors) / np.nanstd(measured, axis=0)) ** 2)))
    return value if np.isfinite(value) else np.inf
