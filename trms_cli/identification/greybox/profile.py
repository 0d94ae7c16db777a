"""Profile likelihood: how the cost grows when one parameter is held away from its optimum.

All others and the starts are fitted again at every value (Venzon & Moolgavkar 1988, Applied
Statistics 37). Where the cost is not a parabola, or a bound is near, the interval in which it stays
within half the χ² quantile of the best is better than one from the covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.levenberg_marquardt import Point, minimise
from trms_cli.identification.greybox.objective import Objective

FloatArray = npt.NDArray[np.float64]

#: Half the 95 % quantile of χ² with one degree of freedom.
_RISE_95 = 3.841458820694124 / 2
#: The profile is followed to this many times that rise, to show its shape beyond the interval.
_FOLLOWED = 1.5
_ITERATIONS, _TOLERANCE = 30, 1e-3
_MOST_STEPS = 24


@dataclass(frozen=True)
class Profile:
    """The cost along one parameter."""

    name: str
    values: FloatArray  #: (k,) array; ascending, in the parameter's unit
    #: (k,) array; cost above the optimum's; negative where the fit had not found the best
    rise: FloatArray
    #: 95 %, by the likelihood ratio; infinite on a side where the profile stays below the quantile
    #: as far as it was followed, the bound where it ends there
    interval: tuple[float, float]


def profile(
    objective: Objective,
    best: Point,
    name: str,
    sd: float,
    *,
    factor: float = 1.0,
    watch: Callable[[int, Point], bool] = lambda k, point: True,
) -> Profile:
    """Follow the cost to both sides of an optimum, each fit beginning at the one before.

    Parameters
    ----------
    objective : Objective
        With the weights of the fit.
    best : Point
    name : str
        A free parameter.
    sd : float
        Its standard deviation; steps are half of it.
    factor : float
        The rise is multiplied by it before it is compared: how much larger the curvature of the
        cost would be if the residuals' correlation were in it.
    watch : callable
        As of :func:`minimise`.
    """
    problem = objective.windows.problem
    column = problem.names.index(name)
    low, high = problem.bounds
    values, rises = [float(best.theta[column])], [0.0]
    ends = []
    for direction, bound in ((-1.0, low[column]), (1.0, high[column])):
        point, stride, end = best, 0.5 * sd, direction * np.inf
        for _ in range(_MOST_STEPS):
            value = float(point.theta[column] + direction * stride)
            value = float(np.clip(value, low[column], high[column]))
            if value == point.theta[column]:
                end = float(bound)
                break
            theta = point.theta.copy()
            theta[column] = value
            held = (low.copy(), high.copy())
            held[0][column] = held[1][column] = value
            found = minimise(
                objective,
                point._replace(theta=theta),
                bounds=held,
                iterations=_ITERATIONS,
                tolerance=_TOLERANCE,
                watch=watch,
            ).point
            rise = factor * (found.cost - best.cost)
            before = factor * (point.cost - best.cost)
            if before < _RISE_95 <= rise:
                share = _root_share(before, rise)
                end = float(point.theta[column] + share * (value - point.theta[column]))
            values.append(value)
            rises.append(rise)
            point = found
            if not np.isfinite(rise) or rise > _FOLLOWED * _RISE_95:
                break
            if rise < 0.25 * _RISE_95:  # flat: longer strides
                stride *= 1.5
        ends.append(end)
    order = np.argsort(values)
    return Profile(name, np.array(values)[order], np.array(rises)[order], (ends[0], ends[1]))


def _root_share(before: float, after: float) -> float:
    """Where between two values the rise passes the quantile, as of a parabola."""
    roots = np.sqrt(np.maximum([before, after, _RISE_95], 0.0))
    return float((roots[2] - roots[0]) / max(roots[1] - roots[0], 1e-12))
