"""A model held against recordings: everything that the report is made of.

One-step errors are what the model foretells of the next sample, from all samples before it. A model
with a derivative predicts through an unscented Kalman filter; its innovations are the errors. No
torque is estimated beside the state unless asked for: it would explain in the model's place. How
far the filter trusts the model is its process noise, and a wrong amount leaves correlated
innovations from a right model. So the intensities are scaled to the recording, one factor for the
beam and one for what drives it, by the likelihood of the innovations

    ln L = −½ Σ (ν²/s² + ln s²)

A network's one-step error is that of a step from measured values: its state at a sample is what was
measured and commanded before it. No observer is needed, and none would do.

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
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import (
    filled_states,
    fitted_starts,
    output_columns,
    remembered_states,
    simulated_windows,
    with_memory,
)
from trms_cli.identification.validation import metrics
from trms_cli.identification.validation.residual_tests import ResidualTests, residual_tests
from trms_cli.models.model import Model, Signal, names
from trms_cli.models.scales import longest_run
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import INPUTS
from trms_cli.observers.ukf import Ukf
from trms_cli.simulation.rollout import Rollout

_Positive = Annotated[float, Meta(gt=0)]
_Share = Annotated[float, Meta(gt=0, lt=1)]


@dataclass(frozen=True, kw_only=True)
class WindowOptions:
    """Free-run windows."""

    #: The state at the start of a window: the filter's, from all samples before it; that of the
    #: model's own best run over the seconds before it; or fitted to the window, which flatters
    start: Literal["estimated", "moving_horizon", "fitted"] = "estimated"
    history: _Positive = 2.0  #: s before the first window, and what ``moving_horizon`` fits to
    stride: _Positive = 0.5  #: s between the starts of two windows


@dataclass(frozen=True, kw_only=True)
class PredictorOptions:
    """The filter whose innovations are the one-step errors."""

    #: Scaled to the recording by maximum likelihood, or as the observer has it by default
    process_noise: Literal["fitted", "nominal"] = "fitted"
    torques: tuple[str, ...] = ()  #: Equations with an estimated one; none: the model answers alone
    settle: Annotated[float, Meta(ge=0)] = 2.0  #: s at the beginning that are not judged


@dataclass(frozen=True, kw_only=True)
class TestOptions:
    """Tests of the one-step errors."""

    lags: Annotated[int, Meta(ge=1, le=500)] = 20  #: Of the autocorrelation, samples
    longest: _Positive = 2.0  #: Longest lag of the tests with inputs, s
    level: _Share = 0.05  #: Probability of one or more false alarms in all tests together
    #: p-values from the limit of long recordings, or from simulations of the model with the
    #: sensors' noise and quanta on the recorded commands
    calibration: Literal["asymptotic", "simulated"] = "asymptotic"
    simulations: Annotated[int, Meta(ge=10)] = 50  #: How many, where they are asked for

    __test__ = False  # no test class, whatever its name


@dataclass(frozen=True, kw_only=True)
class ValidationOptions:
    """All that a validation is told besides model and recordings."""

    horizons: tuple[_Positive, ...] = (0.1, 0.5, 2.0, 10.0)  #: s, rising
    windows: WindowOptions = field(default_factory=WindowOptions)
    predictor: PredictorOptions = field(default_factory=PredictorOptions)
    tests: TestOptions = field(default_factory=TestOptions)
    block: _Positive = 10.0  #: s of the blocks that intervals are bootstrapped over
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the bootstrap and of simulations

    def __post_init__(self) -> None:
        if not self.horizons or any(
            b <= a for a, b in zip(self.horizons, self.horizons[1:], strict=False)
        ):
            raise ConfigurationError(
                f"{list(self.horizons)} given",
                where="horizons",
                remedy="give one or more times in s, rising: 'horizons=[0.1,0.5,2,10]'",
            )


#: Kinds of states whose process noise is scaled together; the others are the drive's.
_BEAM = ("angle", "momentum")
#: log10 of the factors that are tried; the filter breaks down where it trusts its model entirely.
_RANGE = (-4.0, 2.0)
#: Samples that the factors are fitted to; more of them tell no more of two figures.
_SAMPLES_TO_FIT = 6000


@dataclass(frozen=True)
class OneStep:
    """Predictions of the next sample."""

    channels: tuple[str, ...]  #: Columns of the arrays
    errors: FloatArray  #: (n, n_y) array; measured minus predicted; NaN where there is none
    #: (n, n_y) array; what the predictor believes its errors to be; NaN for one that does not say
    expected_sd: FloatArray
    states: FloatArray  #: (n, n_x) array; with the measurement at the sample known
    #: Of the process noise, by ``beam`` and ``drive``; empty without a filter
    noise_factors: Mapping[str, float] = field(default_factory=dict)
    predictor: str = ""  #: How the prediction was made, for people


def predict_one_step(
    model: Model,
    dataset: Dataset,
    rollout: Rollout,
    options: PredictorOptions,
    noise_factors: Mapping[str, float] | None = None,
    prepared: OneStepFilter | None = None,
) -> OneStep:
    """Predict every sample from those before it.

    ``rollout``: of the model at the recording's sample time. ``noise_factors``: of the process
    noise, where they are known already (from another recording). ``prepared``: over a recording
    with the same commands, to be used again with these measurements.
    """
    remembered = remembered_states(model, dataset)
    if remembered is not None:
        return _from_measured(model, dataset, rollout, remembered)
    filter_ = prepared or OneStepFilter(model, dataset, options)
    settled = round(options.settle / dataset.sample_time)
    factors = dict(noise_factors or {"beam": 1.0, "drive": 1.0})
    if noise_factors is None and options.process_noise == "fitted":
        part = dataset.part(0, min(len(dataset), _SAMPLES_TO_FIT))
        short = filter_ if len(part) == len(dataset) else OneStepFilter(model, part, options)
        factors = _fitted_factors(short, settled)
    errors, sd, states = filter_.run(factors, dataset.measurements)
    errors[:settled] = np.nan
    torques = f"torques estimated on {', '.join(options.torques)}"
    words = f"unscented Kalman filter, {torques if options.torques else 'no torque estimated'}"
    if options.process_noise == "fitted":
        words += (
            f", process noise scaled by maximum likelihood (beam {factors['beam']:.2g}, "
            f"drive {factors['drive']:.2g})"
        )
    return OneStep(names(dataset.outputs), errors, sd, states, factors, words)


def _from_measured(model: Model, dataset: Dataset, rollout: Rollout, states: FloatArray) -> OneStep:
    n = len(dataset)
    first = np.flatnonzero(~np.isnan(states[: n - 1]).any(axis=1))
    columns = output_columns(model, dataset)
    predicted = np.full((n, len(columns)), np.nan)
    if first.size:
        simulated = rollout.outputs(
            dataset.commands, first, np.full(len(first), 2), states[first]
        ).y
        predicted[first + 1] = simulated[1::2][:, columns]
    return OneStep(
        names(dataset.outputs),
        dataset.measurements - predicted,
        np.full(predicted.shape, np.nan),
        states,
        {},
        "one step of the model from measured values",
    )


class OneStepFilter:
    """A filter over one recording, run again and again with other process noise."""

    def __init__(self, model: Model, dataset: Dataset, options: PredictorOptions) -> None:
        self._dataset, self._n_x = dataset, model.n_x
        # Every sample judges the model; none is an outlier because the model did not foresee it.
        self._observer = Ukf(disturbances=options.torques, gate=None)
        self._state = self._observer.init(
            ObserverSetup(
                model,
                dataset.sample_time,
                names(dataset.outputs),
                dict(zip(names(dataset.outputs), dataset.noise_sd.tolist(), strict=True)),
                dataset.measurements[0],
                dataset.commands[0],
            )
        )
        function = self._state.function
        self._inputs = function.inputs
        self._initial = [values.copy() for values in function.inputs]
        self._variances = dict(zip(INPUTS, function.inputs, strict=True))["q"]
        self._nominal = self._variances.copy()
        kinds = kinds_of_states(model)
        self._group = np.array(
            ["beam" if kind in _BEAM else "drive" for kind in kinds]
            + [""] * (len(self._nominal) - len(kinds))
        )

    def run(
        self, factors: Mapping[str, float], measurements: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Innovations, their deviations, and filtered states, from the beginning.

        ``factors``: of the process noise. ``measurements``: (n, n_y) array or None; others than the
        recording's.
        """
        dataset, state, observer = self._dataset, self._state, self._observer
        if measurements is None:
            measurements = dataset.measurements
        for values, initial in zip(self._inputs, self._initial, strict=True):
            values[...] = initial
        state.has_started = False
        for name, factor in factors.items():
            is_member = self._group == name
            self._variances[is_member] = factor**2 * self._nominal[is_member]
        n, n_y = measurements.shape
        innovations, sd = np.empty((n, n_y)), np.empty((n, n_y))
        states = np.empty((n, self._n_x))
        command = dataset.commands[0]
        with np.errstate(all="ignore"):
            for k in range(n):
                estimate = observer.step(state, command, measurements[k], None)
                innovations[k], sd[k] = estimate.innovation, estimate.innovation_sd
                states[k] = estimate.x
                command = dataset.commands[k]
        return innovations, sd, states


