"""A model held against recordings: everything that the report is made of.

In a free run the model is alone over a window, started from what came before. Windows of every
horizon begin at the same samples, one every `stride`, for all models alike. Sample j of a window is
j + 1 steps ahead of the last measurement that its start may know.

p-values may come from simulation, where the model is exactly right: it runs along the recorded
commands, its outputs get the sensors' noise and quanta, and the same predictor and the same tests
go over them (a parametric bootstrap). Each statistic's mean and variance over the simulations give
a scaled χ² with the same two moments, and its tail the p-value. That keeps whatever the limit of
long recordings leaves out: quantised angles, a short recording, the filter's own approximations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import (
    fitted_starts,
    simulated_windows,
    with_memory,
)
from trms_cli.identification.validation.metrics import (
    BlockSums,
    RegionTable,
    WindowErrors,
    block_sums,
    region_tables,
)
from trms_cli.identification.validation.options import ValidationOptions
from trms_cli.identification.validation.prediction import (
    OneStep,
    OneStepFilter,
    measured_states,
    predict_one_step,
)
from trms_cli.identification.validation.residual_tests import ResidualTests, residual_tests
from trms_cli.models.model import Model, Signal, names
from trms_cli.simulation.rollout import Rollout


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

    ``lead``: samples that are needed before a window. Raises ConfigurationError if not even the
    shortest horizon fits.
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
        # The first window begins no earlier: see :func:`lead_samples`.
        history = samples_of(options.windows.history, dataset.sample_time)
        begin = every - history
        guess = with_memory(rollout, dataset, begin, one_step.states[begin])
        _, starts = fitted_starts(rollout, dataset, begin, history, guess)
    windows = {}
    for horizon, first in firsts.items():
        samples = samples_of(horizon, dataset.sample_time)
        at = starts[np.searchsorted(every, first)]
        if options.windows.start == "fitted" and remembered is None:
            guess = with_memory(rollout, dataset, first, at[:, : model.n_x])
            at, _ = fitted_starts(rollout, dataset, first, samples, guess)
        windows[horizon] = _errors(dataset, rollout, first, samples, at)
    origin = int(every[0])
    whole = simulated_windows(rollout, dataset, [origin], len(dataset) - origin, starts[:1])
    return FreeRuns(windows, FreeRun(origin, whole[0]))


def _errors(
    dataset: Dataset, rollout: Rollout, first: IntArray, samples: int, starts: FloatArray
) -> WindowErrors:
    simulated = simulated_windows(rollout, dataset, first, samples, starts)
    measured = dataset.measurements[first[:, None] + np.arange(samples)]
    known = _filled(dataset.measurements)[np.maximum(first - 1, 0)]
    return WindowErrors(
        names(dataset.outputs),
        first,
        measured - simulated,
        measured,
        measured - known[:, None, :],
    )


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


#: Called with a word on what is being done.
Progress = Callable[[str], None]


@dataclass(frozen=True)
class ModelValidation:
    """One model on all recordings."""

    name: str
    model: Model  #: As it was simulated: with effects, driven where asked for
    datasets: tuple[Dataset, ...]  #: Of one sample time
    one_steps: tuple[OneStep, ...]  #: One a recording
    runs: tuple[FreeRuns, ...]  #: One a recording
    tests: ResidualTests
    options: ValidationOptions

    @cached_property
    def channels(self) -> tuple[Signal, ...]:
        """Outputs that any recording measures, in the model's order."""
        measured = {name for dataset in self.datasets for name in names(dataset.outputs)}
        return tuple(signal for signal in self.model.outputs if signal.name in measured)

    @property
    def sample_time(self) -> float:
        return self.datasets[0].sample_time

    @cached_property
    def horizons(self) -> tuple[float, ...]:
        """Those that fit at least one recording, s."""
        return tuple(sorted({horizon for run in self.runs for horizon in run.windows}))

    def windows(self, horizon: float) -> list[WindowErrors]:
        """The windows of a horizon, by recording."""
        return [run.windows[horizon] for run in self.runs if horizon in run.windows]

    def pooled(self, channel: str, horizon: float, what: str = "errors") -> FloatArray:
        """Errors of a channel over the windows of all recordings, shape (windows, samples)."""
        found = [
            getattr(windows, what)[:, :, windows.channels.index(channel)]
            for windows in self.windows(horizon)
            if channel in windows.channels
        ]
        return np.vstack(found)

    def sums(self, channel: str, horizon: float, what: str = "errors") -> BlockSums:
        """Squared errors by blocks of time, for intervals."""
        block = samples_of(max(self.options.block, horizon), self.sample_time)
        return block_sums(self.windows(horizon), channel, block, what)

    def noise_sd(self, channel: str) -> float:
        """Declared noise of a channel, the largest of the recordings'."""
        return max(
            float(d.noise_sd[names(d.outputs).index(channel)])
            for d in self.datasets
            if channel in names(d.outputs)
        )

    def free_run_errors(self, channel: str) -> tuple[FloatArray, FloatArray]:
        """Errors and measurements of the free run over the whole of each recording, joined."""
        errors, measured = [], []
        gap = gap_samples(self.options, self.sample_time)
        for run, dataset in zip(self.runs, self.datasets, strict=True):
            if channel not in names(dataset.outputs):
                continue
            column = names(dataset.outputs).index(channel)
            real = dataset.measurements[run.whole.first :, column]
            measured.append(real)
            errors.append(real - run.whole.simulated[:, column])
        return joined(errors, gap), joined(measured, gap)

    @cached_property
    def region_horizon(self) -> float:
        """The horizon whose errors are coloured by region: the longest up to 2 s."""
        upto = [horizon for horizon in self.horizons if horizon <= 2.0]
        return upto[-1] if upto else self.horizons[0]

    @cached_property
    def regions(self) -> list[RegionTable]:
        """The errors over the operating range."""
        errors: dict[str, list[FloatArray]] = {s.name: [] for s in self.channels}
        variables: dict[str, list[FloatArray]] = {}
        horizon = self.region_horizon
        for run, dataset in zip(self.runs, self.datasets, strict=True):
            if horizon not in run.windows:
                continue
            windows = run.windows[horizon]
            at = (windows.first[:, None] + np.arange(windows.errors.shape[1])).ravel()
            for name in errors:
                if name in windows.channels:
                    error = windows.errors[:, :, windows.channels.index(name)].ravel()
                else:
                    error = np.full(len(at), np.nan)
                errors[name].append(error)
            for name, values in operating_variables(dataset).items():
                variables.setdefault(name, []).append(values[at])
        whole = {n: v for n, v in variables.items() if len(v) == len(errors[self.channels[0].name])}
        return region_tables(
            {name: np.concatenate(parts) for name, parts in errors.items()},
            {name: np.concatenate(parts) for name, parts in whole.items()},
        )


