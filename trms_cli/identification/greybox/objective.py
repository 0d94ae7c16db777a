"""The cost of a grey-box fit in parameters and starts, and its parabola at a point."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.elimination import Joint, Quadratic, triangles
from trms_cli.identification.greybox.weights import Weights
from trms_cli.identification.greybox.windows import Residuals, Windows

FloatArray = npt.NDArray[np.float64]


@dataclass
class Objective:
    """Maximum a posteriori: half the sum of squares of residuals and of deviations from priors."""

    windows: Windows
    weights: Weights
    centres: FloatArray  #: (m, n_x) array; of the starts' priors
    #: Standard deviation of the gaps between windows, as a share of the starts' spread; None:
    #: windows know nothing of each other
    joined: float | None = None
    #: Simulations of all windows so far; with slopes they count once as well
    evaluations: int = field(default=0)

    def __post_init__(self) -> None:
        problem = self.windows.problem
        self.scales = problem.scales
        self.means, self.precisions = problem.prior_means, problem.prior_precisions

    # A search tries parameters with which a simulation runs away: that is a cost, not a warning.

    @np.errstate(all="ignore")
    def cost(self, theta: FloatArray, starts: FloatArray) -> float:
        """Its value; infinite where the simulation is not finite."""
        residuals = self._simulated(theta, starts, slopes=False)
        return self._cost(theta, starts, residuals)

    def better_starts(
        self, theta: FloatArray, one: FloatArray, other: FloatArray
    ) -> tuple[float, FloatArray]:
        """The cost with the better of two starts in every window, and those starts.

        Given the parameters, windows have nothing to do with each other. Dry friction puts a kink
        into the cost wherever a beam just moves or just rests; a step that is good for most
        windows need not fail because one start fell on the wrong side. Joined windows are taken
        together: one or the other for all.
        """
        if self.joined is not None:
            costs = [self.cost(theta, starts) for starts in (one, other)]
            best = int(np.argmin(costs))
            return costs[best], (one, other)[best]
        parts = np.array([self._of_windows(theta, starts) for starts in (one, other)])
        chosen = np.argmin(parts, axis=0)
        total = float(parts.min(axis=0).sum()) + self._of_parameters(theta)
        return total, np.where((chosen == 0)[:, None], one, other)

    @np.errstate(all="ignore")
    def _of_windows(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Each window's part of the cost with its start's prior, shape (m,)."""
        r = self._simulated(theta, starts, slopes=False).r
        parts = self.weights.costs(r)
        parts += 0.5 * np.sum(((starts - self.centres) / self.windows.spread) ** 2, axis=1)
        return np.where(np.isfinite(parts), parts, np.inf)

    def of_priors(self, theta: FloatArray, starts: FloatArray) -> float:
        """What the priors of parameters and starts add to the cost, nats."""
        gaps = (starts - self.centres) / self.windows.spread
        return self._of_parameters(theta) + 0.5 * float(np.sum(gaps**2))

    def _of_parameters(self, theta: FloatArray) -> float:
        return 0.5 * float(np.sum(self.precisions * (theta - self.means) ** 2))

    @np.errstate(all="ignore")
    def parabola(self, theta: FloatArray, starts: FloatArray) -> tuple[float, Quadratic, Residuals]:
        """Its value, and the parabola in scaled changes.

        Starts are scaled by their spread, parameters by their scales.
        """
        residuals = self._simulated(theta, starts, slopes=True)
        cost = self._cost(theta, starts, residuals)
        assert residuals.j is not None
        roots = self.weights.roots(residuals.r) * self.windows.measured
        a_b = self.scaled(residuals.j) * roots[..., None]
        m, n_all = len(self.windows), a_b.shape[-1]
        quadratic = Quadratic(
            triangles(a_b.reshape(m, -1, n_all), (residuals.r * roots).reshape(m, -1)),
            (starts - self.centres) / self.windows.spread,
            np.sqrt(self.precisions) * self.scales,
            np.sqrt(self.precisions) * (theta - self.means),
            self._joint(starts, residuals),
        )
        return cost, quadratic, residuals

    def scaled(self, j: FloatArray) -> FloatArray:
        """Slopes per scaled unit of starts and parameters."""
        slopes: FloatArray = j * np.concatenate([self.windows.spread, self.scales])
        return slopes

    def _simulated(self, theta: FloatArray, starts: FloatArray, slopes: bool) -> Residuals:
        self.evaluations += 1
        p = self.windows.problem.all_values(theta)
        return self.windows.residuals(p, starts, slopes=slopes)

    def _cost(self, theta: FloatArray, starts: FloatArray, residuals: Residuals) -> float:
        if not residuals.finite:
            return np.inf
        cost = self.weights.cost(residuals.r)
        cost += self.of_priors(theta, starts)
        if self.joined is not None:
            gaps = self._gaps(starts, residuals)[self.windows.follows]
            cost += 0.5 * float(np.sum(gaps**2))
        return cost if np.isfinite(cost) else np.inf

    def _gaps(self, starts: FloatArray, residuals: Residuals) -> FloatArray:
        assert self.joined is not None
        gaps = np.zeros_like(starts)
        gaps[1:] = (residuals.ends[:-1] - starts[1:]) / (self.joined * self.windows.spread)
        return gaps

    def _joint(self, starts: FloatArray, residuals: Residuals) -> Joint | None:
        if self.joined is None:
            return None
        assert residuals.dends is not None
        weight = np.full(len(self.windows.spread), 1.0 / self.joined)
        from_before = np.zeros_like(residuals.dends)
        slopes = self.scaled(residuals.dends[:-1])
        from_before[1:] = slopes / (self.joined * self.windows.spread)[None, :, None]
        return Joint(self.windows.follows, from_before, weight, self._gaps(starts, residuals))