def _fitted_factors(filter_: OneStepFilter, skipped: int) -> dict[str, float]:
    """Factors of the process noise that make the innovations most likely, one after the other."""
    factors = {"drive": 1.0, "beam": 1.0}

    def cost(name: str) -> Callable[[float], float]:
        def of(exponent: float) -> float:
            innovations, sd, _ = filter_.run(factors | {name: 10.0**exponent})
            share = (innovations / sd)[skipped:]
            value = np.nansum(np.where(np.isnan(share), 0.0, share**2 + 2 * np.log(sd[skipped:])))
            return float(value) if np.isfinite(value) else 1e300

        return of

    for name in factors:
        factors[name] = 10.0 ** _smallest(cost(name))
    return factors


def _smallest(cost: Callable[[float], float]) -> float:
    """A coarse grid and one parabola: the likelihood is flat to within a third of a decade."""
    grid = np.arange(_RANGE[0], _RANGE[1] + 0.5, 1.0)
    values = [cost(float(x)) for x in grid]
    best = int(np.argmin(values))
    if best in (0, len(grid) - 1):
        return float(grid[best])
    left, middle, right = values[best - 1 : best + 2]
    bend = left - 2 * middle + right
    move = 0.5 * (left - right) / bend if bend > 0 else 0.0
    trial = float(grid[best] + np.clip(move, -0.5, 0.5))
    return trial if cost(trial) < middle else float(grid[best])


