"""Conjugate gradients: Fletcher–Reeves, Polak–Ribière, Powell–Beale.

The direction is ``d_k = −g_k + β_k d_{k−1}``; with s = g_k − g_{k−1}

    Fletcher & Reeves (1964, Computer J. 7)     β = gₖᵀgₖ / gₖ₋₁ᵀgₖ₋₁
    Polak & Ribière (1969)                      β = max(0, gₖᵀs / gₖ₋₁ᵀgₖ₋₁): scipy's ``CG``
    Powell (1977, Math. Programming 12)         Beale's third term d_t, the direction of the last
                                                restart: d = −g + β d_{k−1} + γ d_t with
                                                β = gₖᵀs/dₖ₋₁ᵀs, γ = gₖᵀ(g_{t+1} − g_t)/d_tᵀ(…)

Powell restarts where successive gradients are far from orthogonal, |gₖ₋₁ᵀgₖ| ≥ 0.2 ‖gₖ‖², where
the direction is no sufficient descent, and after n steps. The first two restart after n steps.
"""

import warnings
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import TrainingObjective
from trms_cli.identification.blackbox.training.training import EpochReport, TrainingAlgorithm

Update = Literal["fletcher_reeves", "polak_ribiere", "powell_beale"]
#: Powell's constants.
_NOT_ORTHOGONAL = 0.2
_DESCENT = (0.8, 1.2)
#: Armijo's constant.
_DECREASE = 1e-4


class LineSearch:
    """Strong Wolfe search over a loss that is evaluated once a point.

    Nocedal & Wright 2006, algorithms 3.5 and 3.6; scipy's. ``curvature``: largest remaining share
    of the slope along the line; conjugate directions need 0.1.
    """

    def __init__(self, objective: TrainingObjective, curvature: float) -> None:
        self._objective, self._curvature = objective, curvature
        self._at: FloatArray | None = None
        self._evaluation: tuple[float, FloatArray] | None = None

    def evaluate(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Loss and gradient; a point that was just evaluated costs nothing."""
        if self._evaluation is None or self._at is None or not np.array_equal(theta, self._at):
            self._at, self._evaluation = theta.copy(), self._objective.gradient(theta)
        return self._evaluation

    def step(
        self,
        theta: FloatArray,
        direction: FloatArray,
        loss: float,
        slope: FloatArray,
        loss_before: float | None,
    ) -> float | None:
        """Length of the step, None where no length satisfies the conditions."""
        from scipy.optimize import line_search

        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # no length found: the caller restarts
            result = line_search(
                lambda x: self.evaluate(x)[0],
                lambda x: self.evaluate(x)[1],
                theta,
                direction,
                gfk=slope,
                old_fval=loss,
                old_old_fval=loss_before,
                c1=min(_DECREASE, self._curvature / 2),
                c2=self._curvature,
                maxiter=20,
            )
        return None if result[0] is None else float(result[0])


@dataclass(frozen=True, kw_only=True)
class ConjugateGradient(TrainingAlgorithm):
    """Conjugate gradients with a strong Wolfe line search."""

    update: Update
    #: Largest share of the slope along the line that a search leaves
    curvature: Annotated[float, Meta(gt=0, lt=0.5)] = 0.1

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        if self.update == "polak_ribiere":
            options = {"c1": min(_DECREASE, self.curvature / 2), "c2": self.curvature}
            minimise_by_scipy("CG", options, objective, start, report)
            return
        search = LineSearch(objective, self.curvature)
        theta, (loss, slope) = start, search.evaluate(start)
        memory, before = _Directions(self.update), None
        while True:
            direction = memory.next(slope)
            length = search.step(theta, direction, loss, slope, before)
            if length is None:
                if memory.restarted:
                    return
                memory.restart()
                continue
            theta = theta + length * direction
            before, (loss, slope) = loss, search.evaluate(theta)
            report(theta, loss, float(np.linalg.norm(slope)))


class _Directions:
    """The sequence of conjugate directions."""

    def __init__(self, update: Update) -> None:
        self._update = update
        self._slope: FloatArray | None = None
        self._direction: FloatArray | None = None
        self._anchor: tuple[FloatArray, FloatArray] | None = None  # d_t and g_{t+1} − g_t
        self._since = 0
        self.restarted = True

    def restart(self) -> None:
        """Let the next direction be steepest descent."""
        self._slope = self._direction = self._anchor = None

    def next(self, slope: FloatArray) -> FloatArray:
        """The direction at a point with this gradient."""
        before, last = self._slope, self._direction
        self.restarted = before is None or last is None
        if before is None or last is None:
            direction, self._since = -slope, 0
        elif self._update == "fletcher_reeves":
            direction = self._fletcher_reeves(slope, before, last)
        else:
            direction = self._powell_beale(slope, before, last)
        self._slope, self._direction = slope, direction
        self._since += 1
        return direction

    def _fletcher_reeves(
        self, slope: FloatArray, before: FloatArray, last: FloatArray
    ) -> FloatArray:
        direction = -slope + (slope @ slope) / (before @ before) * last
        if self._since >= slope.size or slope @ direction >= 0:
            self._since, self.restarted = 0, True
            return -slope
        return direction

    def _powell_beale(self, slope: FloatArray, before: FloatArray, last: FloatArray) -> FloatArray:
        change, square = slope - before, slope @ slope
        due = self._since >= slope.size or abs(before @ slope) >= _NOT_ORTHOGONAL * square
        if due or self._anchor is None:
            # The restart direction itself stays as the third term of those that follow it.
            self._anchor, self._since = (last, change), 1
            direction = -slope + _share(slope, last, change) * last
        else:
            anchor, anchor_change = self._anchor
            direction = (
                -slope
                + _share(slope, last, change) * last
                + _share(slope, anchor, anchor_change) * anchor
            )
            descent = -(slope @ direction)
            if not _DESCENT[0] * square <= descent <= _DESCENT[1] * square:
                self._anchor, self._since = (last, change), 1
                direction = -slope + _share(slope, last, change) * last
        if slope @ direction >= 0:
            self._anchor, self._since, self.restarted = None, 0, True
            return -slope
        return direction


def minimise_by_scipy(
    method: str,
    options: dict[str, Any],
    objective: TrainingObjective,
    start: FloatArray,
    report: EpochReport,
) -> None:
    """One of ``scipy.optimize.minimize``'s methods behind the interface of this package."""
    from scipy.optimize import OptimizeResult, minimize

    search = LineSearch(objective, 0.0)  # for its memory of the last point

    def tell(intermediate_result: OptimizeResult) -> None:
        theta = intermediate_result.x
        loss, slope = search.evaluate(theta)
        report(theta, loss, float(np.linalg.norm(slope)))

    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it ends without progress: the outcome says so
        minimize(
            search.evaluate,
            start,
            jac=True,
            method=method,
            callback=tell,
            # The report decides when to end.
            options={"gtol": 0.0, "maxiter": 10**9, **options},
        )


def _share(slope: FloatArray, direction: FloatArray, change: FloatArray) -> float:
    """gᵀs / dᵀs, by which d + … stays conjugate to the direction along which g changed by s."""
    denominator = float(direction @ change)
    return float(slope @ change) / denominator if denominator != 0 else 0.0
