"""A model held against recordings: everything that the report is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.dataset import Dataset, FloatArray
from trms_cli.identification.validation.comparison import BlockSums, block_sums
from trms_cli.identification.validation.free_run import (
    FreeRuns,
    WindowErrors,
    common_windows,
    free_runs,
    lead_samples,
    samples_of,
)
from trms_cli.identification.validation.options import ValidationOptions
from trms_cli.identification.validation.prediction import OneStep, predict_one_step
from trms_cli.identification.validation.regions import RegionTable, region_tables
from trms_cli.identification.validation.residual_tests import ResidualTests, residual_tests
from trms_cli.models.model import Model, Signal, names
from trms_cli.simulation.rollout import Rollout

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
        """Errors of a channel over the windows of all recordings, shape (windows, samples).

        Parameters
        ----------
        what : {"errors", "measured", "unchanged"}
        """
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

    @property
    def gap(self) -> int:
        """Missing samples between two recordings that are joined: no lag reaches across."""
        return gap_samples(self.options, self.sample_time)

    def free_run_errors(self, channel: str) -> tuple[FloatArray, FloatArray]:
        """Errors and measurements of the free run over the whole of each recording, joined."""
        errors, measured = [], []
        for run, dataset in zip(self.runs, self.datasets, strict=True):
            if channel not in names(dataset.outputs):
                continue
            column = names(dataset.outputs).index(channel)
            real = dataset.measurements[run.whole.first :, column]
            measured.append(real)
            errors.append(real - run.whole.simulated[:, column])
        return joined(errors, self.gap), joined(measured, self.gap)

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

    Parameters
    ----------
    models : dict of str to Model
        By the name that they are shown with.
    datasets : dict of str to sequence of Dataset
        The recordings as each model takes them, in the same order.
    progress : callable, optional

    Raises
    ------
    ConfigurationError
        If sample times differ, or a recording is too short for the shortest horizon.
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