@dataclass(frozen=True)
class FreeRuns:
    """All free runs of a model over one recording."""

    windows: Mapping[float, metrics.WindowErrors]  #: By horizon, s
    first: int  #: Sample at which the run to the end of the recording begins
    whole: FloatArray  #: (n − first, n_y) array; that run, in the order of the recording's outputs


def common_windows(
    dataset: Dataset, options: ValidationOptions, lead: int, longest: float
) -> dict[float, IntArray]:
    """First samples of the windows of every horizon that fits.

    ``lead``: samples that are needed before a window. ``longest``: s, after which a free run of a
    model that falls over says nothing; the shortest horizon stays. Raises ConfigurationError if no
    horizon fits.
    """
    step = dataset.sample_time
    stride = max(1, round(options.windows.stride / step))
    first_samples = {}
    for horizon in options.horizons:
        last = len(dataset) - samples_of(horizon, step)
        first = np.arange(lead, last + 1, stride, dtype=np.int64)
        says_something = horizon <= longest or horizon == options.horizons[0]
        if first.size and horizon >= 0.5 * step and says_something:
            first_samples[horizon] = first
    if not first_samples:
        minimum = lead * step + options.horizons[0]
        raise ConfigurationError(
            f"{dataset.source} lasts {dataset.duration:.3g} s, and {minimum:.3g} s are needed: "
            f"{lead * step:.3g} s to estimate a start from, then the shortest horizon",
            where="real",
            remedy="give a longer recording, or shorten windows.history and horizons",
        )
    return first_samples


