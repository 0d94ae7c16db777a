"""p-values from simulation: what the tests show when the model is exactly right.

The model runs along the recorded commands, its outputs get the sensors' noise and quanta, and the
same predictor and the same tests go over them (a parametric bootstrap). Each statistic's mean and
variance over the simulations give a scaled χ² with the same two moments, and its tail the p-value.
That keeps whatever the limit of long recordings leaves out: quantised angles, a short recording,
the filter's own approximations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from trms_cli.identification.dataset import Dataset, FloatArray
from trms_cli.identification.validation.prediction import OneStepFilter, predict_one_step
from trms_cli.identification.validation.residual_tests import ResidualTests
from trms_cli.identification.validation.validate import ModelValidation, tests_of
from trms_cli.models.model import index_of, names
from trms_cli.simulation.rollout import Rollout

#: A simulation that swings this much wider than the recording is no picture of it.
_WIDEST = 3.0


def calibrated(
    validation: ModelValidation,
    quanta: Mapping[str, float],
    progress: Callable[[int], None] | None = None,
) -> ResidualTests | None:
    """The residual tests with p-values from simulation.

    Parameters
    ----------
    quanta : dict of str to float
        Resolution of each output; the rest of its declared noise is white.
    progress : callable, optional
        Called with the number of simulations done.

    Returns
    -------
    ResidualTests or None
        None if the model, left alone over the recording, leaves the range of what was measured.
    """
    options = validation.options
    rollout = Rollout(validation.model, validation.sample_time)
    clean = [_alone(validation, rollout, i) for i in range(len(validation.datasets))]
    if any(y is None for y in clean):
        return None
    generator = np.random.default_rng(options.seed)
    statistics = []
    filters = [
        OneStepFilter(validation.model, dataset, options.predictor) if step.noise_factors else None
        for dataset, step in zip(validation.datasets, validation.one_steps, strict=True)
    ]
    factors = None  # of the filter's process noise: fitted to the first simulation, and kept
    for count in range(options.tests.simulations):
        simulated, steps = [], []
        for dataset, y, filter_ in zip(validation.datasets, clean, filters, strict=True):
            assert y is not None
            data = replace(dataset, measurements=_measured(y, dataset, quanta, generator))
            step = predict_one_step(
                validation.model, data, rollout, options.predictor, factors, filter_
            )
            factors = step.noise_factors or None
            simulated.append(data)
            steps.append(step)
        tests = tests_of(validation.model, simulated, steps, options)
        statistics.append([test.result.statistic for test in tests.tests])
        if progress is not None:
            progress(count + 1)
    p_values = [
        matched_tail(test.result.statistic, np.array(column), test.result.degrees)
        for test, column in zip(validation.tests.tests, np.array(statistics).T, strict=True)
    ]
    return validation.tests.with_p_values(p_values)


def matched_tail(statistic: float, simulated: FloatArray, degrees: int) -> float:
    """Tail of the scaled χ² that has the mean and the variance of simulated statistics.

    The variance is at least that of ``a χ²_degrees`` of the same mean: that of a few dozen
    statistics is too uncertain to make a tail thinner than the limit of long recordings has it.
    That the mean is an estimate too turns χ² into F.
    """
    from scipy.special import fdtrc

    simulated = simulated[np.isfinite(simulated)]
    if len(simulated) < 10 or not np.isfinite(statistic) or degrees < 1:
        return np.nan
    mean = float(simulated.mean())
    if not mean > 0:
        return np.nan
    variance = max(float(simulated.var(ddof=1)), 2.0 * mean**2 / degrees)
    freedom = 2.0 * mean**2 / variance
    return float(fdtrc(freedom, freedom * len(simulated), statistic / mean))


def _alone(validation: ModelValidation, rollout: Rollout, i: int) -> FloatArray | None:
    """The model's outputs along the whole recording; None where it runs away."""
    dataset = validation.datasets[i]
    start = validation.one_steps[i].states[0]
    if np.isnan(start).any():
        known = np.flatnonzero(~np.isnan(validation.one_steps[i].states).any(axis=1))
        start = validation.one_steps[i].states[known[0]]
    full = rollout.initial(start[: validation.model.n_x], dataset.commands[0])
    columns = [index_of(validation.model.outputs, n, "an output") for n in names(dataset.outputs)]
    with np.errstate(all="ignore"):
        y = rollout.outputs(dataset.commands, [0], [len(dataset)], full[None]).y[:, columns]
    swing = np.nanmax(dataset.measurements, axis=0) - np.nanmin(dataset.measurements, axis=0)
    noise = 10.0 * dataset.noise_sd
    if not np.all(np.isfinite(y)) or np.any(np.ptp(y, axis=0) > _WIDEST * (swing + noise)):
        return None
    return y


def _measured(
    y: FloatArray, dataset: Dataset, quanta: Mapping[str, float], generator: np.random.Generator
) -> FloatArray:
    """Outputs as the sensors show them, missing where the recording is."""
    quantum = np.array([quanta.get(name, 0.0) for name in names(dataset.outputs)])
    white = np.sqrt(np.maximum(dataset.noise_sd**2 - quantum**2 / 12.0, 0.0))
    noisy = y + white * generator.standard_normal(y.shape)
    # Where an encoder's steps lie is chance: with them fixed, a channel without white noise would
    # be the same in every simulation.
    phase = quantum * generator.uniform(-0.5, 0.5, quantum.shape)
    step = np.where(quantum > 0, quantum, 1.0)
    shown = np.where(quantum > 0, np.round((noisy - phase) / step) * step + phase, noisy)
    return np.where(np.isnan(dataset.measurements), np.nan, shown)
