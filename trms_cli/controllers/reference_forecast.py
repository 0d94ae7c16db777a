"""Where a reference goes next, judged by where it came from.

A controller that knows no future reference takes it as constant, and lags behind whatever moves.
Constants, ramps and sines (with any offset) obey one recursion of their differences,

    Δ_{k+1} = 2c Δ_k − Δ_{k−1}      c = cos ωT, and 1 for a ramp

of which c follows from the last few samples by least squares. Where the recursion explains them
(the reference is smooth), it is carried on; where it does not (a jump is among them, or noise), the
reference is taken as constant as before. Nothing but past and present references is used.

The recursion is the internal model of the signal (Francis & Wonham 1976, Automatica 12), here on
the reference alone.

The rate at which a reference moves counts as far as it moves smoothly: a weight on the rate of an
angle is to damp its motion, not to hold it back from a reference that moves itself: what counts is
the rate beside that of the reference. A jump has no rate: a single difference that neither
neighbour comes near is taken as zero.
"""

from collections import deque

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray

#: Differences that have to agree with the recursion.
_WINDOW = 6
#: Part of their power that it may leave unexplained.
_UNEXPLAINED = 1e-3
#: cos of the fastest phase a control period; faster sines are not told from noise.
_FASTEST = 0.5
#: Differences below this (rad) are those of a constant.
_STILL = 1e-9
#: Share of a difference by which one of its neighbours may differ, for it to be smooth.
_NEAR = 0.5


def smooth_rates(r: ca.MX, period: float) -> ca.MX:
    """Rates over the periods that end at each reference, (n_r, N), unit/s.

    ``r``: (n_r, N); references at the ends of N control periods. The one before them is not among
    them: the first period is taken to move as the second. ``period``: s.
    """
    n_r, n = r.shape
    if n < 3:
        return type(r).zeros(n_r, n)
    moves = r[:, 1:] - r[:, :-1]
    before = ca.horzcat(moves[:, 0], moves[:, :-1])
    after = ca.horzcat(moves[:, 1:], moves[:, -1])
    # At either end a difference has one neighbour: itself in the other's place would always do.
    before[:, 0], after[:, -1] = moves[:, 1], moves[:, -2]
    step = ca.fmin(ca.fabs(moves - before), ca.fabs(moves - after))
    smooth = ca.if_else(step <= _NEAR * ca.fabs(moves), moves, 0)
    return ca.horzcat(smooth[:, 0], smooth) / period


class ReferenceForecast:
    """Forecasts of each axis' reference.

    ``horizon``: control periods to look ahead; 0 for no forecast. ``axes``: number of references.
    """

    def __init__(self, horizon: int, axes: int) -> None:
        self._horizon = horizon
        self._last: list[float | None] = [None] * axes
        self._moves: list[deque[float]] = [deque(maxlen=_WINDOW) for _ in range(axes)]

    def update(self, reference: FloatArray) -> FloatArray:
        """Take in the reference of this control period, and tell the next ones.

        ``reference``: (n_r,) array; rad. Returns (horizon + 1, n_r) array; row 0 is the present;
        (1, n_r) without a forecast of any axis.
        """
        present = reference.tolist()
        forecasts: dict[int, list[float]] = {}
        for i, value in enumerate(present):
            last, moves = self._last[i], self._moves[i]
            if last is not None:
                moves.append(value - last)
            self._last[i] = value
            if self._horizon:
                steps = _following(moves, self._horizon)
                if steps is not None:
                    forecasts[i] = steps
        if not forecasts:
            return reference[None, :]
        rows = np.repeat(reference[None, :], self._horizon + 1, axis=0)
        for i, steps in forecasts.items():
            rows[1:, i] += np.cumsum(steps)
        return rows


def _following(moves: deque[float], count: int) -> list[float] | None:
    """The next differences, or None where the recursion does not explain the last ones."""
    if len(moves) < _WINDOW:
        return None
    d = list(moves)
    if max(map(abs, d)) < _STILL:
        return None
    middle = sum(b * b for b in d[1:-1])
    if middle == 0.0:
        return None
    c = sum(b * (a + e) for a, b, e in zip(d, d[1:], d[2:], strict=False)) / (2 * middle)
    c = min(c, 1.0)
    residual = sum((a + e - 2 * c * b) ** 2 for a, b, e in zip(d, d[1:], d[2:], strict=False))
    if c < _FASTEST or residual > _UNEXPLAINED * middle:
        return None
    before, now = d[-2], d[-1]
    steps = []
    for _ in range(count):
        before, now = now, 2 * c * now - before
        steps.append(now)
    return steps
