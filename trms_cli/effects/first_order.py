"""A first-order lag with a constant input over a time window, solved exactly."""

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

    ``state``: v at the beginning of the window. ``time_constant``: τ, s, not negative.
    ``duration``: h, s.
    """
    divisor = ca.fmax(time_constant, duration / _LONGEST)
    decay = ca.exp(-duration / divisor)
    mean = target + (state - target) * (1 - decay) * (time_constant / duration)
    return mean, decay * state + (1 - decay) * target


def first_order_ramp(error: ca.SX, rise: ca.SX, time_constant: ca.SX, duration: float) -> ca.SX:
    """How far ``τ v̇ = target − v`` is off its target after a window over which that rises evenly.

    ``e⁺ = exp(−h/τ) e − (1 − exp(−h/τ)) (τ/h) rise`` for ``e = v − target``. For τ = 0 it is zero,
    bit for bit, with finite derivatives.

    ``error``: v − target at the beginning of the window. ``rise``: change of the target over the
    window. ``time_constant``: τ, s, not negative. ``duration``: h, s.
    """
    divisor = ca.fmax(time_constant, duration / _LONGEST)
    decay = ca.exp(-duration / divisor)
    return decay * error - (1 - decay) * (time_constant / duration) * rise
