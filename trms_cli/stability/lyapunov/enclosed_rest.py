"""The equilibrium of a rig at a constant command, between bounds.

It follows in turns from equations of one unknown each, ``s(ω) = 0`` of each rotor, then the
balance of pitch and that of yaw at the thrusts found. A change of sign of each, told by interval
arithmetic, proves an equilibrium between the bounds (intermediate values); that s rises makes the
rotor's the only one.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ModelError
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval, stack
from trms_cli.stability.lyapunov.energy import Energy

FloatArray = npt.NDArray[np.float64]

#: Newton steps from the guess, and how far they may lead away from it, as a share of 1 + |value|.
#: What a solver leaves of a moment at the equilibrium would be a term of V̇ that is not in −zᵀQz.
_STEPS, _AWAY = 5, 1e-6
#: Half widths that are tried, as shares of 1 + |value|.
_WIDTHS = (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6)


def enclosed_rest(energy: Energy, x: FloatArray) -> Interval:
    """Bounds of the equilibrium near a state, (3k,), as a state of motion.

    Parameters
    ----------
    energy : Energy
    x : (n_x,)
        A numerical solution of f(x, u) = 0.

    Raises
    ------
    ModelError
        If no change of sign is found.
    """
    y = np.array(energy.to_motion(x)).ravel()
    found = {name: Interval.point(0.0) for name in energy.names()}
    thrust: dict[str, Interval] = {}
    for axis in energy.axes:
        speed = ca.SX.sym("speed")
        settling = ca.Function("s", [speed], [energy.settling(axis, speed)])
        guess = float(y[energy.index("omega", axis)])
        omega = _zero(settling, guess, f"speed of the rotor of axis {axis}")
        found[f"omega_{axis}"] = omega
        thrust[axis] = _at(ca.Function("F", [speed], [energy.thrust(axis, speed)]), omega)
    for axis in reversed(energy.axes):
        angle, push, lever = ca.SX.sym("angle"), ca.SX.sym("push"), ca.SX.sym("lever")
        pitch = found.get("alpha_v", Interval.point(0.0))
        arm = Interval.point(energy.c["l_m" if axis == "v" else "l_t"])
        lifted = arm if axis == "v" else arm * pitch.cosine()
        balance = ca.Function(
            "balance", [angle, push, lever], [energy.restoring(axis, angle) - lever * push]
        )
        guess = float(y[energy.index("alpha", axis)])
        found[f"alpha_{axis}"] = _zero(balance, guess, f"alpha_{axis}", thrust[axis], lifted)
    return stack([found[name] for name in energy.names()])


def _at(function: ca.Function, *values: Interval) -> Interval:
    columns = [Interval(np.array([[v.lower]]), np.array([[v.upper]])) for v in values]
    bounds = Enclosure(function)(*columns)[0]
    return Interval(bounds.lower[0, 0], bounds.upper[0, 0])


def _zero(function: ca.Function, guess: float, what: str, *given: Interval) -> Interval:
    """Bounds of a zero near a guess."""
    exact = _at(function, Interval.point(0.0), *given)
    if abs(guess) < 1e-9 and abs(exact.lower) < 1e-300 and abs(exact.upper) < 1e-300:
        return Interval.point(0.0)  # nothing drives it: exactly zero
    guess = _polished(function, guess, *(v.middle for v in given))
    for width in _WIDTHS:
        reach = width * (1.0 + abs(guess))
        low, high = (_at(function, Interval.point(guess + d), *given) for d in (-reach, reach))
        if low.upper < 0.0 < high.lower:
            return Interval.of(guess - reach, guess + reach)
        if high.upper < 0.0 < low.lower:
            raise ModelError(
                f"the equilibrium at {what} = {guess:.4g} is on a crest of the potential: a "
                "saddle, which no function can show to be stable",
                where="study.at",
                remedy="choose one in the well, at a smaller angle; study=equilibria shows both",
            )
    raise ModelError(
        f"no equilibrium is proved near {what} = {guess:.6g}",
        where="study.at",
        remedy="choose one away from the fold, where the restoring moment still rises",
    )


def _polished(function: ca.Function, guess: float, *given: FloatArray) -> float:
    """The zero near a guess to the last digits; the guess where Newton's steps lead away."""
    symbols = [ca.SX.sym(f"a{i}") for i in range(function.n_in())]
    value = function(*symbols)
    slope = ca.Function("slope", symbols, [value, ca.jacobian(value, symbols[0])])
    at, best, least = guess, guess, float("inf")
    for _ in range(_STEPS):
        left, rate = (float(part) for part in slope(at, *(float(g) for g in given)))
        if abs(left) < least:
            best, least = at, abs(left)
        if left == 0.0 or rate == 0.0:
            break
        at -= left / rate
        if abs(at - guess) > _AWAY * (1.0 + abs(guess)):
            break
    return best
