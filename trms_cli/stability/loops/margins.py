"""Margins of a measured loop: of each command alone, and of all of them at once.

The loop is known to be stable: it was measured closed. Along a change of the loop that grows from
nothing, it stays so until the changed Nyquist curve first runs through −1. For a factor g that is a
crossing of the negative real axis at −1/g; for a phase or a delay, a crossing of the unit circle.

Disk margins tell how much gain and phase may change at once. A loop's actuator is changed by a
factor f from the disk

    D(α) = { (1 + δ/2) / (1 − δ/2) : |δ| < α }

which holds all gains in ((2 − α)/(2 + α), (2 + α)/(2 − α)), all phases within ±2 arctan(α/2), and
their combinations. With S the sensitivity and T = I − S, the loop stands all such factors, also
if they vary with frequency, up to

    α = min_ω 2/|S − T|                of one loop, the others closed
    α = min_ω 2/μ_Δ(S − T)             of all loops at once, each with a factor of its own
    α = min_ω 2/σ̄(S − T)               of any linear change of all commands, coupling included

μ is the structured singular value for diagonal complex Δ. For two loops it is exact here: the
upper bound ``min_D σ̄(D M D⁻¹)`` equals μ up to three blocks, and the best scaling of a 2 × 2
matrix is the one that makes its off-diagonal entries equal. Beyond two loops the norm σ̄, a bound
on the safe side, is used (Seiler, Packard & Gahinet, "An introduction to disk margins", IEEE
Control Systems Magazine 40(5), 2020, the balanced case, skew 0).

Between the lines the sensitivity S is interpolated, not L: the closed loop has no sharp peaks
where the rig's lightly damped modes and the controller's integrators have theirs. How far that
carries is judged by leaving out every other line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter

import numpy as np

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.stability.loops.frequency_response import FrequencyResponse


@dataclass(frozen=True)
class StabilityLimit:
    """The first change that makes a loop unstable."""

    value: float  #: A factor, rad or s
    omega: float  #: rad/s at which the loop then swings


@dataclass(frozen=True)
class ClassicalMargins:
    """Limits of a loop; None where no such change makes the measured curve run into −1."""

    up: StabilityLimit | None  #: Factor of the loop's gain, above and below 1
    down: StabilityLimit | None  #: Factor of the loop's gain, above and below 1
    phase: StabilityLimit | None  #: Least phase lost or gained at a unit gain, rad
    delay: StabilityLimit | None  #: s
    crossover: float  #: Highest frequency at which the gain is 1, rad/s; 0 if it never is


def classical_margins(omega: FloatArray, loops: ComplexArray) -> ClassicalMargins:
    """The limits of a loop (n,), or of several (n, m) that change together; ω is dense.

    Of several (the characteristic loci) the first to reach −1 counts.
    """
    curves = np.reshape(loops, (len(omega), -1)).T
    factors = [limit for curve in curves for limit in _factors(omega, curve)]
    lags = [limit for curve in curves for limit in _lags(omega, curve)]
    # a lead of φ is a lag of 2π − φ
    phases = [StabilityLimit(min(lag.value, 2 * math.pi - lag.value), lag.omega) for lag in lags]
    delays = [StabilityLimit(lag.value / lag.omega, lag.omega) for lag in lags]
    value = attrgetter("value")
    return ClassicalMargins(
        up=min((f for f in factors if f.value > 1), key=value, default=None),
        down=max((f for f in factors if f.value < 1), key=value, default=None),
        phase=min(phases, key=value, default=None),
        delay=min(delays, key=value, default=None),
        crossover=max((lag.omega for lag in lags), default=0.0),
    )


def _factors(omega: FloatArray, curve: ComplexArray) -> list[StabilityLimit]:
    """Factors that bring the curve to −1."""
    before, after = curve[:-1], curve[1:]
    k = np.flatnonzero((np.sign(before.imag) != np.sign(after.imag)) & (before.real < 0))
    share = before.imag[k] / (before.imag[k] - after.imag[k])
    real = before.real[k] + share * (after.real[k] - before.real[k])
    at = omega[k] + share * (omega[k + 1] - omega[k])
    limits = [
        StabilityLimit(-1 / r, w) for r, w in zip(real.tolist(), at.tolist(), strict=True) if r < 0
    ]
    # the curve of a sampled loop ends on the real axis, at half the rate
    end = complex(curve[-1])
    if end.real < 0 and abs(end.imag) < 1e-3 * abs(end.real):
        limits.append(StabilityLimit(-1 / end.real, float(omega[-1])))
    return limits


def _lags(omega: FloatArray, curve: ComplexArray) -> list[StabilityLimit]:
    """Phases in (0, 2π) that, lost, bring the curve to −1."""
    size = np.log(np.abs(curve))
    k = np.flatnonzero(np.sign(size[:-1]) != np.sign(size[1:]))
    share = size[k] / (size[k] - size[k + 1])
    direction = curve / np.abs(curve)
    there = direction[k] + share * (direction[k + 1] - direction[k])
    at = omega[k] + share * (omega[k + 1] - omega[k])
    lag = np.angle(-there) % (2 * math.pi)
    return [StabilityLimit(a, w) for a, w in zip(lag.tolist(), at.tolist(), strict=True)]


@dataclass(frozen=True)
class DiskMargin:
    """The largest disk."""

    alpha: float  #: Its size
    omega: float  #: Where it is reached, rad/s

    @property
    def gain_up(self) -> float:
        """Factor; infinite from α = 2 on."""
        return (2 + self.alpha) / (2 - self.alpha) if self.alpha < 2 else math.inf

    @property
    def gain_down(self) -> float:
        """Factor; 0 from α = 2 on."""
        return max(0.0, (2 - self.alpha) / (2 + self.alpha))

    @property
    def phase(self) -> float:
        """rad."""
        return 2 * math.atan(self.alpha / 2)


def disk_margin(omega: FloatArray, size: FloatArray) -> DiskMargin:
    """From a norm of S − T at each frequency, (n,)."""
    worst = int(np.argmax(size))
    return DiskMargin(2.0 / float(size[worst]), float(omega[worst]))


def diagonal_mu(M: ComplexArray) -> FloatArray:
    """μ of matrices (n, m, m) for a diagonal complex Δ, (n,); an upper bound for m > 2."""
    if M.shape[1] != 2:
        return largest_singular_value(M)
    size = np.abs(M)
    frobenius = size[:, 0, 0] ** 2 + size[:, 1, 1] ** 2 + 2 * size[:, 0, 1] * size[:, 1, 0]
    determinant = np.abs(np.linalg.det(M))
    # the square root's argument is (σ̄² − σ̲²)², negative by rounding only
    apart = np.sqrt(np.maximum(frobenius**2 - 4 * determinant**2, 0.0))
    return np.asarray(np.sqrt((frobenius + apart) / 2))


def largest_singular_value(M: ComplexArray) -> FloatArray:
    """σ̄ of matrices (n, m, m), (n,)."""
    return np.asarray(np.linalg.svd(M, compute_uv=False)[:, 0])


#: Frequencies between the lowest and the highest line at which margins are sought.
_DENSE = 4000


@dataclass(frozen=True)
class Peak:
    """The largest value of a norm."""

    value: float
    omega: float  #: rad/s


@dataclass(frozen=True)
class LoopMargins:
    """One loop, opened at its command while the others stay closed: ``L_i = 1/S_ii − 1``."""

    name: str  #: The input
    margins: ClassicalMargins
    #: max |S_ii|; its inverse is the distance of the Nyquist curve to −1, the modulus margin
    sensitivity: Peak
    complementary: Peak  #: max |T_ii|
    disk: DiskMargin


@dataclass(frozen=True)
class MarginResult:
    """All margins of a measured response."""

    response: FrequencyResponse

    @cached_property
    def omega(self) -> FloatArray:
        """Frequencies, rad/s, (n,)."""
        first, last = self.response.omega[[0, -1]]
        dense = np.geomspace(first, last, _DENSE)
        dense[[0, -1]] = first, last
        return dense

    @cached_property
    def S(self) -> ComplexArray:
        """Sensitivity at :attr:`omega`, (n, n_u, n_u)."""
        return interpolated(self.response.omega, self.response.S, self.omega)

    @cached_property
    def T(self) -> ComplexArray:
        """Complementary sensitivity, (n, n_u, n_u)."""
        return np.asarray(np.eye(self.S.shape[1]) - self.S)

    @cached_property
    def L(self) -> ComplexArray:
        """Loop transfer ``S⁻¹ − I``, (n, n_u, n_u)."""
        return np.asarray(np.linalg.inv(self.S) - np.eye(self.S.shape[1]))

    @cached_property
    def single(self) -> ComplexArray:
        """Loops opened one at a time, (n, n_u)."""
        return np.asarray(1 / np.diagonal(self.S, axis1=1, axis2=2) - 1)

    @cached_property
    def loops(self) -> tuple[LoopMargins, ...]:
        """Each loop's own."""
        w, loops = self.omega, []
        for i, name in enumerate(self.response.inputs):
            S, T = self.S[:, i, i], self.T[:, i, i]
            peaks, disk = (peak(w, np.abs(S)), peak(w, np.abs(T))), disk_margin(w, np.abs(S - T))
            loops.append(LoopMargins(name, classical_margins(w, self.single[:, i]), *peaks, disk))
        return tuple(loops)

    @cached_property
    def together(self) -> ClassicalMargins:
        """One factor or delay on all commands: by the characteristic loci, eigenvalues of L."""
        return classical_margins(
            self.omega, continuous(np.asarray(np.linalg.eigvals(self.L), dtype=np.complex128))
        )

    @cached_property
    def disk_each(self) -> DiskMargin:
        """All commands at once, each by a factor of its own."""
        return disk_margin(self.omega, diagonal_mu(self.S - self.T))

    @cached_property
    def disk_any(self) -> DiskMargin:
        """Any linear change of the commands, coupling included."""
        return disk_margin(self.omega, largest_singular_value(self.S - self.T))

    @cached_property
    def sensitivity(self) -> Peak:
        """max σ̄(S), the inverse of min σ̲(I + L)."""
        return peak(self.omega, largest_singular_value(self.S))

    @cached_property
    def complementary(self) -> Peak:
        """max σ̄(T)."""
        return peak(self.omega, largest_singular_value(self.T))

    @cached_property
    def interpolation(self) -> float:
        """Largest miss at a line of the interpolation through every other line.

        An upper bound of what is missed between the lines: they are twice as dense.
        """
        omega, S = self.response.omega, self.response.S
        kept = np.union1d(np.arange(0, omega.size, 2), [omega.size - 1])
        guess = interpolated(omega[kept], S[kept], omega)
        return float(largest_singular_value(guess - S).max())


def interpolated(omega: FloatArray, values: ComplexArray, wanted: FloatArray) -> ComplexArray:
    """Cubic splines over the logarithm of the frequency, along the first axis."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(np.log(omega), values, axis=0)(np.log(wanted)))


def continuous(loci: ComplexArray) -> ComplexArray:
    """Eigenvalues (n, m) in the order in which each follows its predecessor."""
    from scipy.optimize import linear_sum_assignment

    ordered = loci.copy()
    for k in range(1, len(loci)):
        apart = np.abs(ordered[k - 1][:, None] - loci[k][None, :])
        ordered[k] = loci[k][linear_sum_assignment(apart)[1]]
    return ordered


def peak(omega: FloatArray, size: FloatArray) -> Peak:
    """The largest of (n,) values."""
    at = int(np.argmax(size))
    return Peak(float(size[at]), float(omega[at]))
