"""Types of arrays, for annotations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
#: Whole numbers, of 64 bits.
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
