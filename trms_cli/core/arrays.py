"""Types of arrays, for annotations, and the weights of a sum over an interval."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
#: Whole numbers, of 64 bits.
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def gauss_legendre(nodes: int) -> tuple[list[float], list[float]]:
    """Places and weights of a Gauss–Legendre sum over [0, 1]."""
    places, weights = np.polynomial.legendre.leggauss(nodes)
    return ((places + 1.0) / 2.0).tolist(), (weights / 2.0).tolist()
