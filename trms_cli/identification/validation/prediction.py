"""One-step errors: what a model foretells of the next sample, from all samples before it.

A model with a derivative predicts through an unscented Kalman filter; its innovations are the
errors. No torque is estimated beside the state unless asked for: it would explain in the model's
place. How far the filter trusts the model is its process noise, and a wrong amount leaves
correlated innovations from a right model. So the intensities are scaled to the recording, one
factor for the beam and one for what drives it, by the likelihood of the innovations

    ln L = −½ Σ (ν²/s² + ln s²)

A network's one-step error is that of a step from measured values: its state at a sample is what was
measured and commanded before it. No observer is needed, and none would do: the one-step prediction
of such a model is one step from measured values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import output_columns
from trms_cli.identification.validation.options import PredictorOptions
from trms_cli.models.discrete import copied_states
from trms_cli.models.model import Model, names
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import INPUTS
from trms_cli.observers.ukf import Ukf
from trms_cli.simulation.rollout import Rollout


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
    #: (n, n_y) array; measured minus predicted, in the outputs' units; NaN where there is none
    errors: FloatArray
    #: (n, n_y) array; what the predictor believes its errors to be; NaN for one that does not say
    expected_sd: FloatArray
    #: (n, n_x) array; the model's states with the measurement at the sample known
    states: FloatArray
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
    remembered = measured_states(model, dataset)
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
    words = "unscented Kalman filter, " + (
        f"torques estimated on {', '.join(options.torques)}"
        if options.torques
        else "no torque estimated"
    )
    if options.process_noise == "fitted":
        words += (
            f", process noise scaled by maximum likelihood (beam {factors['beam']:.2g}, "
            f"drive {factors['drive']:.2g})"
        )
    return OneStep(names(dataset.outputs), errors, sd, states, factors, words)


def _from_measured(model: Model, dataset: Dataset, rollout: Rollout, states: FloatArray) -> OneStep:
    """One step of the model from measured states."""
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
        state.started = False
        for name, factor in factors.items():
            chosen = self._group == name
            self._variances[chosen] = factor**2 * self._nominal[chosen]
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
