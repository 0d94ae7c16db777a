"""The prediction error of networks that correct themselves by their residuals, exact in its slopes.

The predictor of :mod:`trms_cli.identification.blackbox.recursion` runs through windows of a
recording. Each begins with zero residuals, so its first samples, where the corrections build up,
do not count; the next window begins as much earlier. Jacobians go forward along the recursion,
gradients back through it, as those of simulations do.

Source: M. Nørgaard, O. Ravn, N. K. Poulsen & L. K. Hansen (2000), "Neural Networks for Modelling
and Control of Dynamic Systems", section 3.2.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import RecordingError
from trms_cli.identification.blackbox.prediction_error import (
    NormalEquations,
    Samples,
    Scaling,
    accumulated,
)
from trms_cli.identification.blackbox.recursion import filled, recursion_of
from trms_cli.identification.blackbox.trainable import TrainableNetwork
from trms_cli.models.innovation_network import InnovationStructure
from trms_cli.models.network import NarxStructure


class InnovationError:
    """Residuals ``(ŷ − y) / output_sd`` of all windows, steps and outputs that count.

    ``steps``: length of a window, of which ``skip`` do not count. Missing samples count nothing;
    the predictor takes them from their neighbours. Raises RecordingError if no recording is as
    long.
    """

    def __init__(
        self,
        network: TrainableNetwork,
        structure: NarxStructure | InnovationStructure,
        scaling: Scaling,
        recordings: Sequence[Samples],
        steps: int,
        skip: int,
    ) -> None:
        self.network, self.scaling = network, scaling
        self._recursion = recursion_of(structure)
        skip = max(skip, structure.longest_lag)
        outputs, inputs, present = [], [], []
        for samples in recordings:
            whole, there = filled(samples.outputs), np.isfinite(samples.outputs)
            for first in range(0, len(samples) - steps + 1, max(1, steps - skip)):
                window = slice(first, first + steps)
                if there[window][skip:].any():
                    outputs.append(whole[window])
                    inputs.append(samples.inputs[window])
                    present.append(there[window])
        if not outputs or steps <= skip:
            raise RecordingError(
                f"no window of {steps} samples, of which the first {skip} do not count",
                where=", ".join(samples.name for samples in recordings),
                remedy="record longer pieces or choose another method.window",
            )
        # Time first, so that what a step needs lies together.
        self._outputs = np.array(outputs).swapaxes(0, 1).copy()
        self._drive = self._recursion.drive(self._outputs, np.array(inputs).swapaxes(0, 1))
        self._present = np.array(present).swapaxes(0, 1).copy()
        self._present[:skip] = False
        self._skip = skip
        self._residual_sd = scaling.output_sd[-len(structure.outputs) :]
        self._by_lag = [m / scaling.regressor_sd[:, None] for m in self._recursion.by_lag]
        self._known = (self._drive.known - scaling.regressor_mean) / scaling.regressor_sd

    @property
    def n_residuals(self) -> int:
        return int(np.count_nonzero(self._present))

    def predicted(self, theta: FloatArray) -> FloatArray:
        """Predicted outputs of each window, (T, m, n_y)."""
        return np.asarray(self._forward(theta) @ self._recursion.output.T)

    def loss(self, theta: FloatArray) -> float:
        return self._loss(self._residuals(self._forward(theta)))

    def gradient(self, theta: FloatArray) -> tuple[float, FloatArray]:
        p = self._forward(theta)
        residuals = self._residuals(p)
        loss, result = self._loss(residuals), np.zeros_like(theta)
        if not np.isfinite(loss):
            return loss, result
        recursion, first = self._recursion, self._recursion.first
        adjoint = ((2.0 / self.n_residuals) * residuals / self._residual_sd) @ recursion.output
        for k in reversed(range(first, len(p))):
            here = adjoint[k]
            slope, by_z = self.network.pulled_back(
                theta, self._regressor(p, k), here * self.scaling.output_sd
            )
            result += slope
            for lag, matrix in zip(recursion.lags, self._by_lag, strict=True):
                adjoint[k - lag] += by_z @ matrix
            adjoint[k - 1] += here @ recursion.shift
        return loss, result

    def normal_equations(self, theta: FloatArray) -> NormalEquations:
        return accumulated(self._linearised(theta), theta.size, self.n_residuals)

    def _linearised(self, theta: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Residuals (m, n_y) and their slopes (m, n_y, P) of each step that counts."""
        recursion, first = self._recursion, self._recursion.first
        p = np.empty_like(self._drive.base)
        p[:first] = self._drive.start
        m, n_p = p.shape[1:]
        longest = max(recursion.lags)
        # Slopes of the last predictions, in a ring; those before the window do not depend on θ.
        ring = np.zeros((longest, m, n_p, theta.size))
        moves = bool(recursion.shift.any())
        for k in range(first, len(p)):
            values, by_theta, by_z = self.network.slopes(theta, self._regressor(p, k))
            p[k] = self._advanced(p, k, values)
            now = by_theta
            for lag, matrix in zip(recursion.lags, self._by_lag, strict=True):
                now = now + np.matmul(by_z @ matrix, ring[(k - lag) % longest])
            now = now * self.scaling.output_sd[:, None]
            if moves:
                now += np.matmul(recursion.shift, ring[(k - 1) % longest])
            ring[k % longest] = now
            if k < self._skip:
                continue
            weight = self._present[k] / self._residual_sd
            error = p[k] @ recursion.output.T - self._outputs[k]
            yield error * weight, np.matmul(recursion.output, now) * weight[:, :, None]

    def _forward(self, theta: FloatArray) -> FloatArray:
        """Predictions before and from the first step on, (T, m, n_p)."""
        p = np.empty_like(self._drive.base)
        p[: self._recursion.first] = self._drive.start
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self._recursion.first, len(p)):
                p[k] = self._advanced(p, k, self.network.values(theta, self._regressor(p, k)))
        return p

    def _regressor(self, p: FloatArray, k: int) -> FloatArray:
        z = self._known[k]
        for lag, matrix in zip(self._recursion.lags, self._by_lag, strict=True):
            z = z + p[k - lag] @ matrix.T
        return z

    def _advanced(self, p: FloatArray, k: int, values: FloatArray) -> FloatArray:
        step = self.scaling.output_mean + self.scaling.output_sd * values
        return np.asarray(self._drive.base[k] + p[k - 1] @ self._recursion.shift.T + step)

    def _residuals(self, p: FloatArray) -> FloatArray:
        errors = (p @ self._recursion.output.T - self._outputs) / self._residual_sd
        return np.where(self._present, errors, 0.0)

    def _loss(self, residuals: FloatArray) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            loss = float(np.vdot(residuals, residuals)) / self.n_residuals
        return loss if np.isfinite(loss) else np.inf
