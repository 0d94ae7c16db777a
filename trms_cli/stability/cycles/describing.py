"""Describing functions of friction, and the harmonic balance with a loop.

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

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.stability.cycles.friction_law import FrictionLaw
from trms_cli.stability.cycles.pid_loop import FrictionLoop

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

#: Steps of a period; periods until the block's answer repeats itself.
_STEPS, _PERIODS = 1000, 4
#: Grid on which a first guess is sought: moments over F_s, rad/s.
_MOMENTS, _OMEGAS = np.array([1.02, 1.1, 1.3, 1.7, 2.5]), np.geomspace(0.1, 4.0, 12)
#: Largest |1 + Z M| of a solution, and its largest distance to the grid: further down in frequency
#: the axis just sticks, and the balance is met better and better without ever being a cycle.
_BALANCED, _SLOWEST = 1e-3, 0.15


@dataclass(frozen=True)
class Answer:
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


class HarmonicBalance:
    """One harmonic of the moment on an axis that sticks.

    Parameters
    ----------
    loop : FrictionLoop
    law : FrictionLaw
    """

    def __init__(self, loop: FrictionLoop, law: FrictionLaw) -> None:
        self.loop, self.law = loop, law

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

    def answer(self, moment: float, omega: float) -> Answer:
        """The axis under ``moment · sin(omega t)``."""
        h, inertia = 2.0 * np.pi / omega / _STEPS, 1.0 / self.loop.mobility
        middles = 2.0 * np.pi * (np.arange(_STEPS) + 0.5) / _STEPS
        pushes = (moment * np.sin(middles) * h / inertia).tolist()
        step = self._step
        rate, push, sizes = step.inputs
        after = step.outputs[0]
        sizes[:] = [self.law.torque * h / inertia, self.law.excess, self.law.velocity]
        rate[0] = 0.0
        rates = np.empty(_STEPS)
        for _ in range(_PERIODS):
            for k, value in enumerate(pushes):
                push[0] = value
                step()
                rate[0] = rates[k] = after[0]
        ends = 2.0 * np.pi * (np.arange(_STEPS) + 1.0) / _STEPS
        first = 2j / _STEPS * np.sum(rates * np.exp(-1j * ends))
        angle = np.cumsum(rates - rates.mean()) * h
        return Answer(complex(first / moment), float(np.ptp(angle)), float(np.mean(rates == 0.0)))

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
            found = root(equations, start, options={"eps": 1e-3, "maxfev": 60, "xtol": 1e-6})
            moment, omega = limit * float(np.exp(found.x[0])), float(np.exp(found.x[1]))
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

    def imaginary(w: float) -> float:
        return float(loop.response(np.array([w]))[0].imag)

    w = float(brentq(imaginary, omega[k], omega[k + 1]))
    wanted = -1.0 / float(loop.response(np.array([w]))[0].real)
    amplitude = brentq(lambda a: float(law.describing(a)) - wanted, 1e-9, 1e6)
    return float(amplitude), w
