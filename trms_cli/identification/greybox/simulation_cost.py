"""The cost of a parameter vector by one simulation: what searches without gradients minimise.

Each window starts where the data say, corrected by one Gauss–Newton step on the starts alone, whose
slopes the same simulation gives. (Starts that are read off the samples and left alone blur the
cost: their error grows over a window to many times the noise. See ``docs/grey-box.md``.)
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.weights import Weights, sizes
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import FitProblem

FloatArray = npt.NDArray[np.float64]

#: Steps on the starts when residuals are weighed.
_START_STEPS = 3


class SimulationCost:
    """Half the sum of squared whitened residuals, robust, with the priors' part.

    Parameters
    ----------
    problem : FitProblem
    theta : (n_f,) array or None
        Where the residuals are weighed: their deviations are the declared noise or what they
        are at this point, whichever is larger. None: the problem's starts. ``discrepancy: none``
        takes the declared noise whatever the point.

    Attributes
    ----------
    windows : Windows
    weights : Weights
    evaluations : int
        Parameter vectors simulated so far.
    """

    def __init__(self, problem: FitProblem, theta: FloatArray | None = None) -> None:
        self.problem = problem
        self.windows = Windows(problem, with_parameters=False)
        # Parameter vectors are divided among the threads, so that a window's need not be.
        self.windows.rollout.jobs = 1
        self.evaluations = 0
        self._centres = self.windows.starts(problem.all_values(problem.starts))
        self.starts = self._centres
        n_y = self.windows.declared.shape[1]
        self.weights = Weights(
            self.windows.declared, np.ones(n_y), self.windows.share, problem.robust
        )
        self.weigh(problem.starts if theta is None else theta)

    def weigh(self, theta: FloatArray) -> None:
        """Weigh the residuals anew at a point, usually the best so far, and start from there.

        Costs before and after cannot be compared.
        """
        for _ in range(_START_STEPS):
            corrected = self._corrected(theta)
            if corrected is None:
                return
            r, gap = corrected
            self.starts = self._centres + gap * self.windows.spread
            if self.problem.discrepancy == "estimate":
                size = sizes(r, self.windows.measured, self.windows.declared)
                self.weights = replace(
                    self.weights, sd=self.windows.declared * np.maximum(1.0, size)
                )

    def __call__(self, theta: FloatArray) -> float:
        """The cost of one vector (n_f,); infinite outside the bounds or where it diverges."""
        low, high = self.problem.bounds
        if (theta < low).any() or (theta > high).any():
            return np.inf
        self.evaluations += 1
        corrected = self._corrected(theta)
        if corrected is None:
            return np.inf
        r, gap = corrected
        deviation = theta - self.problem.prior_means
        cost = self.weights.cost(r) + 0.5 * float(np.sum(gap**2))
        cost += 0.5 * float(np.sum(self.problem.prior_precisions * deviation**2))
        return cost if np.isfinite(cost) else np.inf

    def batch(self, thetas: Sequence[FloatArray] | FloatArray) -> FloatArray:
        """Costs of several vectors, on the problem's number of threads, shape (k,)."""
        if self.problem.jobs == 1 or len(thetas) < 2:
            return np.array([self(theta) for theta in thetas])
        with ThreadPoolExecutor(self.problem.jobs) as pool:
            return np.array(list(pool.map(self, thetas)))

    def _corrected(self, theta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Residuals (m, c, n_y) after the step on the starts, and how far these then lie from
        where the data had them, in spreads (m, n_x)."""
        residuals = self.windows.residuals(self.problem.all_values(theta), self.starts, slopes=True)
        assert residuals.j is not None
        if not (residuals.finite and np.isfinite(residuals.j).all()):
            return None
        m, n = self.starts.shape
        a = (residuals.j * self.windows.spread).reshape(m, -1, n)
        roots = (self.weights.roots(residuals.r) * self.windows.measured).reshape(m, -1)
        r = residuals.r.reshape(m, -1)
        weighted = a * roots[..., None]
        gap = (self.starts - self._centres) / self.windows.spread
        normal = weighted.swapaxes(1, 2) @ weighted + np.eye(n)
        slope = weighted.swapaxes(1, 2) @ (r * roots)[..., None] + gap[..., None]
        move = -np.linalg.solve(normal, slope)
        corrected = r + (a @ move)[..., 0]
        corrected = np.where(self.windows.measured, corrected.reshape(residuals.r.shape), 0.0)
        return corrected, gap + move[..., 0]
