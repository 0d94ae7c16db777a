"""The error of a network one step ahead (NNARX), and in simulations of many steps (NNOE).

In a window the network runs on its own outputs; measured are only the samples before its start.
Gradients go back through the simulated steps, Jacobians forward along them; both are exact. All
windows are simulated side by side, so that each step is one matrix product for all of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import RecordingError
from trms_cli.identification.blackbox.regressors import Samples, Scaling
from trms_cli.identification.blackbox.trainable import TrainableNetwork
from trms_cli.models.network import NarxStructure

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
        ...

    def gradient(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Loss and its gradient (P,)."""
        ...

    def normal_equations(self, theta: FloatArray) -> NormalEquations:
        """Loss, JᵀJ and Jᵀr."""
        ...


def _accumulated(
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
        return _accumulated(self._linearised(theta), theta.size, self.n_residuals)

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
        for samples, begun in zip(recordings, starts or recordings, strict=True):
            last = len(samples) - steps
            for first in range(self._first, last + 1, stride or steps):
                before = begun.outputs[first - self._first : first]
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
        self._counted = np.arange(1, steps + 1) % every == 0
        self._counted[-1] = True
        self._present[~self._counted] = False
        self._targets = np.where(self._present, targets_, 0.0)
        self._map = structure.arrangement() / scaling.regressor_sd[:, None]
        self._shift = scaling.regressor_mean / scaling.regressor_sd
        self._n_lagged = len(structure.outputs) * len(structure.output_lags)

    @property
    def n_residuals(self) -> int:
        return int(np.count_nonzero(self._present))

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
        return _accumulated(self._linearised(theta), theta.size, self.n_residuals)

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
            if not self._counted[step]:
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
