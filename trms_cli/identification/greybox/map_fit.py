"""A maximum a posteriori fit from one start: rounds of least squares and of weighing residuals.

Far from the optimum a residual is large because the parameters are wrong, not because of noise.
The first rounds therefore measure residuals by their own size, and each round that follows by the
size they have then, until that no longer changes: the deviations come down to the declared noise
where the model can follow the data, and stay above it where it cannot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trms_cli.identification.greybox.information import Information, information
from trms_cli.identification.greybox.levenberg_marquardt import Point, minimise, step
from trms_cli.identification.greybox.objective import Objective
from trms_cli.identification.greybox.weights import Weights, sizes
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.method import Outcome

FloatArray = npt.NDArray[np.float64]

#: Least-squares steps in the rounds before the last, and the reduction (nats) that ends a round.
_ROUND_ITERATIONS, _ROUND_TOLERANCE = 12, 0.5
_ROUNDS = 8
#: Relative change of the residuals' scales that no longer needs another round.
_SETTLED = 0.1
#: Joints that are to be tighter than this are tightened to it by factors of ten.
_FIRST_JOINT = 0.03
#: Gauss–Newton steps on the starts alone before anything is weighed.
_START_STEPS = 3


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """How a fit goes about it."""

    iterations: int = 100  #: Least-squares steps in the last round at most
    tolerance: float = 1e-3  #: Reduction of the cost that ends it, nats
    joined: float | None = None  #: See :class:`Objective`


class MapFit(NamedTuple):
    """Where a fit ended."""

    point: Point
    outcome: Outcome
    objective: Objective  #: With the weights of the last round
    information: Information | None  #: None where nothing could be simulated
    iterations: int


def fit_from(
    windows: Windows,
    theta: FloatArray,
    settings: MapSettings,
    *,
    held: npt.NDArray[np.bool_] | None = None,
    watch: Callable[[int, Point], bool] = lambda k, point: True,
) -> MapFit:
    """Fit from one point.

    Parameters
    ----------
    windows : Windows
    theta : (n_f,) array
    settings : MapSettings
    held : (n_f,) array of bool or None
        Parameters that stay where they are.
    watch : callable
        Told the number of steps so far and the best point; False ends the fit.
    """
    problem = windows.problem
    bounds = problem.bounds
    if held is not None:
        bounds = (np.where(held, theta, bounds[0]), np.where(held, theta, bounds[1]))
    centres = windows.starts(problem.all_values(theta))
    joints = _joints(settings.joined)
    objective = Objective(windows, _declared(windows), centres, joints[0])
    point = with_fitted_starts(objective, theta, centres)
    if not np.isfinite(point.cost):
        return MapFit(point, Outcome.FAILED, objective, None, 0)
    objective.weights = weighed(objective, point, None)
    known, done, outcome = None, 0, Outcome.CONVERGED
    for round_ in range(_ROUNDS):
        objective.joined = joints[min(round_, len(joints) - 1)]
        search = minimise(
            objective,
            point,
            bounds=bounds,
            iterations=_ROUND_ITERATIONS,
            tolerance=_ROUND_TOLERANCE,
            watch=lambda k, at, done=done: watch(done + k, at),  # type: ignore[misc]
        )
        point, done = search.point, done + search.iterations
        if search.outcome is Outcome.INTERRUPTED:
            outcome = search.outcome
            break
        known = information(objective, point.theta, point.starts)
        weights = weighed(objective, point, known)
        change = _change(objective.weights, weights)
        objective.weights = weights
        if change < _SETTLED and round_ + 1 >= len(joints):
            break
    if outcome is not Outcome.INTERRUPTED:
        search = minimise(
            objective,
            point,
            bounds=bounds,
            iterations=settings.iterations,
            tolerance=settings.tolerance,
            watch=lambda k, at: watch(done + k, at),
        )
        point, outcome, done = search.point, search.outcome, done + search.iterations
    known = information(objective, point.theta, point.starts)
    return MapFit(point, outcome, objective, known, done)


def _joints(last: float | None) -> list[float | None]:
    """Joints between windows, tightened by steps: a stiff one lets the search move by hairs."""
    if last is None:
        return [None]
    joints: list[float | None] = [last]
    while (joints[0] or 0.0) < _FIRST_JOINT:
        joints.insert(0, min(10 * (joints[0] or 0.0), _FIRST_JOINT))
    return joints


def with_fitted_starts(objective: Objective, theta: FloatArray, starts: FloatArray) -> Point:
    """The parameters as they are, with the starts that fit best to them."""
    held = (theta, theta)
    best = Point(theta, starts, objective.cost(theta, starts))
    for _ in range(_START_STEPS):
        _, quadratic, residuals = objective.parabola(theta, best.starts)
        if not residuals.finite:
            break
        dx, _ = step(quadratic, 1e-6, theta, held, objective.scales)
        tried = best.starts + dx * objective.windows.spread
        cost = objective.cost(theta, tried)
        if not cost < best.cost:
            break
        gained, best = best.cost - cost, Point(theta, tried, cost)
        if gained < 1e-3 * cost:
            break
    return best


def weighed(objective: Objective, point: Point, known: Information | None) -> Weights:
    """Weights that fit the residuals at a point; see :class:`Weights`."""
    windows, problem = objective.windows, objective.windows.problem
    if problem.discrepancy == "none" and known is not None:
        return _declared(windows)
    p = problem.all_values(point.theta)
    r = windows.residuals(p, point.starts).r
    size = np.maximum(1.0, sizes(r, windows.measured, windows.declared))
    samples = objective.weights.samples
    if known is not None:
        samples = np.maximum(1.0, known.samples_per_sample())
    return Weights(windows.declared * size, samples, windows.share, problem.robust)


def _declared(windows: Windows) -> Weights:
    n_y = windows.declared.shape[1]
    return Weights(windows.declared, np.ones(n_y), windows.share, windows.problem.robust)


def _change(before: Weights, after: Weights) -> float:
    """Largest relative change of the weight of any output."""
    scale = before.sd / after.sd * np.sqrt(before.samples / after.samples)
    return float(np.max(np.abs(np.log(scale))))
