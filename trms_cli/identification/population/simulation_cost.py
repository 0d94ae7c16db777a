"""The cost of parameters alone: windows simulated, their starts put right, noise levels found.

A search without slopes in the parameters sees one number a point: the negative logarithm of
likelihood and prior in nats, up to a constant, with everything else eliminated:

- the starts of the windows, by one Gauss–Newton step from their estimates with the exact slopes,
  then a second simulation from there;
- the noise of each output, which is as large as the residuals but no smaller than declared,

        n (log s + ½ z̄²/s²),   s = max(1, z̄),   z̄² the mean square of residuals over declared noise

  which is ½ Σ z² where the model follows to within the noise. Residuals beyond the robust
  threshold count as if they lay on it.

Residuals are counted as if they were white.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.windows import Residuals, Windows
from trms_cli.identification.problem import FitProblem

FloatArray = npt.NDArray[np.float64]


class SimulationCost:
    """The cost as a function of the free parameters; several threads may call it at once.

    Parameters
    ----------
    problem : FitProblem
    """

    def __init__(self, problem: FitProblem) -> None:
        self._problem = problem
        self.windows = Windows(problem, with_parameters=False)
        # Threads share the points among themselves, each simulates all windows of one.
        self.windows.rollout.jobs = 1
        self.starts = self.windows.starts(problem.all_values(problem.starts))
        self._count = self.windows.measured.sum(axis=(0, 1)) * self.windows.share

    @property
    def samples(self) -> int:
        """Simulated in one evaluation: every window twice, once with slopes in its start."""
        return 2 * int(self.windows.count.sum())

    def __call__(self, theta: FloatArray) -> float:
        """Cost in nats at parameters (n_f,); infinite where the simulation is not finite."""
        p = self._problem.all_values(theta)
        with np.errstate(all="ignore"):
            found = self.windows.residuals(p, self.starts, slopes=True)
            if not found.finite:
                return np.inf
            step = self._start_step(found)
            found = self.windows.residuals(p, self.starts + step * self.windows.spread)
            if not found.finite:
                return np.inf
            cost = self._of_residuals(found.r) + 0.5 * float(np.sum(step**2))
            gap = theta - self._problem.prior_means
            cost += 0.5 * float(np.sum(self._problem.prior_precisions * gap**2))
        return cost if np.isfinite(cost) else np.inf

    def _of_residuals(self, r: FloatArray) -> float:
        square = self._mean_square(r)
        s2 = np.maximum(1.0, square)
        if self._problem.discrepancy == "none":
            s2 = np.ones_like(square)
        return float(np.sum(self._count * (0.5 * np.log(s2) + 0.5 * square / s2)))

    def _mean_square(self, r: FloatArray) -> FloatArray:
        """Mean square of each output's residuals over their declared deviation, (n_y,)."""
        z2 = (r / self.windows.declared[:, None]) ** 2
        count = np.maximum(self.windows.measured.sum(axis=(0, 1)), 1)
        square: FloatArray = z2.sum(axis=(0, 1)) / count
        if self._problem.robust is not None:
            far: FloatArray = self._problem.robust**2 * np.maximum(square, 1.0)
            square[:] = np.minimum(z2, far).sum(axis=(0, 1)) / count
        return square

    def _start_step(self, found: Residuals) -> FloatArray:
        """Change of the starts in units of their spread, (m, n_x)."""
        assert found.j is not None
        s = np.sqrt(np.maximum(1.0, self._mean_square(found.r)))
        root = self.windows.measured / (self.windows.declared * s)[:, None]
        m, n = len(self.windows), self.windows.n_x
        slopes = (found.j[..., :n] * self.windows.spread * root[..., None]).reshape(m, -1, n)
        a = np.ascontiguousarray(slopes.transpose(0, 2, 1))
        b = (found.r * root).reshape(m, -1)
        # Not by BLAS, which would start threads of its own beside those of the search.
        normal = np.einsum("mik,mjk->mij", a, a) + np.eye(n)
        right = np.einsum("mik,mk->mi", a, b)[..., None]
        return np.asarray(-np.linalg.solve(normal, right)[..., 0], dtype=np.float64)