def operating_variables(dataset: Dataset) -> dict[str, FloatArray]:
    """Signals that tell where in its range the rig is: measured outputs, then commands."""
    columns = {s.name: dataset.measurements[:, i] for i, s in enumerate(dataset.outputs)}
    columns |= {s.name: dataset.commands[:, i] for i, s in enumerate(dataset.inputs)}
    return columns


def gap_samples(options: ValidationOptions, sample_time: float) -> int:
    """Samples that part two recordings whose residuals are joined."""
    return max(options.tests.lags, samples_of(options.tests.longest, sample_time)) + 1


def joined(parts: Sequence[FloatArray], gap: int) -> FloatArray:
    """Arrays one after another, with missing samples between them."""
    between = np.full((gap, *parts[0].shape[1:]), np.nan)
    pieces = [piece for part in parts for piece in (part, between)]
    return np.concatenate(pieces[:-1])


def validate_all(
    models: Mapping[str, Model],
    datasets: Mapping[str, Sequence[Dataset]],
    options: ValidationOptions,
    progress: Progress | None = None,
) -> list[ModelValidation]:
    """Validate models on the same recordings, over the same windows.

    ``models``: by the name that they are shown with. ``datasets``: the recordings as each model
    takes them, in the same order. Raises ConfigurationError if sample times differ, or a recording
    is too short for the shortest horizon.
    """
    tell = progress or (lambda word: None)
    recordings = list(next(iter(datasets.values())))
    _check_sample_times(recordings)
    leads = [
        max(lead_samples([models[name]], datasets[name][i], options) for name in models)
        for i in range(len(recordings))
    ]
    found = []
    for name, model in models.items():
        own = tuple(datasets[name])
        tell(f"{name}: compile")
        rollout = Rollout(model, own[0].sample_time)
        steps, runs = [], []
        factors = None
        for dataset, lead in zip(own, leads, strict=True):
            tell(f"{name}: one step ahead on {dataset.name}")
            step = predict_one_step(model, dataset, rollout, options.predictor, factors)
            factors = step.noise_factors or None
            steps.append(step)
            tell(f"{name}: free runs on {dataset.name}")
            windows = common_windows(dataset, options, lead)
            runs.append(free_runs(model, dataset, rollout, step, windows, options))
        tell(f"{name}: residual tests")
        tests = tests_of(model, own, steps, options)
        found.append(ModelValidation(name, model, own, tuple(steps), tuple(runs), tests, options))
    return found


