"""Gramians over a finite time and for ever, of stable and of unstable systems alike.

    W_c(T) = ∫₀ᵀ e^{At} B Bᵀ e^{Aᵀt} dt        W_o(T) = ∫₀ᵀ e^{Aᵀt} Cᵀ C e^{At} dt

Over a finite time they exist whatever the eigenvalues. They are found by doubling,
``W(2t) = W(t) + Φ(t) W(t) Φ(t)ᵀ``, ``Φ(2t) = Φ(t)²``, from a step so short that Van Loan's block
exponential is exact to rounding (Van Loan 1978, IEEE Trans. Autom. Control 23(3)); the block
exponential of the whole time would overflow with armature currents as states. For ever they solve
the Lyapunov equation of a stable A.

The least energy ``∫ |u|² dt`` that moves ``c x`` by d in the time T from rest is ``d²/(c W_c cᵀ)``
(Kailath, Linear Systems, 1980, sec. 9.2).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy.linalg

FloatArray = npt.NDArray[np.float64]

#: What is reached beside the largest is rounding below this.
_ROUNDING = 1e-18
#: Norm of A times the first step.
_SHORT = 0.5


def controllability_gramian(
    a: FloatArray, b: FloatArray, duration: float, sample_time: float | None = None
) -> FloatArray:
    """W_c(T), (n, n).

    Parameters
    ----------
    a, b : (n, n), (n, m) arrays
        Of ẋ = A x + B u, or of a step.
    duration : float
        s.
    sample_time : float or None
        s, of a step; the Gramian is then ``Σ Aᵏ B Bᵀ Aᵏᵀ / T_s``, so that ``d²/W`` is a least
        ``T_s Σ u²`` and energies compare.
    """
    n = len(a)
    if sample_time is not None:
        return _steps(a, b @ b.T / sample_time, max(1, round(duration / sample_time)))
    norm = float(np.abs(a).sum(axis=1).max(initial=0.0))
    doublings = max(0, math.ceil(math.log2(max(norm * duration / _SHORT, 1.0))))
    step = duration / 2**doublings
    block = np.block([[-a, b @ b.T], [np.zeros((n, n)), a.T]]) * step
    exponential = scipy.linalg.expm(block)
    flow = exponential[n:, n:].T
    gramian = _symmetric(flow @ exponential[:n, n:])
    for _ in range(doublings):
        gramian = _symmetric(gramian + flow @ gramian @ flow.T)
        flow = flow @ flow
    return gramian


def observability_gramian(
    a: FloatArray, c: FloatArray, duration: float, sample_time: float | None = None
) -> FloatArray:
    """W_o(T), (n, n): that of controllability of the dual system."""
    return controllability_gramian(a.T, c.T, duration, sample_time)


def stationary_gramian(
    a: FloatArray, b: FloatArray, sample_time: float | None = None
) -> FloatArray | None:
    """W_c(∞) of a stable system; None for any other."""
    values = np.linalg.eigvals(a)
    if sample_time is None:
        if not np.all(values.real < 0):
            return None
        return _symmetric(scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T))
    if not np.all(np.abs(values) < 1):
        return None
    return _symmetric(scipy.linalg.solve_discrete_lyapunov(a, b @ b.T / sample_time))


def hankel_values(controllable: FloatArray, observable: FloatArray) -> FloatArray:
    """Hankel singular values of two Gramians, largest first."""
    values = np.linalg.eigvals(controllable @ observable)
    found: FloatArray = np.sort(np.sqrt(np.maximum(values.real, 0.0)))[::-1]
    return found


def volts_to_move(
    gramian: FloatArray, direction: FloatArray, distance: float, duration: float
) -> float:
    """Root mean square of the least command that moves ``direction x`` by a distance, in its unit.

    Infinite where it does not move, but for rounding.
    """
    reach = float(direction @ gramian @ direction)
    largest = float(np.abs(gramian).max(initial=0.0)) * float(direction @ direction)
    if reach <= _ROUNDING * largest or reach <= 0.0:
        return math.inf
    return abs(distance) / math.sqrt(reach * duration)


def _steps(flow: FloatArray, first: FloatArray, count: int) -> FloatArray:
    """Σ over ``count`` steps, by doubling."""
    total = np.zeros_like(first)
    gramian, power = first, flow
    done = np.eye(len(flow))
    while count:
        if count & 1:
            total = total + done @ gramian @ done.T
            done = done @ power
        gramian = gramian + power @ gramian @ power.T
        power = power @ power
        count >>= 1
    return _symmetric(total)


def _symmetric(matrix: FloatArray) -> FloatArray:
    symmetric: FloatArray = 0.5 * (matrix + matrix.T)
    return symmetric
