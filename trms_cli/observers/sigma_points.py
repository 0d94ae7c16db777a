"""The scaled unscented transform: van der Merwe's sigma points and weights.

R. van der Merwe, "Sigma-point Kalman filters for probabilistic inference in dynamic state-space
models", 2004, as in filterpy's ``MerweScaledSigmaPoints`` (importing filterpy takes longer than a
whole short run, so the formulas stand here and a test holds them equal).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SigmaPoints:
    """Sigma points of an n-vector: the mean and, for each direction, one on either side."""

    n: int
    #: ``alpha``, ``beta``, ``kappa``: Spread, prior knowledge of the distribution (2 for a normal
    #: one), and a second spread: ``λ = α²(n + κ) − n``
    alpha: float
    beta: float
    kappa: float

    def __post_init__(self) -> None:
        if not self.spread > 0:
            raise ConfigurationError(
                f"alpha={self.alpha!r} and kappa={self.kappa!r} spread no sigma points over "
                f"{self.n} states",
                where="observer.kappa",
                remedy=f"kappa is above {-self.n}, alpha above 0",
            )

    @property
    def count(self) -> int:
        return 2 * self.n + 1

    @property
    def spread(self) -> float:
        """``n + λ``: squared distance of the points in standard deviations."""
        return self.alpha**2 * (self.n + self.kappa)

    @property
    def mean_weights(self) -> FloatArray:
        weights = np.full(self.count, 0.5 / self.spread)
        weights[0] = 1.0 - self.n / self.spread
        return weights

    @property
    def covariance_weights(self) -> FloatArray:
        weights = self.mean_weights
        weights[0] += 1.0 - self.alpha**2 + self.beta
        return weights

    def around(self, mean: ca.SX, covariance: ca.SX) -> ca.SX:
        """The points as columns, shape (n, 2n + 1)."""
        root = ca.chol(covariance).T * np.sqrt(self.spread)
        centre = ca.repmat(mean, 1, self.n)
        return ca.horzcat(mean, centre + root, centre - root)
