"""Margins of a measured loop: of each command alone, and of all of them at once.

Between the lines the sensitivity S is interpolated, not L: the closed loop has no sharp peaks
where the rig's lightly damped modes and the controller's integrators have theirs. How far that
carries is judged by leaving out every other line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from trms_cli.stability.loops.crossings import Crossings, crossings
from trms_cli.stability.loops.disk_margin import (
    DiskMargin,
    diagonal_mu,
    disk_margin,
    largest_singular_value,
)
from trms_cli.stability.loops.frequency_response import Measured

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

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
    crossings: Crossings
    #: max |S_ii|; its inverse is the distance of the Nyquist curve to −1, the modulus margin
    sensitivity: Peak
    complementary: Peak  #: max |T_ii|
    disk: DiskMargin


@dataclass(frozen=True)
class Margins:
    """All margins of a measured response."""

    measured: Measured

    @cached_property
    def omega(self) -> FloatArray:
        """Frequencies, rad/s, (n,)."""
        first, last = self.measured.omega[[0, -1]]
        dense = np.geomspace(first, last, _DENSE)
        dense[[0, -1]] = first, last
        return dense

    @cached_property
    def S(self) -> ComplexArray:
        """Sensitivity at :attr:`omega`, (n, n_u, n_u)."""
        return interpolated(self.measured.omega, self.measured.S, self.omega)

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
        return tuple(self._of(i, name) for i, name in enumerate(self.measured.inputs))

    def _of(self, i: int, name: str) -> LoopMargins:
        S, T = self.S[:, i, i], self.T[:, i, i]
        return LoopMargins(
            name,
            crossings(self.omega, self.single[:, i]),
            peak(self.omega, np.abs(S)),
            peak(self.omega, np.abs(T)),
            disk_margin(self.omega, np.abs(S - T)),
        )

    @cached_property
    def together(self) -> Crossings:
        """One factor or delay on all commands: by the characteristic loci, eigenvalues of L."""
        return crossings(
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
        omega, S = self.measured.omega, self.measured.S
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
