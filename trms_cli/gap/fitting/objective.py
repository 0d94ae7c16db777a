"""The cost of a fit in a metric of innovations, in parameters and windows' starts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from trms_cli.gap.fitting.metric import Metric
from trms_cli.identification.greybox.elimination import Quadratic, triangles
from trms_cli.identification.greybox.windows import Residuals, Windows

FloatArray = npt.NDArray[np.float64]

#: Slopes per scaled unit beyond this say nothing; in the outputs' units.
_STEEPEST = 1e8


@dataclass
class InnovationObjective:
    """Maximum a posteriori in a metric; the same face as a grey-box fit's objective."""

    #: Of the model that is fitted: the same windows as the metric's, whose model may differ
    windows: Windows
    metric: Metric
    centres: FloatArray  #: (m, n_x) array; of the starts' priors
    evaluations: int = field(default=0)  #: Simulations of all windows so far

    def __post_init__(self) -> None:
        problem = self.windows.problem
        self.scales = problem.scales
        self.means, self.precisions = problem.prior_means, problem.prior_precisions

    # A search tries parameters with which a simulation runs away: that is a cost, not a warning.

    @np.errstate(all="ignore")
    def by_window(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Each window's part of the cost with its start's prior, shape (m,)."""
        r = self._simulated(theta, starts, slopes=False).r
        if not np.isfinite(r).all():
            fine = np.asarray(np.isfinite(r).all(axis=(1, 2)))
            parts = self._losses(np.where(fine[:, None, None], r, 0.0), starts)
            return np.where(fine, parts, np.inf)
        return self._losses(r, starts)

    def cost(self, theta: FloatArray, starts: FloatArray) -> float:
        """Its value; infinite where the simulation is not finite."""
        return float(self.by_window(theta, starts).sum()) + self.of_parameters(theta)

    def better_starts(
        self, theta: FloatArray, one: FloatArray, other: FloatArray
    ) -> tuple[float, FloatArray]:
        """The cost with the better of two starts in every window, and those starts."""
        parts = np.array([self.by_window(theta, starts) for starts in (one, other)])
        chosen = np.argmin(parts, axis=0)
        total = float(parts.min(axis=0).sum()) + self.of_parameters(theta)
        return total, np.where((chosen == 0)[:, None], one, other)

    def of_parameters(self, theta: FloatArray) -> float:
        """What the priors of the parameters add, nats."""
        return 0.5 * float(np.sum(self.precisions * (theta - self.means) ** 2))

    @np.errstate(all="ignore")
    def parabola(self, theta: FloatArray, starts: FloatArray) -> tuple[float, Quadratic, Residuals]:
        """Its value, and the parabola in scaled changes."""
        residuals = self._simulated(theta, starts, slopes=True)
        quadratic, cost = self._quadratic(residuals, theta, starts)
        return cost, quadratic, residuals

    def innovations(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Predicted less measured, whitened, (m, c, n_y)."""
        r = self._simulated(theta, starts, slopes=False).r
        return self.metric.whitened(r[..., None])[..., 0]

    def columns(self, residuals: Residuals) -> FloatArray:
        """Whitened slopes in scaled starts and parameters, then the residual, (m, c, n_y, k)."""
        assert residuals.j is not None
        scaled = residuals.j * np.concatenate([self.windows.spread, self.scales])
        # where a simulation bounces its slopes may run away though itself it does not
        scaled = np.where(np.abs(scaled) < _STEEPEST, scaled, 0.0)
        return self.metric.whitened(np.concatenate([scaled, residuals.r[..., None]], axis=-1))

    def _quadratic(
        self, residuals: Residuals, theta: FloatArray, starts: FloatArray
    ) -> tuple[Quadratic, float]:
        m = len(self.windows)
        n_f = len(theta)
        gaps = (starts - self.centres) / self.windows.spread
        if not residuals.finite:
            empty = np.zeros((m, 1, self.windows.n_x + n_f + 1))
            cost = np.inf
            made = empty
        else:
            columns = self.columns(residuals)
            z = columns[..., -1]
            cost = float(self.metric.losses(z).sum() + 0.5 * np.sum(gaps**2))
            cost += self.of_parameters(theta)
            columns = columns * self.metric.roots(z)[..., None]
            flat = columns.reshape(m, -1, columns.shape[-1])
            made = triangles(flat[..., :-1], flat[..., -1])
        quadratic = Quadratic(
            made,
            gaps,
            np.sqrt(self.precisions) * self.scales,
            np.sqrt(self.precisions) * (theta - self.means),
            None,
        )
        return quadratic, cost if np.isfinite(cost) else np.inf

    def _losses(self, r: FloatArray, starts: FloatArray) -> FloatArray:
        z = self.metric.whitened(r[..., None])[..., 0]
        gaps = (starts - self.centres) / self.windows.spread
        parts: FloatArray = self.metric.losses(z) + 0.5 * np.sum(gaps**2, axis=1)
        return parts

    def _simulated(self, theta: FloatArray, starts: FloatArray, slopes: bool) -> Residuals:
        self.evaluations += 1
        p = self.windows.problem.all_values(theta)
        return self.windows.residuals(p, starts, slopes=slopes)
