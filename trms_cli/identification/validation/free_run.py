"""Free runs: the model alone over windows of the recording, started from what came before.

Windows of every horizon begin at the same samples, one every `stride`, for all models alike.
Sample j of a window is j + 1 steps ahead of the last measurement that its start may know.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.dataset import Dataset, FloatArray, IntArray
from trms_cli.identification.validation.lagged_state import measured_states
from trms_cli.identification.validation.options import ValidationOptions
from trms_cli.identification.validation.prediction import OneStep
from trms_cli.identification.validation.window_start import fitted_starts, with_memory
from trms_cli.models.model import Model, index_of, names
from trms_cli.simulation.rollout import Rollout


@dataclass(frozen=True)
class WindowErrors:
    """Errors of the windows of one horizon in one recording."""

    channels: tuple[str, ...]
    first: IntArray  #: (m,) array of int; first sample of each window
    errors: FloatArray  #: (m, k, n_y) array; measured minus simulated; NaN where not measured
    measured: FloatArray  #: (m, k, n_y) array
    #: (m, k, n_y) array; error of the prediction that nothing changes from the last sample before
    #: the window
    unchanged: FloatArray


@dataclass(frozen=True)
class FreeRun:
    """The model alone to the end of the recording."""

    first: int  #: Sample at which it begins
    simulated: FloatArray  #: (n − first, n_y) array; in the order of the recording's outputs


@dataclass(frozen=True)
class FreeRuns:
    """All free runs of a model over one recording."""

    windows: Mapping[float, WindowErrors]  #: By horizon, s
    whole: FreeRun


def common_windows(
    dataset: Dataset, options: ValidationOptions, lead: int
) -> dict[float, IntArray]:
    """First samples of the windows of every horizon that fits.

    Parameters
    ----------
    lead : int
        Samples that are needed before a window.

    Raises
    ------
    ConfigurationError
        If not even the shortest horizon fits.
    """
    step = dataset.sample_time
    stride = max(1, round(options.windows.stride / step))
    found = {}
    for horizon in options.horizons:
        last = len(dataset) - samples_of(horizon, step)
        first = np.arange(lead, last + 1, stride, dtype=np.int64)
        if first.size and horizon >= 0.5 * step:
            found[horizon] = first
    if not found:
        needed = lead * step + options.horizons[0]
        raise ConfigurationError(
            f"{dataset.source} lasts {dataset.duration:.3g} s, and {needed:.3g} s are needed: "
            f"{lead * step:.3g} s to estimate a start from, then the shortest horizon",
            where="real",
            remedy="give a longer recording, or shorten windows.history and horizons",
        )
    return found


def lead_samples(models: Sequence[Model], dataset: Dataset, options: ValidationOptions) -> int:
    """Samples before the first window that every model has its start from."""
    lead = max(2, round(options.windows.history / dataset.sample_time))
    for model in models:
        states = measured_states(model, dataset)
        if states is not None:
            present = ~np.isnan(states).any(axis=1)
            lead = max(lead, int(np.argmax(present)) + 1 if present.any() else 0)
    return lead


def samples_of(time: float, sample_time: float) -> int:
    """A time in samples, at least one."""
    return max(1, round(time / sample_time))


def free_runs(
    model: Model,
    dataset: Dataset,
    rollout: Rollout,
    one_step: OneStep,
    firsts: Mapping[float, IntArray],
    options: ValidationOptions,
) -> FreeRuns:
    """Simulate all windows, and once from the first of them to the end."""
    remembered = measured_states(model, dataset)
    shortest = min(firsts)
    every = firsts[shortest]
    if remembered is not None:
        starts = _filled(remembered)[every]
    elif options.windows.start != "moving_horizon":
        before = with_memory(rollout, dataset, every - 1, one_step.states[every - 1])
        ones = np.ones_like(every)
        starts = rollout.outputs(dataset.commands, every - 1, ones, before).ends
    else:
        history = np.minimum(every, samples_of(options.windows.history, dataset.sample_time))
        prior = one_step.states[every - history]
        _, starts = fitted_starts(model, rollout, dataset, every - history, history, prior)
    windows = {}
    for horizon, first in firsts.items():
        samples = samples_of(horizon, dataset.sample_time)
        count = np.full(len(first), samples)
        begin = starts[np.searchsorted(every, first)]
        if options.windows.start == "fitted" and remembered is None:
            prior = begin[:, : model.n_x]
            begin, _ = fitted_starts(model, rollout, dataset, first, count, prior)
        windows[horizon] = _errors(model, dataset, rollout, first, samples, begin)
    origin = int(every[0])
    with np.errstate(all="ignore"):
        y = rollout.outputs(dataset.commands, [origin], [len(dataset) - origin], starts[:1]).y
    return FreeRuns(windows, FreeRun(origin, y[:, _columns(model, dataset)]))


def _errors(
    model: Model,
    dataset: Dataset,
    rollout: Rollout,
    first: IntArray,
    samples: int,
    starts: FloatArray,
) -> WindowErrors:
    m, n_y = len(first), len(dataset.outputs)
    with np.errstate(all="ignore"):
        y = rollout.outputs(dataset.commands, first, np.full(m, samples), starts).y
    simulated = y[:, _columns(model, dataset)].reshape(m, samples, n_y)
    at = first[:, None] + np.arange(samples)
    measured = dataset.measurements[at]
    known = _filled(dataset.measurements)[np.maximum(first - 1, 0)]
    return WindowErrors(
        names(dataset.outputs),
        first,
        measured - simulated,
        measured,
        measured - known[:, None, :],
    )


def _columns(model: Model, dataset: Dataset) -> list[int]:
    return [index_of(model.outputs, s.name, "an output") for s in dataset.outputs]


def _filled(values: FloatArray) -> FloatArray:
    """Missing values replaced by the last present one (at the beginning by the first)."""
    filled = values.copy()
    for column in filled.T:
        present = ~np.isnan(column)
        if not present.any():
            column[:] = 0.0
            continue
        latest = np.maximum.accumulate(np.where(present, np.arange(len(column)), 0))
        column[:] = column[latest]
        column[: int(np.argmax(present))] = column[int(np.argmax(present))]
    return filled
