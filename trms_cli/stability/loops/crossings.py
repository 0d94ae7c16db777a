"""What a single loop can take, read off its Nyquist curve.

The loop is known to be stable: it was measured closed. Along a change of the loop that grows from
nothing, it stays so until the changed curve first runs through −1. For a factor g that is a
crossing of the negative real axis at −1/g; for a phase or a delay, a crossing of the unit circle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Limit:
    """The first change that makes a loop unstable."""

    value: float  #: A factor, rad or s
    omega: float  #: rad/s at which the loop then swings


@dataclass(frozen=True)
class Crossings:
    """Limits of a loop; None where no such change makes the measured curve run into −1."""

    up: Limit | None  #: Factor of the loop's gain, above and below 1
    down: Limit | None  #: Factor of the loop's gain, above and below 1
    phase: Limit | None  #: Least phase lost or gained at a unit gain, rad
    delay: Limit | None  #: s
    crossover: float  #: Highest frequency at which the gain is 1, rad/s; 0 if it never is


def crossings(omega: FloatArray, loops: ComplexArray) -> Crossings:
    """The limits of a loop, or of several that change together.

    Parameters
    ----------
    omega : (n,) array
        rad/s, dense.
    loops : (n,) or (n, m) array
        Nyquist curves; of several (the characteristic loci) the first to reach −1 counts.
    """
    curves = np.reshape(loops, (len(omega), -1)).T
    factors = [limit for curve in curves for limit in _factors(omega, curve)]
    lags = [limit for curve in curves for limit in _lags(omega, curve)]
    # a lead of φ is a lag of 2π − φ
    phases = [Limit(min(lag.value, 2 * math.pi - lag.value), lag.omega) for lag in lags]
    return Crossings(
        up=min((f for f in factors if f.value > 1), key=_value, default=None),
        down=max((f for f in factors if f.value < 1), key=_value, default=None),
        phase=min(phases, key=_value, default=None),
        delay=min((Limit(g.value / g.omega, g.omega) for g in lags), key=_value, default=None),
        crossover=max((lag.omega for lag in lags), default=0.0),
    )


def _value(limit: Limit) -> float:
    return limit.value


def _factors(omega: FloatArray, curve: ComplexArray) -> list[Limit]:
    """Factors that bring the curve to −1."""
    before, after = curve[:-1], curve[1:]
    k = np.flatnonzero((np.sign(before.imag) != np.sign(after.imag)) & (before.real < 0))
    share = before.imag[k] / (before.imag[k] - after.imag[k])
    real = before.real[k] + share * (after.real[k] - before.real[k])
    at = omega[k] + share * (omega[k + 1] - omega[k])
    found = [Limit(-1 / r, w) for r, w in zip(real.tolist(), at.tolist(), strict=True) if r < 0]
    # the curve of a sampled loop ends on the real axis, at half the rate
    end = complex(curve[-1])
    if end.real < 0 and abs(end.imag) < 1e-3 * abs(end.real):
        found.append(Limit(-1 / end.real, float(omega[-1])))
    return found


def _lags(omega: FloatArray, curve: ComplexArray) -> list[Limit]:
    """Phases in (0, 2π) that, lost, bring the curve to −1."""
    size = np.log(np.abs(curve))
    k = np.flatnonzero(np.sign(size[:-1]) != np.sign(size[1:]))
    share = size[k] / (size[k] - size[k + 1])
    direction = curve / np.abs(curve)
    there = direction[k] + share * (direction[k + 1] - direction[k])
    at = omega[k] + share * (omega[k + 1] - omega[k])
    lag = np.angle(-there) % (2 * math.pi)
    return [Limit(a, w) for a, w in zip(lag.tolist(), at.tolist(), strict=True)]
