"""A stored network against recordings: one step ahead, and in free run."""

from __future__ import annotations

import numpy as np

from trms_cli.identification.blackbox.regressors import Samples, placed_rows
from trms_cli.identification.dataset import FloatArray
from trms_cli.models.network import NarxStructure, Network


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
    """Simulate windows side by side on the network's own outputs.

    Parameters
    ----------
    past : (L, m, n_y) array
        The ``structure.longest_lag`` samples before each of m windows.
    inputs : (L + K, m, n_u) array
        Commands of the same samples and of the windows.

    Returns
    -------
    (K, m, n_y) array
        Not finite after a divergence.
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