def tests_of(
    model: Model,
    datasets: Sequence[Dataset],
    steps: Sequence[OneStep],
    options: ValidationOptions,
) -> ResidualTests:
    """Residual tests over all recordings at once, of the channels that move."""
    step_s = datasets[0].sample_time
    gap = gap_samples(options, step_s)
    measured = [set(names(d.outputs)) for d in datasets]
    channels = [name for name in names(model.outputs) if all(name in m for m in measured)]
    channels = [
        name
        for name in channels
        if any(np.nanmax(y) > np.nanmin(y) for y in (d.output(name) for d in datasets))
    ]
    commands = joined([d.commands for d in datasets], gap)
    outputs = joined(
        [d.measurements[:, [names(d.outputs).index(c) for c in channels]] for d in datasets], gap
    )
    errors = joined([s.errors[:, [s.channels.index(c) for c in channels]] for s in steps], gap)
    return residual_tests(
        dict(zip(channels, errors.T, strict=True)),
        dict(zip(names(datasets[0].inputs), commands.T, strict=True)),
        dict(zip(channels, outputs.T, strict=True)),
        lags=options.tests.lags,
        longest_lag=samples_of(options.tests.longest, step_s),
        level=options.tests.level,
    )


def _check_sample_times(datasets: Sequence[Dataset]) -> None:
    for dataset in datasets[1:]:
        if not np.isclose(dataset.sample_time, datasets[0].sample_time, rtol=1e-6):
            raise ConfigurationError(
                f"{datasets[0].source} has a sample time of {datasets[0].sample_time:g} s, "
                f"{dataset.source} of {dataset.sample_time:g} s",
                where="real",
                remedy="validate on recordings of one sample time, or resample",
            )


#: A simulation that swings this much wider than the recording is no picture of it.
_WIDEST = 3.0


def calibrated(
    validation: ModelValidation,
    quanta: Mapping[str, float],
    progress: Callable[[int], None] | None = None,
) -> ResidualTests | None:
    """The residual tests with p-values from simulation.

    ``quanta``: resolution of each output; the rest of its declared noise is white. ``progress``:
    called with the number of simulations done. None if the model, left alone over the recording,
    leaves the range of what was measured.
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
    y = simulated_windows(rollout, dataset, [0], len(dataset), full[None])[0]
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
