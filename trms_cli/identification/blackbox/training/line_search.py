"""A loss along a line: scipy's strong Wolfe search over a loss that is evaluated once a point."""

from __future__ import annotations

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox.prediction_error import TrainingObjective

#: Armijo's constant.
DECREASE = 1e-4


class LineSearch:
    """Strong Wolfe search (Nocedal & Wright 2006, algorithms 3.5 and 3.6; scipy's).

    Parameters
    ----------
    objective : Objective
    curvature : float
        Largest remaining share of the slope along the line; conjugate directions need 0.1.
    """

    def __init__(self, objective: TrainingObjective, curvature: float) -> None:
        self._objective, self._curvature = objective, curvature
        self._at: FloatArray | None = None
        self._known: tuple[float, FloatArray] | None = None

    def evaluate(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Loss and gradient; a point that was just evaluated costs nothing."""
        if self._known is None or self._at is None or not np.array_equal(theta, self._at):
            self._at, self._known = theta.copy(), self._objective.gradient(theta)
        return self._known

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

        result = line_search(
            lambda x: self.evaluate(x)[0],
            lambda x: self.evaluate(x)[1],
            theta,
            direction,
            gfk=slope,
            old_fval=loss,
            old_old_fval=loss_before,
            c1=min(DECREASE, self._curvature / 2),
            c2=self._curvature,
            maxiter=20,
        )
        return None if result[0] is None else float(result[0])
