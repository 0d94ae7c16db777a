"""One Gauss–Newton step of windows with starts of their own, the starts eliminated exactly.

With δx_j the change of window j's start and δθ that of the parameters, the linearised residuals
are ``r_j + A_j δx_j + B_j δθ``. A QR factorisation of each window's ``[A_j B_j r_j]`` leaves a
small triangle that holds all of the cost, the gradient and the curvature; a second one of the
triangle with the start's prior and damping under it splits

    [R_x  R_xθ  c_x]      δx_j = −R_x⁻¹ (c_x + R_xθ δθ)
    [ 0   R_θ   c_θ]      which δθ is left with

so that m windows of n states cost m small factorisations, and never a matrix of m·n columns.
Where windows are joined (each start near the end of the window before), the same elimination runs
along the chain, as in a square-root information filter (Bierman 1977).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Entries of a matrix that is factorised in one piece.
_ENTRIES_AT_ONCE = 8000


class Joint(NamedTuple):
    """Rows that join the end of each window to the start of the next, scaled and weighted."""

    follows: npt.NDArray[np.bool_]  #: (m,) array of bool; whether window j continues window j − 1
    #: (m, n, n + n_f) array; slopes of row block j in the start of window j − 1 and the parameters
    from_before: FloatArray
    weight: FloatArray  #: (n,) array; minus the slope in the start of window j
    gap: FloatArray  #: (m, n) array; end of window j − 1 less start of window j, weighted


class Quadratic(NamedTuple):
    """The cost as a parabola in changes of starts and parameters, all in scaled units."""

    triangles: FloatArray  #: (m, k, n + n_f + 1) array; of each window's data
    #: (m, n) array; start less the centre of its prior, in prior standard deviations; slope 1
    start_gap: FloatArray
    #: (n_f,) array; square root of the precision of each parameter's prior, scaled
    prior_root: FloatArray
    prior_gap: FloatArray  #: (n_f,) array; ``prior_root·(θ − centre)``
    joint: Joint | None

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.start_gap.shape[1])

    def cost(self, dx: FloatArray, dtheta: FloatArray) -> float:
        """Its value after a change, dx (m, n) and dtheta (n_f,)."""
        move = np.hstack([dx, np.broadcast_to(dtheta, (len(dx), len(dtheta)))])
        rows = np.einsum("mkc,mc->mk", self.triangles[..., :-1], move) + self.triangles[..., -1]
        total = np.sum(rows**2) + np.sum((self.start_gap + dx) ** 2)
        total += np.sum((self.prior_gap + self.prior_root * dtheta) ** 2)
        if self.joint is not None:
            total += np.sum(_gaps(self.joint, dx, dtheta) ** 2)
        return 0.5 * float(total)


class Reduced(NamedTuple):
    """What is left when the starts are gone, and how they come back."""

    #: (k, n_f) array; of the data, the starts' priors and the damping of the starts; ``factorᵀ
    #: factor`` is the curvature of the cost in the parameters without their own priors
    factor: FloatArray
    residual: FloatArray  #: (k,) array
    to_starts: FloatArray  #: (m, n, n_f) array; slope of each eliminated start in the parameters
    at_zero: FloatArray  #: (m, n) array; change of the starts when the parameters do not move

    def starts(self, dtheta: FloatArray) -> FloatArray:
        """Change of the starts (m, n) that belongs to a change of the parameters."""
        change: FloatArray = self.at_zero + self.to_starts @ dtheta
        return change


def triangles(a_b: FloatArray, r: FloatArray) -> FloatArray:
    """Triangular factors of each window's ``[A B r]``.

    Parameters
    ----------
    a_b : (m, rows, n + n_f) array
    r : (m, rows) array
    """
    rows = np.concatenate([a_b, r[..., None]], axis=2)
    m, _, columns = rows.shape
    block = max(2 * columns, _ENTRIES_AT_ONCE // columns)
    # A tall matrix in blocks, their triangles stacked, in blocks again (TSQR, Demmel et al. 2012,
    # SIAM J. Sci. Comput. 34): it stays in the cache, and below the size from which a BLAS starts
    # threads, which on a busy machine wait for each other twenty times as long as they work.
    while rows.shape[1] > block:
        missing = -rows.shape[1] % block
        rows = np.concatenate([rows, np.zeros((m, missing, columns))], axis=1)
        small = _triangle(rows.reshape(-1, block, columns))
        rows = small.reshape(m, -1, columns)
    return _triangle(rows)


def reduced(quadratic: Quadratic, damping: float) -> Reduced:
    """Eliminate the starts.

    Parameters
    ----------
    damping : float
        λ of Levenberg and Marquardt, in the scaled units; it acts on the starts here, and on the
        parameters where the step is made.
    """
    m, n = quadratic.start_gap.shape
    columns = quadratic.triangles.shape[2]
    own = np.zeros((m, n, columns))
    own[:, :, :n] = np.eye(n)
    own[:, :, -1] = quadratic.start_gap
    rows = [quadratic.triangles, own]
    if damping > 0:
        held = np.zeros((m, n, columns))
        held[:, :, :n] = np.sqrt(damping) * np.eye(n)
        rows.append(held)
    stacked = np.concatenate(rows, axis=1)
    if quadratic.joint is not None:
        return _along_chains(quadratic.joint, stacked, n)
    whole = _triangle(stacked)
    left = whole[:, n:, n:].reshape(-1, columns - n)
    back = _solved(whole[:, :n, :n], whole[:, :n, n:])
    return Reduced(*_compact(left), back[..., :-1], back[..., -1])


def _along_chains(joint: Joint, stacked: FloatArray, n: int) -> Reduced:
    m, _, columns = stacked.shape
    n_f = columns - n - 1
    left, carried = [], np.zeros((0, columns))
    pivots: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for j in range(m):
        last = j + 1 == m or not joint.follows[j + 1]
        here = np.vstack([carried, stacked[j]])
        # columns: this start, the next, parameters, residual
        wide = np.insert(here, [n] * n, 0.0, axis=1)
        if not last:
            row = np.zeros((n, columns + n))
            row[:, :n] = joint.from_before[j + 1][:, :n]
            row[:, n : 2 * n] = -np.diag(joint.weight)
            row[:, 2 * n : -1] = joint.from_before[j + 1][:, n:]
            row[:, -1] = joint.gap[j + 1]
            # The heaviest rows first: the factorisation stays accurate for near-equalities.
            wide = np.vstack([row, wide])
        whole = _triangle(wide)
        solved = _solved(whole[:n, :n], whole[:n, n:])
        pivots.append((solved[:, :n], solved[:, n:-1], solved[:, -1]))
        rest = whole[n:, n:]
        if last:
            left.append(rest[:, n:])
            carried = np.zeros((0, columns))
        else:
            carried = rest
    to_starts, at_zero = np.zeros((m, n, n_f)), np.zeros((m, n))
    for j in reversed(range(m)):
        in_next, in_theta, constant = pivots[j]
        to_starts[j], at_zero[j] = in_theta, constant
        if j + 1 < m and joint.follows[j + 1]:
            to_starts[j] += in_next @ to_starts[j + 1]
            at_zero[j] += in_next @ at_zero[j + 1]
    return Reduced(*_compact(np.vstack(left)), to_starts, at_zero)


def _triangle(rows: FloatArray) -> FloatArray:
    """R of one QR factorisation, of each matrix in a stack."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _solved(a: FloatArray, b: FloatArray) -> FloatArray:
    """``−a⁻¹ b``, of each matrix in a stack."""
    return -np.asarray(np.linalg.solve(a, b), dtype=np.float64)


def _compact(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same parabola in few rows: slopes and constants."""
    if len(rows) > rows.shape[1]:
        rows = triangles(rows[None, :, :-1], rows[None, :, -1])[0]
    return rows[:, :-1], rows[:, -1]


def _gaps(joint: Joint, dx: FloatArray, dtheta: FloatArray) -> FloatArray:
    """Weighted gaps at the joints after a change, (number of joints, n)."""
    j = np.flatnonzero(joint.follows)
    n = dx.shape[1]
    gaps: FloatArray = (
        joint.gap[j]
        + np.einsum("jnk,jk->jn", joint.from_before[j][..., :n], dx[j - 1])
        + joint.from_before[j][..., n:] @ dtheta
        - joint.weight * dx[j]
    )
    return gaps
