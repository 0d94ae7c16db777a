"""Hunting of a PID predicted from the linear loop: by the event map, and by one harmonic.

For a rate Ω = A sin ωt without a stop, the first harmonic of the friction's moment is N(A) Ω with

    Coulomb     N = 4 F_c/(π A)
    Stribeck    N = 4 F_c/(π A) (1 + e (v_s/A) D(A/v_s))         D: Dawson's integral

since ``∫₀^{π/2} exp(−a² sin²θ) sin θ dθ = D(a)/a``. Both are real: with G(jω) the rate by the
friction's moment, a cycle needs G(jω) = −1/N(A), a crossing of the negative real axis, and an axis
that never stops. Hunting is not of that kind.

An axis that sticks has no rate of that form. There, the moment that the loop puts on the axis is
taken for a sine instead, T = X sin ωt, and the axis with its inertia and its friction,
``J Ω̇ + friction = T``, answers with stops; M(X, ω) is the first harmonic of its rate over that of T
(a sinusoidal-input describing function, by simulation of the block; Gelb & Vander Velde 1968,
"Multiple-Input Describing Functions", ch. 2; with friction Armstrong-Hélouvry & Amin 1996,
Automatica 32). The rest of the loop is T = −Z Ω, Z = 1/G − jωJ, and the balance

    Z(jω) = −1/M(X, ω).

Of hunting it is a rough picture: the moment on an axis that sticks is a ramp, no sine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.stability.cycles.stick_slip import Cycle, FrictionLaw, FrictionLoop, StickSlip

#: Errors at a stick at which the map is looked at, over what F_s moves; see :func:`errors_of`.
_LEAST, _MOST, _COUNT = 1e-3, 4.0, 28
#: Iterations of the map before Newton's method.
_ITERATIONS = 12
#: Relative change of the swing at which they end.
_SETTLED = 1e-4


@dataclass(frozen=True)
class HuntingPrediction:
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


def predict(events: StickSlip, count: int = _COUNT) -> HuntingPrediction:
    """The map, its threshold, and the stable cycle."""
    errors = errors_of(events.loop, events.law, count)
    following = _following(events, errors)
    grows = np.flatnonzero(np.nan_to_num(following / errors, nan=0.0) > 1.0)
    middle = errors[len(errors) // 2 : len(errors) // 2 + 1]
    alone = events.with_law(replace(events.law, excess=0.0))
    coulomb = -float(_following(alone, middle)[0] / middle[0])
    if not grows.size:
        return HuntingPrediction(errors, following, None, None, coulomb)
    threshold = _threshold(events, errors, int(grows[0]))
    cycle = _cycle(events, float(errors[grows[-1]]))
    if threshold is not None:
        # Points close to the threshold, where the map jumps, and a gap in between.
        near = threshold * np.array([0.8, 0.9, 0.96, 0.99, 0.998, 1.002, 1.01, 1.05, 1.12])
        errors = np.concatenate([errors, near, [threshold]])
        following = np.concatenate([following, _following(events, near), [np.nan]])
        order = np.argsort(errors, kind="stable")
        errors, following = errors[order], following[order]
    return HuntingPrediction(errors, following, cycle, threshold, coulomb)


def _following(events: StickSlip, errors: FloatArray) -> FloatArray:
    """The map at several errors: the next one's mirror image; NaN where a slip does not end."""
    after = [events.next_error(float(error)) for error in errors]
    return np.array([np.nan if error is None else -error for error in after])


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
    grows = np.flatnonzero(_following(events, errors) > errors)
    if not grows.size:
        return float("nan")
    z = events.settled(float(errors[grows[-1]]))
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
    moments, inverse = np.zeros(0), np.zeros(0, dtype=complex)
    if balance is not None:
        over = max(balance.moment - law.breakaway, 1e-6 * law.breakaway)
        moments = law.breakaway + over * np.geomspace(0.3, 300.0, 60)
        ratios = np.array([one.answer(float(X), balance.omega).ratio for X in moments])
        kept = np.abs(ratios) > 1e-9
        moments, inverse = moments[kept], -1.0 / ratios[kept]
    response, sliding = loop.response(omega), sliding_cycle(loop, law, omega)
    return Harmonics(omega, response, sliding, balance, one.impedance(omega), inverse, moments)


#: Steps of a period; periods until the block's answer repeats itself.
_OF_A_PERIOD, _REPEATED = 1000, 4
#: Grid on which a first guess is sought: moments over F_s, rad/s.
_MOMENTS, _OMEGAS = np.array([1.02, 1.1, 1.3, 1.7, 2.5]), np.geomspace(0.1, 4.0, 12)
#: Largest |1 + Z M| of a solution, and its largest distance to the grid: further down in frequency
#: the axis just sticks, and the balance is met better and better without ever being a cycle.
_BALANCED, _SLOWEST = 1e-3, 0.15


@dataclass(frozen=True)
class AxisResponse:
    """What an axis with friction does under a sine of the moment."""

    ratio: complex  #: M: first harmonic of the rate over the moment, (rad/s)/(N m)
    swing: float  #: Peak to peak of the angle, rad
    stuck: float  #: Share of the period at rest


