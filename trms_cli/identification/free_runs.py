"""Free runs: a model alone over windows of a recording, from starts that know the past only.

Gauss–Newton with exact sensitivities fits the state at the beginning of a stretch,

    min over x₀  Σ_k |(y_k − ŷ_k(x₀))/σ|² + |(x₀ − x̂)/s|²

by Levenberg–Marquardt, all stretches at once. The prior (x̂, s wide) only settles what the
measurements leave open. Where the stretch lies *before* a window, the model's state at its end is
the window's start: nothing of the window has been seen.

``trms validate`` and ``trms diagnose`` ask more of a model; the figures over windows end to end are
those of a fit. With the uncertainty of its parameters they make its assessment.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox import map_fit
from trms_cli.identification.greybox.windows import StartEstimator, Windows, spread_of_memory
from trms_cli.identification.problem import FitProblem, FitResult, with_values
from trms_cli.identification.validation.metrics import fit_percent, largest, rms
from trms_cli.models.discrete import copied_states, root_of
from trms_cli.models.discretisation import noise_of_states
from trms_cli.models.model import Model, index_of, names
from trms_cli.models.scales import longest_run
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.observers.augmentation import InitialSd
from trms_cli.simulation.rollout import Rollout

#: s before a window from which its start is estimated.
HISTORY = 2.0
_FIRST_DAMPING = 1e-3
#: No residual is divided by less than this (in the output's unit).
_LEAST_SD = 1e-9


class StartSearch(NamedTuple):
    """When a search for starts ends."""

    iterations: int = 12
    enough: float = 1e-4  #: Relative fall of the cost
    least_cost: float = 1e-300  #: Smaller costs count as this where falls are compared
    most_damping: float = 1e2  #: Beyond it a start that finds no better one is given up


_CAREFUL = StartSearch()


def output_columns(model: Model, dataset: Dataset) -> list[int]:
    """Columns of the model's outputs that a recording measures, in the recording's order."""
    return [index_of(model.outputs, s.name, "an output") for s in dataset.outputs]


def simulated_windows(
    rollout: Rollout,
    dataset: Dataset,
    first: IntArray | Sequence[int],
    samples: int,
    starts: FloatArray,
    p: FloatArray | None = None,
) -> FloatArray:
    """Outputs of the model over windows, (m, samples, n_y), in the order of the recording's.

    ``first``: (m,) array; first sample of each window. ``starts``: (m, rollout.n_x) array; states
    there, with memory. ``p``: (n_p,) array; all parameters; None: the model's.
    """
    columns = output_columns(rollout.model, dataset)
    with np.errstate(all="ignore"):
        y = rollout.outputs(dataset.commands, first, np.full(len(first), samples), starts, p).y
    return np.asarray(y[:, columns].reshape(len(first), samples, len(columns)))


def fitted_starts(
    rollout: Rollout,
    dataset: Dataset,
    first: IntArray,
    samples: int,
    guess: FloatArray,
    prior_sd: FloatArray | None = None,
    *,
    search: StartSearch = _CAREFUL,
    p: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Fit the states at the beginnings of stretches, all of ``samples``.

    ``first``: (m,) array; first sample of each stretch. ``guess``: (m, rollout.n_x) array; states
    around which the starts are sought, with memory; that of the input path stays. ``prior_sd``:
    (n_x,) array; of the model's states around the guess; None: as wide as what the default observer
    believes before the first measurement. ``p``: (n_p,) array; all parameters; None: the model's.
    Returns starts and ends, (m, rollout.n_x) arrays: states at the first sample, and one sample
    after the last.
    """
    model, n = rollout.model, rollout.n_free
    columns, count = output_columns(model, dataset), np.full(len(first), samples)
    measured = dataset.measurements[first[:, None] + np.arange(samples)]
    present, shape = ~np.isnan(measured), measured.shape
    sd = np.where(dataset.noise_sd > 0, dataset.noise_sd, _LEAST_SD)
    if prior_sd is None:
        prior_sd = np.array([getattr(InitialSd(), kind) for kind in kinds_of_states(model)])
    remembered = spread_of_memory(guess[:, model.n_x : n], float(sd.min()))
    prior_sd = np.concatenate([prior_sd, remembered])

    def simulated(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Costs, residuals, their slopes in the model's states, and the ends.

        A start that makes the model overflow costs more than anything.
        """
        with np.errstate(all="ignore"):
            now = rollout.sensitivities(dataset.commands, first, count, x, p)
            r = np.where(present, (measured - now.y[:, columns].reshape(shape)) / sd, 0.0)
            slope = now.dy[:, columns, :n].reshape(*shape, n) / sd[:, None]
            slope = np.where(present[..., None] & np.isfinite(slope), slope, 0.0)
            gaps = (x[:, :n] - guess[:, :n]) / prior_sd
            cost = np.sum(r**2, axis=(1, 2)) + np.sum(gaps**2, axis=1)
        r = np.where(np.isfinite(r), r, 0.0)
        return np.where(np.isfinite(cost), cost, np.inf), r, slope, now.ends

    x = guess.copy()
    cost, r, slope, ends = simulated(x)
    damping = np.full(len(first), _FIRST_DAMPING)
    for _ in range(search.iterations):
        normal = np.einsum("jkci,jkcl->jil", slope, slope, optimize=True) + np.diag(prior_sd**-2.0)
        right = np.einsum("jkci,jkc->ji", slope, r, optimize=True)
        right += (guess - x)[:, :n] / prior_sd**2
        diagonal = np.einsum("jii->ji", normal)
        damped = normal + (damping[:, None] * diagonal)[:, :, None] * np.eye(n)
        trial = x.copy()
        trial[:, :n] += np.linalg.solve(damped, right[..., None])[..., 0]
        cost_after, r_after, slope_after, ends_after = simulated(trial)
        better = cost_after < cost
        with np.errstate(invalid="ignore"):
            gained = np.where(better, cost - cost_after, 0.0) / np.maximum(cost, search.least_cost)
        x[better], ends[better] = trial[better], ends_after[better]
        cost[better], r[better], slope[better] = (
            cost_after[better],
            r_after[better],
            slope_after[better],
        )
        damping = np.where(better, damping / 10, damping * 10)
        if np.all((gained < search.enough) & (better | (damping > search.most_damping))):
            break
    return x, ends


def with_memory(
    rollout: Rollout, dataset: Dataset, first: IntArray, states: FloatArray
) -> FloatArray:
    """States completed by what the input path remembers, which follows from the commands alone.

    ``first``: (m,) array of int; samples of the states. ``states``: (m, n_x) array; the model's.
    """
    n = rollout.model.n_x
    full = np.empty((len(first), rollout.n_x))
    full[:, :n] = states
    if rollout.n_x == n:
        return full
    rest = rollout.model.rest()
    x, at = rollout.initial(rest, dataset.commands[0]), 0
    for j in np.argsort(first, kind="stable"):
        if first[j] > at:
            between = [at], [int(first[j]) - at]
            x[n:] = rollout.outputs(dataset.commands, *between, x[None]).ends[0, n:]
            x[:n], at = rest, int(first[j])
        full[j, n:] = x[n:]
    return full


@dataclass(frozen=True)
class WindowRuns:
    """A model's free runs over one recording."""

    dataset: Dataset
    #: (n, n_y) array; in the order of the recording's outputs; NaN before the first window and
    #: after the last, infinite where the simulation overflowed
    simulated: FloatArray
    window: npt.NDArray[np.int64]  #: (m,) array of int; first sample of each window

    @property
    def errors(self) -> FloatArray:
        """Measured minus simulated, (n, n_y)."""
        return np.asarray(self.dataset.measurements - self.simulated)


def measured_states(model: Model, dataset: Dataset) -> FloatArray | None:
    """The states at every sample, as far as measured.

    Returns (n, n_x) array or None; NaN where something is missing or lies before the recording;
    None for a model that has a derivative, or a state that is neither a measured output nor a copy
    of one or of an input.
    """
    if getattr(model, "sample_time", None) is None:
        return None
    copies = copied_states(model)
    measured = {name: column for column, name in enumerate(names(dataset.outputs))}
    states = np.full((len(dataset), model.n_x), np.nan)
    for i in range(model.n_x):
        kind, at, delay = "x", i, 0
        while kind == "x" and at in copies and delay <= model.n_x:
            kind, at = copies[at]
            delay += 1
        if kind == "u":
            source = dataset.commands[:, at]
        elif model.states[at].name in measured:
            source = dataset.measurements[:, measured[model.states[at].name]]
        else:
            return None
        states[delay:, i] = source[: len(dataset) - delay]
    return states


def remembered_states(model: Model, dataset: Dataset) -> FloatArray | None:
    """:func:`measured_states` of a model that takes them as they were measured; else None.

    A model with noise of its own, as a linear one has it, tells how far a measurement is from the
    state; a filter or a fit weighs them then.
    """
    if model.sample_time is None or _is_noisy(model):
        return None
    return measured_states(model, dataset)


def _is_noisy(model: Model) -> bool:
    assert model.sample_time is not None
    return bool(noise_of_states(model, model.parameters.values, model.sample_time).any())


def filled_states(values: FloatArray) -> FloatArray:
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


def window_runs(
    model: Model, datasets: Sequence[Dataset], length: float, *, jobs: int = 1
) -> list[WindowRuns]:
    """Free runs over windows of ``length`` s end to end, of the model with the values to be judged.

    A recording that is too short for any window is left out. A black box without noise of its own
    whose states all are measured, or remembered from what is, starts from those measurements.
    """
    runs = []
    rollouts: dict[float, Rollout] = {}
    for dataset in datasets:
        step = dataset.sample_time
        rollout = rollouts.setdefault(step, Rollout(model, step, jobs=jobs))
        history = max(2, round(min(HISTORY, longest_run(model)) / step))
        if len(dataset) < 2 * history:
            continue
        first, count = dataset.part(history, len(dataset)).windows(length)
        first = first + history
        starts = _starts(model, dataset, rollout, first, history)
        with np.errstate(all="ignore"):
            y = rollout.outputs(dataset.commands, first, count, starts).y
        simulated = np.full(dataset.measurements.shape, np.nan)
        columns = output_columns(model, dataset)
        samples = np.concatenate([np.arange(a, a + c) for a, c in zip(first, count, strict=True)])
        simulated[samples] = np.where(np.isfinite(y[:, columns]), y[:, columns], np.inf)
        runs.append(WindowRuns(dataset, simulated, first))
    return runs


def _starts(
    model: Model, dataset: Dataset, rollout: Rollout, first: IntArray, history: int
) -> FloatArray:
    """States at the first samples of windows, from what lies before them, (m, rollout.n_x)."""
    begin, prior_sd = first - history, None
    states = None
    if model.sample_time == dataset.sample_time:
        states = measured_states(model, dataset)
    if states is not None:
        states = filled_states(states)
        if not _is_noisy(model):
            return with_memory(rollout, dataset, first, states[first])
        guess = with_memory(rollout, dataset, begin, states[begin])
        prior_sd = _sd_of_measured(model)
    else:
        prior = StartEstimator(rollout, dataset, begin).at(model.parameters.values)
        guess = with_memory(rollout, dataset, begin, prior.states[:, : model.n_x])
    with np.errstate(all="ignore"):
        _, starts = fitted_starts(rollout, dataset, begin, history, guess, prior_sd)
    return starts


def _sd_of_measured(model: Model) -> FloatArray:
    """How far states that are outputs, or their past, may lie from what was measured, (n_x,).

    As far as the noise of the model's equation for the output; commands are known.
    """
    assert model.sample_time is not None
    noise = noise_of_states(model, model.parameters.values, model.sample_time)
    copies = copied_states(model)
    roots = [root_of(copies, i) for i in range(model.n_x)]
    return np.array([max(_LEAST_SD, noise[at] if kind == "x" else 0.0) for kind, at in roots])


def error_figures(runs: Sequence[WindowRuns]) -> dict[str, dict[str, Any]]:
    """RMS error, largest error and fit of each output over all recordings.

    Returns by output: ``rmse`` and ``max_abs_error`` in its unit, ``fit_percent``, ``unit``; None
    for a figure that does not exist. A simulation that overflowed has none.
    """
    table: dict[str, dict[str, Any]] = {}
    outputs = {signal.name: signal for run in runs for signal in run.dataset.outputs}
    for signal in outputs.values():
        errors, measured = [], []
        for run in runs:
            if signal.name in names(run.dataset.outputs):
                column = index_of(run.dataset.outputs, signal.name, "an output")
                errors.append(run.errors[:, column])
                measured.append(run.dataset.measurements[:, column])
        e, y = np.concatenate(errors), np.concatenate(measured)
        table[signal.name] = {
            "rmse": _plain(rms(e)),
            "max_abs_error": _plain(largest(e)),
            "fit_percent": _plain(fit_percent(e, y)),
            "unit": signal.unit,
        }
    return table


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


#: What a method's details say of the parameters, and what the document says elsewhere.
_STATISTICS, _ELSEWHERE = ("identifiability", "outputs", "profiles"), ("on_bounds",)


@dataclass
class Assessment:
    """A fit with all that is told of it."""

    result: FitResult
    #: Of the parameters, as JSON has it; empty for a network
    statistics: dict[str, Any] = field(default_factory=dict)
    #: ``before``, ``after``: Free runs of the model before and after, over ``fit`` and ``held_out``
    before: dict[str, list[WindowRuns]] = field(default_factory=dict)
    after: dict[str, list[WindowRuns]] = field(default_factory=dict)

    @property
    def deviations(self) -> dict[str, float | None]:
        """Standard deviations of the fitted parameters, absolute; None where there is none."""
        covariance = self.result.covariance
        if covariance is None:
            return dict.fromkeys(self.result.values)
        roots = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        return {
            name: float(sd) if np.isfinite(sd) and sd > 0 else None
            for name, sd in zip(self.result.values, roots, strict=True)
        }

    @property
    def correlation(self) -> FloatArray | None:
        """Correlation of the estimates, (n_f, n_f); NaN beside one without variance."""
        covariance = self.result.covariance
        return None if covariance is None else map_fit.correlations(covariance)


def assess(problem: FitProblem, result: FitResult) -> Assessment:
    """What the data say of the fitted parameters; nothing yet of errors."""
    statistics = {key: result.details[key] for key in _STATISTICS if key in result.details}
    elsewhere = (*_STATISTICS, *_ELSEWHERE)
    details = {key: value for key, value in result.details.items() if key not in elsewhere}
    assessment = Assessment(replace(result, details=details), statistics)
    if result.values and np.isfinite(result.cost) and result.covariance is None:
        _add_statistics(problem, assessment)
    return assessment


def _add_statistics(problem: FitProblem, assessment: Assessment) -> None:
    """Covariance and identifiability, for a method that knows no slopes."""
    result = assessment.result
    every = np.ones(len(result.values), dtype=bool)
    fit = map_fit.fit_from(Windows(problem), result.theta, map_fit.MapSettings(), held=every)
    if fit.information is not None and (covariance := fit.covariance) is not None:
        assessment.result = replace(result, covariance=covariance)
        judgement = map_fit.identifiability(fit.information, problem.names, covariance)
        assessment.statistics["identifiability"] = asdict(judgement)


def add_free_runs(problem: FitProblem, assessment: Assessment, fitted: Model | None = None) -> None:
    """Simulate what was fitted and what was held out, with the old model and the new.

    ``fitted``: the model that a network was trained to; None: the problem's with the fitted values.
    """
    after = fitted or with_values(problem.model, assessment.result.values)
    if assessment.result.remodel is not None:
        after = assessment.result.remodel(after)
    parts = {"fit": problem.datasets, "held_out": problem.validation}
    length, jobs = problem.window_length, problem.jobs
    for part, datasets in parts.items():
        assessment.after[part] = window_runs(after, datasets, length, jobs=jobs)
        if fitted is None:
            assessment.before[part] = window_runs(problem.model, datasets, length, jobs=jobs)


def at_bounds(problem: FitProblem, values: Mapping[str, float]) -> dict[str, str]:
    """Which fitted values lie on a bound: ``lower`` or ``upper`` by name."""
    at = problem.on_bounds(np.array([values[name] for name in problem.names]))
    words = {-1: "lower", 1: "upper"}
    return {name: words[on] for name, on in zip(problem.names, at.tolist(), strict=True) if on}
