"""A first-order lag with a constant input over a time window, solved exactly."""

from __future__ import annotations

import casadi as ca

#: A window of this many time constants and more leaves nothing of the past: exp(−1000) is zero in
#: double precision.
_LONGEST = 1000.0


def first_order(
    state: ca.SX, target: ca.SX, time_constant: ca.SX, duration: float
) -> tuple[ca.SX, ca.SX]:
    """Mean over a window and value after it of ``τ v̇ = target − v``.

    ``v⁺ = e v + (1 − e) target`` and ``mean = target + (v − target) (1 − e) τ/h`` with
    ``e = exp(−h/τ)``. For τ = 0 both are ``target``, bit for bit, and their derivatives are finite.

    Parameters
    ----------
    state : casadi.SX
        v at the beginning of the window.
    time_constant : casadi.SX
        τ, s, not negative.
    duration : float
        h, s.

    Returns
    -------
    (mean, after) : casadi.SX
    """
    divisor = ca.fmax(time_constant, duration / _LONGEST)
    kept = ca.exp(-duration / divisor)
    mean = target + (state - target) * (1 - kept) * (time_constant / duration)
    return mean, kept * state + (1 - kept) * target
