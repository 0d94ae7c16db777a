"""The rate at which a reference moves, as far as it moves smoothly.

A weight on the rate of an angle is to damp its motion, not to hold it back from a reference that
moves itself: what counts is the rate beside that of the reference. A jump has no rate: a single
difference that neither neighbour comes near is taken as zero.
"""

from __future__ import annotations

import casadi as ca

#: Share of a difference by which one of its neighbours may differ, for it to be smooth.
_NEAR = 0.5


def smooth_rates(r: ca.MX, period: float) -> ca.MX:
    """Rates over the periods that end at each reference, (n_r, N), unit/s.

    Parameters
    ----------
    r : (n_r, N)
        References at the ends of N control periods. The one before them is not among them: the
        first period is taken to move as the second.
    period : float
        s.
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
