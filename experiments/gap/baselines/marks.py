"""What a recording looks like to a classifier: numbers that hardly depend on how it was driven."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from experiments.gap.baselines.fits import nominal_free
from experiments.gap.baselines.force_terms import columns
from experiments.gap.baselines.restoring_force import motion
from trms_cli.identification.data import noise_estimate
from trms_cli.identification.dataset import Dataset, FloatArray
from trms_cli.models.model import Model, names

#: Edges of the bands of the force's spectrum, Hz.
_BANDS = (0.0, 0.3, 1.0, 2.0, 4.0, 8.0)


def marks(model: Model, datasets: Sequence[Dataset], block: float) -> FloatArray:
    """Marks of one rig's recordings, (n,): of the same length for the same model and channels.

    For each equation: logarithm of the force's size beyond what the parameters explain, shares of
    bands, and its correlation with the library's terms, with derivatives of the states, and with
    the commands; for each channel the size of its steps and of its noise.
    """
    free = nominal_free(model)
    moved = motion(model, datasets, [p.name for p in free], block)
    terms, library = columns(model, moved)
    scales = np.array([p.scale for p in free])
    derivative = np.gradient(moved.x, moved.step, axis=0)
    second = np.gradient(derivative, moved.step, axis=0)
    slopes = np.gradient(moved.u, moved.step, axis=0)
    common = np.hstack([moved.x, derivative, second, moved.u, slopes, np.ones((len(moved.x), 1))])
    found: list[float] = []
    for i, place in enumerate(names(model.disturbances)):
        force = moved.force[:, i]
        nuisances = moved.of_parameters[:, i] * scales
        ridge = float(np.var(force)) * len(force) / moved.independent
        inner = nuisances.T @ nuisances + ridge * np.eye(len(free))
        gain = np.linalg.solve(inner, nuisances.T) if len(free) else nuisances.T
        chosen = [k for k, term in enumerate(terms) if term.location == place]
        both = np.hstack([force[:, None], library[:, chosen], common])
        left = both - nuisances @ (gain @ both)
        size = np.sqrt(np.mean(left**2, axis=0))
        unit = left / np.maximum(size, 1e-12 + 1e-6 * np.sqrt(np.mean(both**2, axis=0)))
        found.append(float(np.log(size[0] + 1e-12)))
        found.append(float(np.log(size[0] / (np.sqrt(np.mean(force**2)) + 1e-12) + 1e-6)))
        found += _bands(left[:, 0], moved.step)
        found += (unit[:, 1:].T @ unit[:, 0] / len(unit)).tolist()
    for signal_noise in _of_channels(datasets):
        found += signal_noise
    values = np.nan_to_num(np.array(found), nan=0.0, posinf=0.0, neginf=0.0)
    return values


def _bands(force: FloatArray, step: float) -> list[float]:
    """Logarithms of the shares of bands."""
    power = np.abs(np.fft.rfft(force - force.mean())) ** 2
    frequency = np.fft.rfftfreq(len(force), step)
    total = float(power.sum()) + 1e-300
    return [
        float(np.log(power[(frequency >= low) & (frequency < high)].sum() / total + 1e-6))
        for low, high in pairwise(_BANDS)
    ]


def _of_channels(datasets: Sequence[Dataset]) -> list[list[float]]:
    """Logarithms of each channel's noise and typical step, over the declared noise."""
    found = []
    for i, sd in enumerate(datasets[0].noise_sd):
        values = np.concatenate([d.measurements[:, i] for d in datasets])
        noise = float(noise_estimate(values[:, None])[0])
        steps = np.abs(np.diff(values))
        steps = steps[np.isfinite(steps) & (steps > 1e-9)]
        step = float(np.median(steps)) if steps.size else 0.0
        least = float(np.min(steps)) if steps.size else 0.0
        unit = max(float(sd), 1e-9)
        found.append([float(np.log(v / unit + 1e-2)) for v in (noise, step, least)])
    return found
