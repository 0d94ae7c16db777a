"""Hunting of a PID predicted from the linear loop: by the event map, and by one harmonic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.cycles.describing import Balance, HarmonicBalance, sliding_cycle
from trms_cli.stability.cycles.friction_law import FrictionLaw
from trms_cli.stability.cycles.pid_loop import FrictionLoop
from trms_cli.stability.cycles.stick_slip import Cycle, StickSlip

FloatArray = npt.NDArray[np.float64]

#: Errors at a stick at which the map is looked at, over what F_s moves; see :func:`errors_of`.
_LEAST, _MOST, _COUNT = 1e-3, 4.0, 28
#: Iterations of the map before Newton's method.
_ITERATIONS = 12
#: Relative change of the swing at which they end.
_SETTLED = 1e-4


@dataclass(frozen=True)
class Prediction:
    """What the linear loop says."""

    #: (n,) arrays; The map: the error at a stick, and that at the next one with its sign turned
    #: (positive: the slip crossed the reference), rad
    errors: FloatArray
    following: FloatArray  #: (n,) arrays; NaN where a slip does not end
    cycle: Cycle | None  #: The hunting cycle
    #: rad: a stick at a smaller error leads to rest, at a larger one to the cycle
    threshold: float | None
    #: The same map for Coulomb friction alone is linear: its factor. Below 1 in size: no hunting.
    coulomb: float


def errors_of(loop: FrictionLoop, law: FrictionLaw, count: int = _COUNT) -> FloatArray:
    """Errors that are worth a look: around the one that friction's moment holds off, rad.

    The angle that F_s moves without the integral is its measure: the static stiffness of what is
    left is taken at the frequency where the loop is stiffest against the friction.
    """
    omega = np.geomspace(1e-2, 1e2, 400)
    yielding = float((np.abs(loop.response(omega)) / omega).max())
    return np.geomspace(_LEAST, _MOST, count) * law.breakaway * yielding


def predicted(events: StickSlip, count: int = _COUNT) -> Prediction:
    """The map, its threshold, and the stable cycle."""
    errors = errors_of(events.loop, events.law, count)
    found = [events.next_error(float(e)) for e in errors]
    following = np.array([np.nan if f is None else -f for f in found])
    ratio = following / errors
    grows = np.nan_to_num(ratio, nan=0.0) > 1.0
    coulomb = _coulomb_factor(events, float(errors[len(errors) // 2]))
    if not grows.any():
        return Prediction(errors, following, None, None, coulomb)
    first = int(np.flatnonzero(grows)[0])
    threshold = _threshold(events, errors, first)
    guess = float(errors[int(np.flatnonzero(grows)[-1])])
    if threshold is not None:
        errors, following = _with_jump(events, errors, following, threshold)
    return Prediction(errors, following, _cycle(events, guess), threshold, coulomb)


def _with_jump(
    events: StickSlip, errors: FloatArray, following: FloatArray, threshold: float
) -> tuple[FloatArray, FloatArray]:
    """The map with points close to its threshold, where it jumps, and a gap in between."""
    near = threshold * np.array([0.8, 0.9, 0.96, 0.99, 0.998, 1.002, 1.01, 1.05, 1.12])
    found = [events.next_error(float(e)) for e in near]
    more = np.array([np.nan if f is None else -f for f in found])
    both = np.concatenate([errors, near, [threshold]])
    order = np.argsort(both, kind="stable")
    return both[order], np.concatenate([following, more, [np.nan]])[order]


def _coulomb_factor(events: StickSlip, error: float) -> float:
    law = FrictionLaw(events.law.torque, 0.0, events.law.velocity)
    following = events.with_law(law).next_error(error)
    return float("nan") if following is None else following / error


def _threshold(events: StickSlip, errors: FloatArray, first: int) -> float | None:
    """Where the map begins to grow, by bisection."""
    if first == 0:
        return None
    low, high = float(errors[first - 1]), float(errors[first])
    for _ in range(14):
        middle = float(np.sqrt(low * high))
        following = events.next_error(middle)
        if following is not None and -following > middle:
            high = middle
        else:
            low = middle
    return high


def _cycle(events: StickSlip, error: float) -> Cycle | None:
    z = events.settled(error)
    if z is None:
        return None
    for _ in range(_ITERATIONS):
        half = events.half(z)
        if half is None:
            return None
        z = -half.end
    if abs(float(events.loop.angle @ z)) < 1e-7:
        return None
    return events.cycle(z)


def swings(events: StickSlip, laws: Sequence[FrictionLaw]) -> FloatArray:
    """Predicted swing for several frictions, rad; NaN where the loop does not hunt."""
    return np.array([_swing(events.with_law(law)) for law in laws])


def _swing(events: StickSlip) -> float:
    """By iterating the map; no multipliers."""
    errors = errors_of(events.loop, events.law, 14)
    found = [events.next_error(float(e)) for e in errors]
    grows = [f is not None and -f > e for f, e in zip(found, errors, strict=True)]
    if not any(grows):
        return float("nan")
    z = events.settled(float(errors[int(np.flatnonzero(grows)[-1])]))
    travel = float("nan")
    for _ in range(_ITERATIONS):
        half = None if z is None else events.half(z)
        if half is None:
            return float("nan")
        before, travel = travel, abs(float(events.loop.angle @ (half.end - half.start)))
        if abs(travel - before) < _SETTLED * travel:
            break
        z = -half.end
    return travel if travel > 1e-6 else float("nan")


@dataclass(frozen=True)
class Harmonics:
    """What one harmonic says."""

    omega: FloatArray  #: (n,) array; rad/s
    response: npt.NDArray[np.complex128]  #: (n,) complex array; G(jω)
    #: Amplitude (rad/s) and frequency (rad/s) of a cycle that never sticks
    sliding: tuple[float, float] | None
    balance: Balance | None  #: Of an axis that sticks
    impedance: npt.NDArray[np.complex128]  #: (n,) complex array; Z(jω)
    #: (k,) complex array; −1/M(X, ω*) over X at the balance's frequency (empty without one)
    inverse: npt.NDArray[np.complex128]
    moments: FloatArray  #: (k,) array; X, N m


def harmonics(loop: FrictionLoop, law: FrictionLaw) -> Harmonics:
    """Describing functions of the friction with this loop."""
    omega = np.geomspace(0.02, 60.0, 1200)
    one = HarmonicBalance(loop, law)
    balance = one.solved()
    moments = np.zeros(0)
    inverse = np.zeros(0, dtype=complex)
    if balance is not None:
        over = max(balance.moment - law.breakaway, 1e-6 * law.breakaway)
        moments = law.breakaway + over * np.geomspace(0.3, 300.0, 60)
        ratios = np.array([one.answer(float(X), balance.omega).ratio for X in moments])
        kept = np.abs(ratios) > 1e-9
        moments, inverse = moments[kept], -1.0 / ratios[kept]
    return Harmonics(
        omega,
        loop.response(omega),
        sliding_cycle(loop, law, omega),
        balance,
        one.impedance(omega),
        inverse,
        moments,
    )
