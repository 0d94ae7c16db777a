"""The one-step-ahead prediction error of a network (NNARX)."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from trms_cli.identification.blackbox.trainable import FloatArray, TrainableNetwork

#: Numbers in the Jacobian that is held at once: 32 MB.
_CHUNK = 4_000_000


class NormalEquations(NamedTuple):
    """Gauss–Newton terms of a sum of squares at θ."""

    loss: float  #: Mean of the squared residuals
    curvature: FloatArray  #: (P, P) array; jᵀJ
    slope: FloatArray  #: (P,) array; jᵀr


class Objective(Protocol):
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


class OneStepError:
    """Residuals ``N(z) − target`` over all samples and outputs.

    Parameters
    ----------
    network : TrainableNetwork
    z : (n, n_z) array
        Normalised regressors.
    targets : (n, n_out) array
        Normalised targets.
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
        size = self.network.n_parameters
        curvature, slope, squares = np.zeros((size, size)), np.zeros(size), 0.0
        stride = max(1, _CHUNK // (size * self.network.n_outputs))
        for first in range(0, len(self.z), stride):
            part = slice(first, first + stride)
            values, jacobian, _ = self.network.slopes(theta, self.z[part])
            flat = jacobian.reshape(-1, size)
            residuals = (values - self.targets[part]).ravel()
            curvature += flat.T @ flat
            slope += flat.T @ residuals
            squares += float(residuals @ residuals)
        return NormalEquations(squares / self.n_residuals, curvature, slope)