def lead_samples(models: Sequence[Model], dataset: Dataset, options: ValidationOptions) -> int:
    """Samples before the first window that every model has its start from."""
    lead = max(2, round(options.windows.history / dataset.sample_time))
    for model in models:
        states = remembered_states(model, dataset)
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
    remembered = remembered_states(model, dataset)
    shortest = min(firsts)
    every = firsts[shortest]
    if remembered is not None:
        starts = filled_states(remembered)[every]
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
    return FreeRuns(windows, origin, whole[0])


def _errors(
    dataset: Dataset, rollout: Rollout, first: IntArray, samples: int, starts: FloatArray
) -> metrics.WindowErrors:
    simulated = simulated_windows(rollout, dataset, first, samples, starts)
    measured = dataset.measurements[first[:, None] + np.arange(samples)]
    last_values = filled_states(dataset.measurements)[np.maximum(first - 1, 0)]
    return metrics.WindowErrors(
        names(dataset.outputs),
        first,
        measured - simulated,
        measured,
        measured - last_values[:, None, :],
    )


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

    def windows(self, horizon: float) -> list[metrics.WindowErrors]:
        """The windows of a horizon, by recording."""
        return [run.windows[horizon] for run in self.runs if horizon in run.windows]

    def pooled(self, channel: str, horizon: float, what: str = "errors") -> FloatArray:
        """Errors of a channel over the windows of all recordings, shape (windows, samples)."""
        parts = [
            getattr(windows, what)[:, :, windows.channels.index(channel)]
            for windows in self.windows(horizon)
            if channel in windows.channels
        ]
        return np.vstack(parts)

    def sums(self, channel: str, horizon: float, what: str = "errors") -> metrics.BlockSums:
        """Squared errors by blocks of time, for intervals."""
        block = samples_of(max(self.options.block, horizon), self.sample_time)
        return metrics.block_sums(self.windows(horizon), channel, block, what)

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
            real = dataset.measurements[run.first :, column]
            measured.append(real)
            errors.append(real - run.whole[:, column])
        return join_parts(errors, gap), join_parts(measured, gap)

    @cached_property
    def region_horizon(self) -> float:
        """The horizon whose errors are coloured by region: the longest up to 2 s."""
        upto = [horizon for horizon in self.horizons if horizon <= 2.0]
        return upto[-1] if upto else self.horizons[0]

    @cached_property
    def regions(self) -> list[metrics.RegionTable]:
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
        return metrics.region_tables(
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


def join_parts(parts: Sequence[FloatArray], gap: int) -> FloatArray:
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
    longest = min(longest_run(model) for model in models.values())
    validations = []
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
            windows = common_windows(dataset, options, lead, longest)
            runs.append(free_runs(model, dataset, rollout, step, windows, options))
        tell(f"{name}: residual tests")
        tests = tests_of(model, own, steps, options)
        validations.append(
            ModelValidation(name, model, own, tuple(steps), tuple(runs), tests, options)
        )
    return validations


def tests_of(
    model: Model, datasets: Sequence[Dataset], steps: Sequence[OneStep], options: ValidationOptions
) -> ResidualTests:
    """Residual tests over all recordings at once, of the channels that move."""
    step_s = datasets[0].sample_time
    gap = gap_samples(options, step_s)
    channels = [
        name
        for name in names(model.outputs)
        if all(name in names(d.outputs) for d in datasets)
        and any(np.nanmax(y) > np.nanmin(y) for y in (d.output(name) for d in datasets))
    ]
    commands = join_parts([d.commands for d in datasets], gap)
    outputs = join_parts(
        [d.measurements[:, [names(d.outputs).index(c) for c in channels]] for d in datasets], gap
    )
    errors = join_parts([s.errors[:, [s.channels.index(c) for c in channels]] for s in steps], gap)
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


def calibrate_tests(
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
    states = validation.one_steps[i].states
    start = states[np.flatnonzero(~np.isnan(states).any(axis=1))[0]]
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
    readings = np.where(quantum > 0, np.round((noisy - phase) / step) * step + phase, noisy)
    return np.where(np.isnan(dataset.measurements), np.nan, readings)
