"""Dry friction as an impulse at the end of an integration step, set-valued at rest.

The torque opposes the rate and stops it exactly where it suffices: with the free rate ``r`` at
the end of the interval and ``d`` the change of the state by a unit torque over it, the impulse
is ``−clip(r/∂r, −torque·h, +torque·h)``. This is Moreau's time stepping (1988): no smoothing of
the sign, no creep at rest, no limit on the step.
"""

from collections.abc import Callable
from functools import lru_cache

import casadi as ca

from trms_cli.core.errors import ModelError
from trms_cli.models.model import Model, RigAxis, index_of

#: Each shrinks the error of the mean rate by about ``h |dτ/dΩ| / 2J``, a few percent.
_MEAN_RATE_ITERATIONS = 2


def axis_of(model: Model, name: str) -> RigAxis:
    """An axis of a model.

    Raises ModelError if the model has no such axis.
    """
    if name not in model.axes:
        raise ModelError(
            f"model {model.name!r} has no {name} axis",
            remedy=f"it has: {', '.join(model.axes) or 'none'}",
        )
    return model.axes[name]


def moment_index(model: Model, axis: str) -> int:
    """Position in ``w`` of the torque on an axis."""
    return index_of(model.disturbances, axis_of(model, axis).moment, "a disturbance")


def turning_rate(model: Model, equation: int) -> ca.Function | None:
    """``(x, u, p, w)`` → rate, rad/s, of the axis or rotor that a disturbance is a torque on.

    ``equation``: position of the disturbance in ``w``. None: it is no such torque (of a black box,
    or of a model that does not say where it acts).
    """
    if model.sample_time is not None:
        return None
    x, u, p, w = at = model.symbols()
    f = model.dynamics(*at)
    torques = {signal.name for signal in model.disturbances}
    rotors = (rotor for rotor in model.rotor_speeds if model.rotors[rotor].torque in torques)
    for part in (*model.axes, *rotors):
        rate, torque = _turning(model, part, x, f)
        if torque == equation:
            return ca.Function("rate", [x, u, p, w], [rate])
    return None


def _turning(model: Model, part: str, x: ca.SX, f: ca.SX) -> tuple[ca.SX, int]:
    """Rate of an axis or rotor, rad/s, and the position in ``w`` of the torque on it."""
    if part in model.rotors:
        rotor = model.rotors[part]
        torque = index_of(model.disturbances, rotor.torque, "a disturbance")
        return x[model.state_index(rotor.speed)], torque
    return f[model.state_index(axis_of(model, part).angle)], moment_index(model, part)


def apply_dry_friction(
    model: Model,
    at: tuple[ca.SX, ca.SX, ca.SX, ca.SX],
    part: str,
    torque: ca.SX | Callable[[ca.SX], ca.SX] | None,
    duration: float,
) -> ca.SX:
    """States after dry friction has acted on an axis or rotor for a time.

    ``model``: its continuous part is used. ``at``: (x, u, p, w); states at the end of the interval,
    inputs that reached the motors, parameters, disturbances. ``part``: an axis of the model, or one
    of its rotors. ``torque``: N m, not negative; a function of the rate (rad/s), for which the mean
    rate over the interval is found by iteration; None removes the whole rate (an inelastic stop).
    ``duration``: s.
    """
    free_rate, change, gain, acceleration = _resistance_function(model, part, duration)(*at)
    x = at[0]
    stopping_impulse = free_rate / gain
    if torque is None:
        return x - change * stopping_impulse
    if not callable(torque):
        return x - change * _clipped(stopping_impulse, torque * duration)
    # The rate before the interval is that after it less what the model did in between.
    rate_before = free_rate - duration * acceleration
    mean = rate_before
    for _ in range(_MEAN_RATE_ITERATIONS):
        impulse = _clipped(stopping_impulse, torque(mean) * duration)
        mean = (rate_before + free_rate - gain * impulse) / 2
    return x - change * _clipped(stopping_impulse, torque(mean) * duration)


def _clipped(value: ca.SX, bound: ca.SX) -> ca.SX:
    return ca.fmin(ca.fmax(value, -bound), bound)


@lru_cache(maxsize=256)
def _resistance_function(model: Model, part: str, duration: float) -> ca.Function:
    """``(x, u, p, w) → rate, change, gain, acceleration``, for a torque over the duration.

    A torque that is constant over the interval moves the angle too, by about half of what its
    final rate would, and meets damping and stiffness on the way. ``change`` is the response
    ``∫ exp(J s) ds / h`` of the linearised model to the order h²; with fewer terms an axis that
    should rest creeps under a constant load (at a·h/2 with the first term alone).

    Built once for a model and inlined wherever it is called: it is asked at every substep.
    """
    x, u, p, w = model.symbols()
    f = model.dynamics(x, u, p, w)
    rate, torque = _turning(model, part, x, f)
    change = term = ca.jacobian(f, w)[:, torque]
    # A stiff model's currents follow a rotor within a step: their series does not converge.
    stiff = model.stiff and part in model.rotors
    for order in () if stiff else (2, 3):
        term = duration / order * ca.jtimes(f, x, term)
        change = change + term
    gain = ca.jtimes(rate, x, change)
    acceleration = ca.jtimes(rate, x, f)
    return ca.Function("resistance", [x, u, p, w], [rate, change, gain, acceleration])
