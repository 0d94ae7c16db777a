"""Regressors and targets from samples, and a network's error on them: one step ahead, and many.

One step ahead it is that of NNARX, over a simulation of many steps that of NNOE. In a window of a
simulation the network runs on its own outputs; measured are only the samples before its start.
Gradients go back through the simulated steps, Jacobians forward along them; both are exact. All
windows are simulated side by side, so that each step is one matrix product for all of them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import RecordingError
from trms_cli.identification.blackbox.recursion import (
    corrects_itself,
    filled,
    recursion_of,
    simulate_states,
)
from trms_cli.identification.blackbox.trainable import TrainableNetwork
from trms_cli.identification.dataset import Dataset
from trms_cli.models.innovation_network import InnovationStructure
from trms_cli.models.model import names
from trms_cli.models.network import NarxStructure, Network

#: What the networks of this package predict from.
Structure = NarxStructure | InnovationStructure

#: A signal whose spread is below this share of its size never moves, rounding apart.
_LEAST_SPREAD = 1e-9


class SampledSignals(Protocol):
    """Which signals a model has, and how often it steps."""

    @property
    def outputs(self) -> tuple[str, ...]: ...
    @property
    def inputs(self) -> tuple[str, ...]: ...
    @property
    def sample_time(self) -> float: ...


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
    output_mean: FloatArray  #: (n_y,) array; of the target, of increments where it is one
    output_sd: FloatArray  #: (n_y,) array; likewise
    level_sd: FloatArray  #: (n_y,) array; of the outputs themselves: the scale of simulation errors


def sample_signals(
    dataset: Dataset,
    structure: SampledSignals,
    smoothing: float = 0.0,
    key: str = "method.regressors.sample_time",
) -> Samples:
    """The signals of a structure from a recording, at the structure's sample time.

    Of the outputs every d-th sample is taken; a command is the mean over the d samples.

    ``smoothing``: s, length of a cubic Savitzky–Golay window over the outputs before samples are
    taken; 0 for none. It looks ahead, so it is for fitting only. ``key``: where the
    configuration has the sample time, for messages. Raises RecordingError if the sample times have
    no whole ratio, a signal is missing, or a channel has no sample.
    """
    ratio = structure.sample_time / dataset.sample_time
    step = round(ratio)
    if step < 1 or abs(ratio - step) > 1e-6 * ratio:
        raise RecordingError(
            f"the recording is sampled each {dataset.sample_time:g} s and the model each "
            f"{structure.sample_time:g} s",
            where=dataset.source,
            remedy=f"choose a whole multiple: {key}={max(1, step) * dataset.sample_time:g}",
        )
    outputs = _columns(dataset, structure.outputs, dataset.measurements, names(dataset.outputs))
    inputs = _columns(dataset, structure.inputs, dataset.commands, names(dataset.inputs))
    if smoothing > 0:
        outputs = smooth_outputs(outputs, round(smoothing / dataset.sample_time))
    n = len(outputs) // step
    means = inputs[: n * step].reshape(n, step, -1).mean(axis=1) if step > 1 else inputs[:n]
    return Samples(outputs[: n * step : step], means, dataset.name)


def _columns(
    dataset: Dataset,
    requested_names: Sequence[str],
    values: FloatArray,
    recorded_names: Sequence[str],
) -> FloatArray:
    for name in requested_names:
        if name not in recorded_names:
            raise RecordingError(
                f"{name!r} is not recorded",
                where=dataset.source,
                remedy=f"there are: {', '.join(recorded_names)}; choose a model that has no more",
            )
    result = values[:, [list(recorded_names).index(name) for name in requested_names]]
    for name, column in zip(requested_names, result.T, strict=True):
        if not np.any(np.isfinite(column)):
            raise RecordingError(
                f"{name!r} has no sample", where=dataset.source, remedy="leave it out or record it"
            )
    return result


def smooth_outputs(outputs: FloatArray, window: int) -> FloatArray:
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


def rows(structure: Structure, samples: Samples) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Regressors (n, n_phi), targets (n, n_out) and the sample that each row predicts, (n,).

    Residuals among the regressors are zero. Of a network in innovations form the states are the
    measured samples that they foretell. Rows that lack a sample are left out.
    """
    if isinstance(structure, InnovationStructure):
        return _state_rows(structure, samples)
    first, n = structure.longest_lag, len(samples)
    lagged = [samples.outputs[first - lag : n - lag] for lag in structure.output_lags]
    lagged += [samples.inputs[first - lag : n - lag] for lag in structure.input_lags]
    lagged.append(np.zeros((max(0, n - first), structure.n_residuals)))
    regressors = np.hstack(lagged) @ structure.arrangement().T
    targets = samples.outputs[first:].copy()
    if structure.incremental:
        targets -= samples.outputs[first - 1 : n - 1]
    complete = np.isfinite(regressors).all(axis=1) & np.isfinite(targets).all(axis=1)
    return regressors[complete], targets[complete], np.arange(first, n)[complete]


