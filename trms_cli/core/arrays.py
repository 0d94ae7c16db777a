"""Types of arrays, for annotations; stretches of samples; weights of a sum over an interval."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
#: Whole numbers, of 64 bits.
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def stretches(flags: npt.ArrayLike) -> list[tuple[int, int]]:
    """First index, and the one after the last, of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def hold_last(values: FloatArray) -> FloatArray:
    """Values with the last one held where one is missing; the first stays where it is."""
    latest = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return values[latest]


def gauss_legendre(nodes: int) -> tuple[list[float], list[float]]:
    """Places and weights of a Gauss–Legendre sum over [0, 1]."""
    places, weights = np.polynomial.legendre.leggauss(nodes)
    return ((places + 1.0) / 2.0).tolist(), (weights / 2.0).tolist()
