"""Many tests at once: p-values that hold for the whole family.

Sources: S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6,
1979; Y. Benjamini, Y. Hochberg, "Controlling the false discovery rate", J. R. Statist. Soc. B 57,
1995.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def holm(p_values: Sequence[float] | FloatArray) -> FloatArray:
    """Adjusted p-values: rejecting those at most α errs once or more with probability at most α.

    Parameters
    ----------
    p_values : (m,) array
        NaN for a test that could not be made; it stays NaN and does not count.

    Returns
    -------
    (m,) array
        ``max over j ≤ i of min(1, (m − j + 1) p_(j))`` in the order of rising p.
    """
    return _adjusted(p_values, lambda rank, m: m - rank, np.maximum.accumulate)


def benjamini_hochberg(p_values: Sequence[float] | FloatArray) -> FloatArray:
    """Adjusted p-values: among those at most α, a share of at most α is false on average.

    Parameters
    ----------
    p_values : (m,) array
        NaN for a test that could not be made.

    Returns
    -------
    (m,) array
        ``min over j ≥ i of (m / j) p_(j)`` in the order of rising p.
    """
    return _adjusted(
        p_values,
        lambda rank, m: m / (rank + 1.0),
        lambda scaled: np.minimum.accumulate(scaled[::-1])[::-1],
    )


def _adjusted(
    p_values: Sequence[float] | FloatArray,
    factor: Callable[[FloatArray, int], FloatArray],
    cumulate: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    p = np.asarray(p_values, dtype=float)
    adjusted = np.full(p.shape, np.nan)
    present = np.flatnonzero(~np.isnan(p))
    if present.size == 0:
        return adjusted
    order = present[np.argsort(p[present], kind="stable")]
    m = len(order)
    adjusted[order] = np.minimum(1.0, cumulate(factor(np.arange(m, dtype=float), m) * p[order]))
    return adjusted
