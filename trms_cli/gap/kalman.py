"""Time-varying Kalman filters over windows: gains, whitened columns, smoothed states.

    x⁺ = F x + ω,  cov ω = Q          y = H x + ν,  cov ν = diag(r)

Whitening a residual this way is the innovations form of its likelihood (Kailath 1968, IEEE Trans.
Autom. Control 13): the whitened rows are independent with unit variance if the model's errors are
of the kind assumed, and slopes in parameters are whitened by the same linear operation. The loop
over samples is C (``kalman.c``); without a compiler NumPy runs it over all windows at once.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.compilation import compiled_source


@dataclass(frozen=True)
class LinearSystem:
    """A linear system along a trajectory, stacked over windows of equal length m × c samples."""

    f: FloatArray  #: (m, c, n, n) array
    h: FloatArray  #: (m, c, n_y, n) array
    seen: BoolArray  #: (m, c, n_y) array of bool; where an output was measured
    r: FloatArray  #: (n_y,) array; variance of each output's noise
    start: FloatArray  #: (n, n) array; covariance of the state at each window's first sample

    def __post_init__(self) -> None:
        for name in ("f", "h", "r", "start"):  # the compiled loop reads them as they lie
            object.__setattr__(self, name, _c(getattr(self, name)))


class FilterGains(NamedTuple):
    """A filter that is ready to run."""

    k: FloatArray  #: (m, c, n, n_y) array
    #: (m, c, n_y, n_y) array; inverse of the lower Cholesky factor of the innovations' covariance
    root: FloatArray
    logdet: FloatArray  #: (m,) array; of the innovations' covariances of each window
    p: FloatArray | None  #: (m, c, n, n) array or None; covariance of each prediction


def gains(system: LinearSystem, q: FloatArray, *, covariances: bool = False) -> FilterGains:
    """Riccati's recursion.

    ``q``, (n, n) array. ``covariances``: whether those of the predictions are wanted. Raises
    FloatingPointError if a covariance is no longer positive.
    """
    m, c, n_y, n = system.h.shape
    k, root, logdet = np.empty((m, c, n, n_y)), np.empty((m, c, n_y, n_y)), np.empty(m)
    p = np.empty((m, c, n, n)) if covariances else None
    library = _library()
    if library is None:
        return _gains_of_arrays(system, q, p)
    arrays = (system.r, _c(q), system.start, k, root, logdet, p)
    if _run(library.trms_gains, system, arrays):
        raise FloatingPointError("a covariance of the filter is not positive")
    return FilterGains(k, root, logdet, p)


def whiten(system: LinearSystem, filter_: FilterGains, columns: FloatArray) -> FloatArray:
    """Innovations of columns, over their standard deviation.

    ``columns``, (m, c, n_y, k) array. Returns (m, c, n_y, k) array: zero where nothing was
    measured.
    """
    columns = _c(columns)
    out = np.empty_like(columns)
    library = _library()
    if library is None:
        return _whitened_arrays(system, filter_, columns)
    _run(library.trms_whiten, system, (filter_.k, filter_.root, columns, out), columns.shape[-1])
    return out


def scores(
    system: LinearSystem, filter_: FilterGains, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What the likelihood's slope in the size of each state's disturbance is made of.

    ``∂ log p/∂ log q_i = ½ q_i (squares_i − variances_i)`` (Koopman & Shephard 1992): at the most
    likely sizes the two are equal.

    ``z``, (m, c, n_y) array: whitened innovations. Returns ``squares, variances``, (n,) arrays.
    """
    n = system.h.shape[-1]
    e = np.asarray(np.linalg.solve(filter_.root, z[..., None])[..., 0], dtype=np.float64)
    library = _library()
    if library is None:
        return _scores_of_arrays(system, filter_, e)
    squares, variances = np.empty(n), np.empty(n)
    _run(library.trms_scores, system, (filter_.k, filter_.root, _c(e), squares, variances))
    return squares, variances


def _scores_of_arrays(
    system: LinearSystem, filter_: FilterGains, e: FloatArray
) -> tuple[FloatArray, FloatArray]:
    n = system.h.shape[-1]
    squares, variances = np.zeros(n), np.zeros(n)
    for t, back, spread in _backward(system, filter_, e):
        if t > 0:
            squares += (back**2).sum(axis=0)
            variances += np.einsum("mii->i", spread)
    return squares, variances