def _state_rows(
    structure: InnovationStructure, samples: Samples
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    order, n_y, n = structure.order, len(structure.outputs), len(samples)
    outputs = samples.outputs
    states = np.hstack([outputs[j : n - order + j] for j in range(order)])
    regressors = np.hstack([states, samples.inputs[: n - order], np.zeros((len(states), n_y))])
    following = np.hstack([outputs[j + 1 : n - order + j + 1] for j in range(order)])
    targets = following - states @ structure.shift().T
    complete = np.isfinite(states).all(axis=1) & np.isfinite(targets).all(axis=1)
    return regressors[complete], targets[complete], np.arange(order, n)[complete]


def scaling(structure: Structure, recordings: Sequence[Samples]) -> Scaling:
    """Scales from the recordings that a network is fitted to.

    Raises RecordingError if there are fewer rows than regressors, or a signal never moves.
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
    mean, sd = targets.mean(axis=0), _spread(targets)
    if isinstance(structure, InnovationStructure):
        # Measured samples move up without error; predicted ones by as much as the last ones do.
        n_y = len(structure.outputs)
        mean[:-n_y], sd = 0.0, np.tile(sd[-n_y:], structure.order)
    return Scaling(
        regressors.mean(axis=0), _spread(regressors), mean, sd, np.nanstd(levels, axis=0)
    )


def _spread(values: FloatArray) -> FloatArray:
    """Standard deviations, 1 where a column is constant (it is then zero when normalised)."""
    spread = values.std(axis=0)
    return np.asarray(np.where(spread > 0, spread, 1.0))


def predict_samples(structure: Structure, network: Network, samples: Samples) -> FloatArray:
    """Each sample from the measured ones before it, (n, n_y); NaN where one is missing.

    A network with residuals among its regressors runs through the whole recording, from residuals
    of zero on.
    """
    if corrects_itself(structure):
        outputs = filled(samples.outputs)[:, None]
        run = recursion_of(structure).run(network, outputs, samples.inputs[:, None])[:, 0]
        run[: structure.longest_lag] = np.nan
        return run
    regressors, _, place = rows(structure, samples)
    result = np.full_like(samples.outputs, np.nan)
    result[place] = network.evaluate(regressors)
    if structure.incremental:
        result[place] += samples.outputs[place - 1]
    return result


def free_run(
    structure: Structure, network: Network, past: FloatArray, inputs: FloatArray
) -> FloatArray:
    """Simulate windows side by side on the network's own outputs, (K, m, n_y).

    ``past``: (L, m, n_y) array; the ``structure.longest_lag`` samples before each of m windows.
    ``inputs``: (L + K, m, n_u) array; commands of the same samples and of the windows. The result
    is not finite after a divergence. Residuals among the regressors are zero.
    """
    if isinstance(structure, InnovationStructure):
        return simulate_states(structure, network, past, inputs)
    first = structure.longest_lag
    none = np.zeros((inputs.shape[1], structure.n_residuals))
    levels = np.empty((len(inputs), *past.shape[1:]))
    levels[:first] = past
    arrangement = structure.arrangement().T
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(first, len(inputs)):
            lagged = [levels[k - lag] for lag in structure.output_lags]
            lagged += [inputs[k - lag] for lag in structure.input_lags]
            levels[k] = network.evaluate(np.hstack([*lagged, none]) @ arrangement)
            if structure.incremental:
                levels[k] += levels[k - 1]
    return levels[first:]


def simulate_network(structure: Structure, network: Network, samples: Samples) -> FloatArray:
    """One free run over a whole recording, (n, n_y); the first samples are the measured ones."""
    past = samples.outputs[: structure.longest_lag]
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


#: Numbers in the Jacobian that is held at once: 32 MB.
_CHUNK = 4_000_000


class NormalEquations(NamedTuple):
    """Gauss–Newton terms of a sum of squares at θ."""

    loss: float  #: Mean of the squared residuals
    curvature: FloatArray  #: (P, P) array; jᵀJ
    slope: FloatArray  #: (P,) array; jᵀr


class TrainingObjective(Protocol):
    """What a training algorithm minimises: the mean of squared residuals r(θ).

    Residuals are normalised, so that a loss of 1 is that of a network that gives the mean.
    """

    @property
    def n_residuals(self) -> int: ...

    def loss(self, theta: FloatArray) -> float:
        """Mean of the squared residuals; infinite where the simulation diverges."""

    def gradient(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Loss and its gradient (P,)."""

    def normal_equations(self, theta: FloatArray) -> NormalEquations:
        """Loss, JᵀJ and Jᵀr."""


def accumulated(
    parts: Iterable[tuple[FloatArray, FloatArray]], size: int, n_residuals: int
) -> NormalEquations:
    """Normal equations from residuals (k, n_out) and slopes (k, n_out, P), part by part."""
    curvature, slope, squares = np.zeros((size, size)), np.zeros(size), 0.0
    for residuals, jacobian in parts:
        flat = jacobian.reshape(-1, size)
        curvature += flat.T @ flat
        slope += flat.T @ residuals.ravel()
        squares += float(np.vdot(residuals, residuals))
    loss = squares / n_residuals
    return NormalEquations(loss if np.isfinite(loss) else np.inf, curvature, slope)


class OneStepError:
    """Residuals ``N(z) − target`` over all samples and outputs.

    ``z``: (n, n_z) array; normalised regressors. ``targets``: (n, n_out) array; normalised.
    """

    def __init__(self, network: TrainableNetwork, z: FloatArray, targets: FloatArray) -> None:
        self.network = network
        self.z = np.ascontiguousarray(z)
        self.targets = np.ascontiguousarray(targets)

    @property
    def n_residuals(self) -> int:
        return int(self.targets.size)

    def residuals(self, theta: FloatArray) -> FloatArray:
        """All residuals, (n · n_out,)."""
        return (self.network.values(theta, self.z) - self.targets).ravel()

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Slopes of the residuals, (n · n_out, P)."""
        return self.network.slopes(theta, self.z)[1].reshape(self.n_residuals, -1)

    def loss(self, theta: FloatArray) -> float:
        residuals = self.residuals(theta)
        return float(residuals @ residuals) / self.n_residuals

    def gradient(self, theta: FloatArray) -> tuple[float, FloatArray]:
        residuals = self.network.values(theta, self.z) - self.targets
        loss = float(np.vdot(residuals, residuals)) / self.n_residuals
        slope = self.network.pulled_back(theta, self.z, (2.0 / self.n_residuals) * residuals)[0]
        return loss, slope

    def normal_equations(self, theta: FloatArray) -> NormalEquations:
        return accumulated(self._linearised(theta), theta.size, self.n_residuals)

    def _linearised(self, theta: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Residuals (k, n_out) and their slopes (k, n_out, P) of parts of the samples."""
        stride = max(1, _CHUNK // (theta.size * self.network.n_outputs))
        for first in range(0, len(self.z), stride):
            part = slice(first, first + stride)
            values, jacobian, _ = self.network.slopes(theta, self.z[part])
            yield values - self.targets[part], jacobian


class MultiStepError:
    """Residuals ``(ŷ − y) / level_sd`` of all windows, steps and outputs.

    ``recordings``: what is compared with; missing samples count nothing. ``steps``: length of a
    window. ``starts``: where the samples before a window come from: smoothed ones, for instance;
    None: the recordings. ``stride``: samples between the starts of two windows; None: ``steps``.
    ``every``: only each such step of a window counts: simulation errors of neighbouring samples
    tell nearly the same, and most of the time goes into their products. Raises RecordingError if no
    window has all its samples before the start.
    """

    def __init__(
        self,
        network: TrainableNetwork,
        structure: NarxStructure,
        scaling: Scaling,
        recordings: Sequence[Samples],
        steps: int,
        *,
        starts: Sequence[Samples] | None = None,
        stride: int | None = None,
        every: int = 1,
    ) -> None:
        self.network, self.structure, self.scaling = network, structure, scaling
        self.steps, self._first = steps, structure.longest_lag
        past, inputs, targets = [], [], []
        for samples, start in zip(recordings, starts or recordings, strict=True):
            last = len(samples) - steps
            for first in range(self._first, last + 1, stride or steps):
                before = start.outputs[first - self._first : first]
                after = samples.outputs[first : first + steps]
                if np.isfinite(before).all() and np.isfinite(after).any():
                    past.append(before)
                    inputs.append(samples.inputs[first - self._first : first + steps])
                    targets.append(after)
        if not past:
            raise RecordingError(
                f"no window of {self._first} + {steps} samples without a gap at its start",
                where=", ".join(samples.name for samples in recordings),
                remedy="record longer pieces or choose a shorter horizon",
            )
        # Time first, so that what a step needs lies together.
        self._past = np.array(past).swapaxes(0, 1).copy()
        self._inputs = np.array(inputs).swapaxes(0, 1).copy()
        targets_ = np.array(targets).swapaxes(0, 1).copy()
        self._present = np.isfinite(targets_)
        self._step_mask = np.arange(1, steps + 1) % every == 0
        self._step_mask[-1] = True
        self._present[~self._step_mask] = False
        self._targets = np.where(self._present, targets_, 0.0)
        self._map = structure.arrangement() / scaling.regressor_sd[:, None]
        self._shift = scaling.regressor_mean / scaling.regressor_sd
        self._n_lagged = len(structure.outputs) * len(structure.output_lags)

    @property
    def n_residuals(self) -> int:
        return int(np.count_nonzero(self._present))

    @property
    def samples(self) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Outputs before the windows (L, m, n_y) and commands (L + steps, m, n_u).

        Then what is compared with, (steps, m, n_y), and which of it counts, likewise.
        """
        return self._past, self._inputs, self._targets, self._present

    def simulated(self, theta: FloatArray) -> FloatArray:
        """Outputs of each window, (steps, m, n_y)."""
        return self._forward(theta)[self._first :]

    def loss(self, theta: FloatArray) -> float:
        return self._loss(self._residuals(self._forward(theta)))

    def gradient(self, theta: FloatArray) -> tuple[float, FloatArray]:
        levels = self._forward(theta)
        residuals = self._residuals(levels)
        loss, result = self._loss(residuals), np.zeros_like(theta)
        if not np.isfinite(loss):
            return loss, result
        structure, first = self.structure, self._first
        n_y = len(structure.outputs)
        adjoint = np.zeros_like(levels)
        adjoint[first:] = (2.0 / self.n_residuals) * residuals / self.scaling.level_sd
        for k in reversed(range(first, len(levels))):
            here = adjoint[k]
            slope, by_z = self.network.pulled_back(
                theta, self._regressor(levels, k), here * self.scaling.output_sd
            )
            result += slope
            by_lagged = by_z @ self._map[:, : self._n_lagged]
            for i, lag in enumerate(structure.output_lags):
                adjoint[k - lag] += by_lagged[:, i * n_y : (i + 1) * n_y]
            if structure.incremental:
                adjoint[k - 1] += here
        return loss, result

    def normal_equations(self, theta: FloatArray) -> NormalEquations:
        return accumulated(self._linearised(theta), theta.size, self.n_residuals)

    def _linearised(self, theta: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Residuals (m, n_y) and their slopes (m, n_y, P) of each step that counts."""
        structure, scaling = self.structure, self.scaling
        m, n_y = self._past.shape[1], len(structure.outputs)
        levels = np.empty((self._first + self.steps, m, n_y))
        levels[: self._first] = self._past
        longest = structure.output_lags[-1]
        # Slopes of the last outputs, in a ring; those before the window do not depend on θ.
        ring = np.zeros((longest, m, n_y, theta.size))
        gathered = np.empty((m, self._n_lagged, theta.size))
        for k in range(self._first, len(levels)):
            z = self._regressor(levels, k)
            values, by_theta, by_z = self.network.slopes(theta, z)
            levels[k] = self._advanced(levels, k, values)
            for i, lag in enumerate(structure.output_lags):
                gathered[:, i * n_y : (i + 1) * n_y] = ring[(k - lag) % longest]
            by_lagged = by_z @ self._map[:, : self._n_lagged]
            now = np.matmul(by_lagged, gathered)
            now += by_theta
            now *= scaling.output_sd[:, None]
            if structure.incremental:
                now += ring[(k - 1) % longest]
            ring[k % longest] = now
            step = k - self._first
            if not self._step_mask[step]:
                continue
            present = self._present[step]
            residuals = (levels[k] - self._targets[step]) / scaling.level_sd * present
            yield residuals, now * (present / scaling.level_sd)[:, :, None]

    def _forward(self, theta: FloatArray) -> FloatArray:
        """Levels before and in the windows, (first + steps, m, n_y)."""
        levels = np.empty((self._first + self.steps, *self._past.shape[1:]))
        levels[: self._first] = self._past
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self._first, len(levels)):
                values = self.network.values(theta, self._regressor(levels, k))
                levels[k] = self._advanced(levels, k, values)
        return levels

    def _regressor(self, levels: FloatArray, k: int) -> FloatArray:
        lagged = [levels[k - lag] for lag in self.structure.output_lags]
        lagged += [self._inputs[k - lag] for lag in self.structure.input_lags]
        return np.hstack(lagged) @ self._map.T - self._shift

    def _advanced(self, levels: FloatArray, k: int, values: FloatArray) -> FloatArray:
        after = self.scaling.output_mean + self.scaling.output_sd * values
        return levels[k - 1] + after if self.structure.incremental else after

    def _residuals(self, levels: FloatArray) -> FloatArray:
        errors = (levels[self._first :] - self._targets) / self.scaling.level_sd
        return np.where(self._present, errors, 0.0)

    def _loss(self, residuals: FloatArray) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            loss = float(np.vdot(residuals, residuals)) / self.n_residuals
        return loss if np.isfinite(loss) else np.inf
