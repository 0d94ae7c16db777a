"""Eigenvalues followed along a line of operating points.

Two spectra are matched by what their eigenvectors have in common and by how far the eigenvalues
move. For left and right eigenvectors with ``wᵀv = 1`` the product ``(w_iᵀ v'_j)(w'_jᵀ v_i)`` is 1
for the same mode and near 0 for another, whatever the units of the states. The assignment is the
best of all one-to-one ones (Jonker & Volgenant 1987, as in SciPy).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from trms_cli.stability.local.modes import spectrum

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

#: Weight of a move of an eigenvalue by its own size against eigenvectors with nothing in common.
_MOVE = 1.0


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues of one matrix in an order, with eigenvectors."""

    values: ComplexArray  #: (n,) complex array; of the matrix: λ, or z of a model that steps
    #: ``left``, ``right``: (n, n) complex arrays; columns, ``leftᵢᵀ rightᵢ = 1``
    left: ComplexArray
    right: ComplexArray

    def ordered(self, order: npt.NDArray[np.intp]) -> Spectrum:
        """The same in another order."""
        return Spectrum(self.values[order], self.left[:, order], self.right[:, order])

    def participation(self, i: int) -> FloatArray:
        """Shares of the states in mode i."""
        share = np.abs(self.left[:, i] * self.right[:, i])
        shares: FloatArray = share / share.sum()
        return shares


def spectrum_of(a: FloatArray) -> Spectrum:
    """The spectrum of a matrix, in LAPACK's order."""
    return Spectrum(*spectrum(a))


def matched(before: Spectrum, after: Spectrum) -> tuple[Spectrum, float]:
    """``after`` in the order of ``before``, and how sure the worst match is (1: certain).

    Sureness is how much better the match is than the best one that exchanges a mode, where the
    exchange would matter; two modes whose eigenvalues agree may be exchanged.
    """
    same = np.abs(before.left.T @ after.right) * np.abs(after.left.T @ before.right).T
    same = np.minimum(same, 1.0)
    size = 1e-3 + np.abs(before.values)[:, None] + np.abs(after.values)[None, :]
    apart = np.abs(before.values[:, None] - after.values[None, :]) / size
    # A conjugate is never the continuation of its partner while both swing.
    cost = (1.0 - same) + _MOVE * apart
    rows, columns = linear_sum_assignment(cost)
    order = columns[np.argsort(rows)]
    chosen = cost[np.arange(len(order)), order]
    return after.ordered(order), float(1.0 - chosen.max(initial=0.0))