def _backward(
    system: LinearSystem, filter_: FilterGains, e: FloatArray
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """From the last sample to the first: what all later innovations say of the state, (m, n).

    With it its precision, (m, n, n). ``e``, (m, c, n_y) array: innovations.
    """
    m, c, _, n = system.h.shape
    h = system.h * system.seen[..., None]
    precision = np.swapaxes(filter_.root, -1, -2) @ filter_.root
    back, spread = np.zeros((m, n)), np.zeros((m, n, n))
    for t in range(c - 1, -1, -1):
        turned = np.swapaxes(h[:, t], 1, 2)
        carry = system.f[:, t] @ (np.eye(n) - filter_.k[:, t] @ h[:, t])
        over = np.swapaxes(carry, 1, 2)
        back = _times(turned, _times(precision[:, t], e[:, t])) + _times(over, back)
        spread = turned @ precision[:, t] @ h[:, t] + over @ spread @ carry
        yield t, back, spread


def smooth(
    system: LinearSystem, filter_: FilterGains, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States given all of a window, by the backward recursion of Durbin and Koopman.

    (Time Series Analysis by State Space Methods, 2nd ed., section 4.4.)

    ``filter_``: with covariances. ``r``, (m, c, n_y) array: what is observed of the linear system.
    Returns ``x``, (m, c, n) array; ``variance``, (m, c, n) array: diagonal of the smoothed
    covariance.
    """
    assert filter_.p is not None
    m, c, _, n = system.h.shape
    h = system.h * system.seen[..., None]
    x, predicted = np.zeros((m, n)), np.empty((m, c, n))
    e = np.empty((m, c, h.shape[2]))
    for t in range(c):
        predicted[:, t] = x
        e[:, t] = np.where(system.seen[:, t], r[:, t], 0.0) - _times(h[:, t], x)
        x = _times(system.f[:, t], x + _times(filter_.k[:, t], e[:, t]))
    smoothed, variance = np.empty((m, c, n)), np.empty((m, c, n))
    for t, back, spread in _backward(system, filter_, e):
        p = filter_.p[:, t]
        smoothed[:, t] = predicted[:, t] + _times(p, back)
        variance[:, t] = np.einsum("mii->mi", p) - np.einsum("mij,mjk,mki->mi", p, spread, p)
    return smoothed, np.maximum(variance, 0.0)


def _gains_of_arrays(system: LinearSystem, q: FloatArray, p_out: FloatArray | None) -> FilterGains:
    m, c, n_y, n = system.h.shape
    k, root, logdet = np.empty((m, c, n, n_y)), np.empty((m, c, n_y, n_y)), np.zeros(m)
    p = np.broadcast_to(system.start, (m, n, n))
    for t in range(c):
        if p_out is not None:
            p_out[:, t] = p
        seen = system.seen[:, t]
        h = system.h[:, t] * seen[..., None]
        crossed = p @ np.swapaxes(h, 1, 2)
        noise = np.where(seen, system.r, 1.0)
        s = h @ crossed + noise[:, None] * np.eye(n_y)
        try:
            lower = np.linalg.cholesky(s)
        except np.linalg.LinAlgError:
            raise FloatingPointError("a covariance of the filter is not positive") from None
        root[:, t] = np.linalg.inv(lower)
        diagonal = np.einsum("mii->mi", lower)
        logdet += 2 * np.where(seen, np.log(diagonal), 0.0).sum(axis=1)
        w = crossed @ np.swapaxes(root[:, t], 1, 2)
        k[:, t] = w @ root[:, t]
        left = p - w @ np.swapaxes(w, 1, 2)
        p = system.f[:, t] @ left @ np.swapaxes(system.f[:, t], 1, 2) + q
    return FilterGains(k, root, logdet, p_out)


def _whitened_arrays(system: LinearSystem, filter_: FilterGains, columns: FloatArray) -> FloatArray:
    m, c, _, count = columns.shape
    out = np.empty_like(columns)
    x = np.zeros((m, system.f.shape[-1], count))
    for t in range(c):
        seen = system.seen[:, t][..., None]
        e = np.where(seen, columns[:, t] - system.h[:, t] @ x, 0.0)
        out[:, t] = np.where(seen, filter_.root[:, t] @ e, 0.0)
        x = system.f[:, t] @ (x + filter_.k[:, t] @ e)
    return out


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    product: FloatArray = np.einsum("mij,mj->mi", matrix, vector)
    return product


def _library() -> ctypes.CDLL | None:
    source = Path(__file__).with_name("kalman.c").read_text(encoding="utf-8")
    return compiled_source("trms_kalman", source)


def _run(function: Any, system: LinearSystem, arrays: Sequence[Any], *sizes: int) -> Any:
    """Call a compiled loop over all windows: sizes, the system's matrices, then other arrays."""
    m, c, n_y, n = system.h.shape
    counts = np.full(m, c, dtype=np.int64)
    seen = np.ascontiguousarray(system.seen, dtype=np.uint8)
    pointers = [  # each keeps its array alive
        None if array is None else array.ctypes.data_as(ctypes.c_void_p)
        for array in (counts, system.f, system.h, seen, *arrays)
    ]
    return function(ctypes.c_longlong(m), pointers[0], n, n_y, *sizes, *pointers[1:])


def _c(array: FloatArray) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64)
