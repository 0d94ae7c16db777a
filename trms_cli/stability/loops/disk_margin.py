"""Disk margins: how much gain and phase may change at once.

A loop's actuator is changed by a factor f from the disk

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
on the safe side, is used.

Source: Seiler, Packard & Gahinet, "An introduction to disk margins", IEEE Control Systems Magazine
40(5), 2020, the balanced case (skew 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


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