@dataclass(frozen=True)
class Balance:
    """A solution of the harmonic balance."""

    moment: float  #: X, N m
    omega: float  #: rad/s
    swing: float  #: Peak to peak of the angle, rad
    stuck: float  #: Share of the period
    misfit: float  #: |1 + Z M|

    @property
    def period(self) -> float:
        """s."""
        return 2.0 * np.pi / self.omega


@dataclass(frozen=True)
class HarmonicBalance:
    """One harmonic of the moment on an axis that sticks."""

    loop: FrictionLoop
    law: FrictionLaw

    @cached_property
    def _step(self) -> BufferedFunction:
        """``(Ω, push, [F_c h/J, e, v_s]) → Ω⁺``: Moreau's time stepping, as the simulation's."""
        rate, push, sizes = ca.SX.sym("rate"), ca.SX.sym("push"), ca.SX.sym("sizes", 3)
        free = rate + push
        mean = (rate + free) / 2
        after = free
        for _ in range(3):
            most = sizes[0] * (1 + sizes[1] * ca.exp(-((mean / sizes[2]) ** 2)))
            after = free - ca.fmin(ca.fmax(free, -most), most)
            mean = (rate + after) / 2
        return BufferedFunction(ca.Function("sticking_axis", [rate, push, sizes], [after]))

    def answer(self, moment: float, omega: float) -> AxisResponse:
        """The axis under ``moment · sin(omega t)``."""
        h, inertia = 2.0 * np.pi / omega / _OF_A_PERIOD, 1.0 / self.loop.mobility
        middles = 2.0 * np.pi * (np.arange(_OF_A_PERIOD) + 0.5) / _OF_A_PERIOD
        pushes = (moment * np.sin(middles) * h / inertia).tolist()
        step = self._step
        rate, push, sizes = step.inputs
        after = step.outputs[0]
        sizes[:] = [self.law.torque * h / inertia, self.law.excess, self.law.velocity]
        rate[0] = 0.0
        rates = np.empty(_OF_A_PERIOD)
        for _ in range(_REPEATED):
            for k, value in enumerate(pushes):
                push[0] = value
                step()
                rate[0] = rates[k] = after[0]
        ends = 2.0 * np.pi * (np.arange(_OF_A_PERIOD) + 1.0) / _OF_A_PERIOD
        first = 2j / _OF_A_PERIOD * np.sum(rates * np.exp(-1j * ends))
        swing = float(np.ptp(np.cumsum(rates - rates.mean()) * h))
        return AxisResponse(complex(first / moment), swing, float(np.mean(rates == 0.0)))

    def impedance(self, omega: npt.ArrayLike) -> ComplexArray:
        """Z(jω): the moment that the loop puts on the axis against its rate, N m s/rad."""
        at = np.atleast_1d(np.asarray(omega, dtype=float))
        return np.asarray(1.0 / self.loop.response(at) - 1j * at / self.loop.mobility)

    def misfit(self, moment: float, omega: float) -> complex:
        """1 + Z M."""
        return 1.0 + complex(self.impedance(omega)[0]) * self.answer(moment, omega).ratio

    def solved(self) -> Balance | None:
        """The harmonic balance; None where it has no solution."""
        from scipy.optimize import root

        limit = self.law.breakaway
        grid = [
            (abs(self.misfit(limit * share, float(omega))), limit * share, float(omega))
            for omega in _OMEGAS
            for share in _MOMENTS.tolist()
        ]

        def equations(v: FloatArray) -> list[float]:
            error = self.misfit(limit * float(np.exp(v[0])), float(np.exp(v[1])))
            return [error.real, error.imag]

        for _, moment, omega in sorted(grid)[:4]:
            start = [np.log(moment / limit), np.log(omega)]
            solution = root(equations, start, options={"eps": 1e-3, "maxfev": 60, "xtol": 1e-6})
            moment, omega = limit * float(np.exp(solution.x[0])), float(np.exp(solution.x[1]))
            if not _SLOWEST < omega < 100.0:
                continue
            error = abs(self.misfit(moment, omega))
            if error < _BALANCED:
                shown = self.answer(moment, omega)
                return Balance(moment, omega, shown.swing, shown.stuck, error)
        return None


def sliding_cycle(
    loop: FrictionLoop, law: FrictionLaw, omega: FloatArray
) -> tuple[float, float] | None:
    """(A, ω) of a cycle without a stop, by G(jω) = −1/N(A); None where there is none.

    A crossing of the negative real axis at −1/N(A) for some amplitude: N falls from infinity to
    zero, so that every crossing is a solution.
    """
    from scipy.optimize import brentq

    G = loop.response(omega)
    turns = np.flatnonzero((np.diff(np.sign(G.imag)) != 0) & (G.real[:-1] < 0))
    if not turns.size:
        return None
    k = int(turns[-1])

    def at(w: float) -> complex:
        return complex(loop.response(np.array([w]))[0])

    w = float(brentq(lambda w: at(w).imag, omega[k], omega[k + 1]))
    wanted = -1.0 / at(w).real
    amplitude = brentq(lambda a: float(law.describing(a)) - wanted, 1e-9, 1e6)
    return float(amplitude), w
