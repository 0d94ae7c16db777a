"""Levenberg–Marquardt on parameters with bounds, the windows' starts eliminated at every step.

Damping follows Nielsen (IMM-REP-1999-05): it falls smoothly with a good step and grows ever faster
with bad ones, which carries the search over the kinks of dry friction. Bounds are part of each
step's least-squares problem, so that a parameter may slide along its bound and leave it again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.elimination import Quadratic, reduced
from trms_cli.identification.greybox.objective import Objective
from trms_cli.identification.method import Outcome

FloatArray = npt.NDArray[np.float64]

#: First damping, in the scaled units: as strong as the priors.
_FIRST_DAMPING = 1.0
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e12
#: Steps whose reductions stay below the tolerance before the search ends.
_SMALL_STEPS = 2


class Point(NamedTuple):
    """A point of the search."""

    theta: FloatArray  #: (n_f,) array
    starts: FloatArray  #: (m, n_x) array
    cost: float


class Search(NamedTuple):
    """Where a search ended, and why."""

    point: Point
    outcome: Outcome
    iterations: int


def minimise(
    objective: Objective,
    point: Point,
    *,
    bounds: tuple[FloatArray, FloatArray],
    iterations: int,
    tolerance: float,
    watch: Callable[[int, Point], bool] = lambda k, point: True,
) -> Search:
    """Lower the cost until no step promises more than the tolerance.

    Parameters
    ----------
    objective : Objective
    point : Point
        Where to begin; its cost is not read.
    bounds : (lower, upper)
        Each (n_f,); equal where a parameter is held.
    iterations : int
        At most so many steps, bad ones included.
    tolerance : float
        In the cost's unit. A change of 0.5 is one standard deviation of one parameter, so that
        a thousandth lies far below what any data can tell.
    watch : callable
        Told the iteration and the best point; False ends the search.
    """
    theta = np.clip(point.theta, *bounds)
    cost, quadratic, _ = objective.parabola(theta, point.starts)
    best = Point(theta, point.starts, cost)
    if not np.isfinite(cost):
        return Search(best, Outcome.FAILED, 0)
    damping, growth, small = _FIRST_DAMPING, 2.0, 0
    for k in range(iterations):
        if not watch(k, best):
            return Search(best, Outcome.INTERRUPTED, k)
        dx, dtheta = step(quadratic, damping, best.theta, bounds, objective.scales)
        promised = quadratic.cost(np.zeros_like(dx), np.zeros_like(dtheta)) - quadratic.cost(
            dx, dtheta
        )
        if promised < tolerance and damping <= _FIRST_DAMPING:
            return Search(best, Outcome.CONVERGED, k)
        theta = np.clip(best.theta + dtheta * objective.scales, *bounds)
        moved = best.starts + dx * objective.windows.spread
        cost, starts = objective.better_starts(theta, moved, best.starts)
        gained = best.cost - cost
        if gained > 0:
            small = small + 1 if gained < tolerance else 0
            cost, quadratic, _ = objective.parabola(theta, starts)
            best = Point(theta, starts, cost)
            if small >= _SMALL_STEPS:
                return Search(best, Outcome.CONVERGED, k + 1)
            quality = min(gained / promised, 1.0) if promised > 0 else 0.0
            damping = max(damping * max(1 / 5, 1 - (2 * quality - 1) ** 3), _LEAST_DAMPING)
            growth = 2.0
        else:
            damping, growth = damping * growth, growth * 2
            if damping > _MOST_DAMPING or promised < 0.01 * tolerance:
                outcome = Outcome.CONVERGED if promised < tolerance else Outcome.STUCK
                return Search(best, outcome, k + 1)
    return Search(best, Outcome.BUDGET_SPENT, iterations)


def step(
    quadratic: Quadratic,
    damping: float,
    theta: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    scales: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The damped parabola's minimum within bounds: changes of starts and parameters, scaled."""
    left = reduced(quadratic, damping)
    n_f = len(theta)
    rows = np.vstack([left.factor, np.diag(quadratic.prior_root), np.sqrt(damping) * np.eye(n_f)])
    wanted = -np.concatenate([left.residual, quadratic.prior_gap, np.zeros(n_f)])
    low, high = (bounds[0] - theta) / scales, (bounds[1] - theta) / scales
    dtheta = bounded_least_squares(rows, wanted, low, high)
    return left.starts(dtheta), dtheta


def bounded_least_squares(
    rows: FloatArray, wanted: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """``min |rows·x − wanted|²`` with ``low ≤ x ≤ high``; held where the two are equal."""
    x = np.zeros(rows.shape[1])
    held = low == high
    x[held] = low[held]
    free = ~held
    if not free.any():
        return x
    a, b = rows[:, free], wanted - rows[:, held] @ x[held]
    inner, *_ = np.linalg.lstsq(a, b, rcond=None)
    if ((inner < low[free]) | (inner > high[free])).any():
        from scipy.optimize import lsq_linear  # 0.4 s to import, and seldom needed

        # The triangle says the same in fewer rows.
        q, r = np.linalg.qr(a)
        inner = lsq_linear(r, q.T @ b, (low[free], high[free]), method="bvls").x
    x[free] = np.clip(inner, low[free], high[free])
    return x
