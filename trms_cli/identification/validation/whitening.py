"""An autoregression takes out of a residual what its own past explains.

A quantised angle, or an observer that is told the wrong noise, leaves residuals that are correlated
in time although the model of the rig is right. That is one finding, and one test makes it. The
other tests ask for what the *input* explains, and would all repeat it: they look at what an
autoregression leaves.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Keeps a residual that repeats itself exactly from making the equations singular.
_RIDGE = 1e-13


def whitened(residual: FloatArray, highest_order: int = 20) -> tuple[FloatArray, int]:
    """The innovations of an autoregression fitted to a residual, its order by BIC.

    Parameters
    ----------
    residual : (n,) array
        NaN where missing; its mean stays in the result, scaled by the sum of the coefficients.
    highest_order : int

    Returns
    -------
    (n,) array
        NaN where an earlier sample is missing.
    order : int
        0: the residual is returned as it is.
    """
    n = len(residual)
    highest_order = min(highest_order, n // 20)
    present = ~np.isnan(residual)
    if highest_order < 1 or np.count_nonzero(present) < 40:
        return residual, 0
    centred = residual - residual[present].mean()
    lagged = np.full((n, highest_order + 1), np.nan)
    for k in range(highest_order + 1):
        lagged[k:, k] = centred[: n - k]
    complete = lagged[~np.isnan(lagged).any(axis=1)]
    m = len(complete)
    if m < 10 * highest_order or not np.any(complete[:, 0]):
        return residual, 0
    # One Cholesky factor serves all orders: its k-th row tells what the k-th lag adds. (A QR of the
    # lags themselves costs a hundred times as much on a busy machine.)
    gram = complete.T @ complete
    inner = gram[1:, 1:] + _RIDGE * np.trace(gram) * np.eye(highest_order)
    root = np.linalg.cholesky(inner)
    gains = np.linalg.solve(root, gram[1:, 0])
    errors = gram[0, 0] - np.concatenate([[0.0], np.cumsum(gains**2)])
    errors = np.maximum(errors, 1e-14 * gram[0, 0]) / m
    order = int(np.argmin(m * np.log(errors) + np.arange(highest_order + 1) * np.log(m)))
    if order == 0:
        return residual, 0
    coefficients = np.linalg.solve(root[:order, :order].T, gains[:order])
    raw = np.full((n, order + 1), np.nan)
    for k in range(order + 1):
        raw[k:, k] = residual[: n - k]
    return raw[:, 0] - raw[:, 1:] @ coefficients, order
