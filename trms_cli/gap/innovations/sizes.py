"""How large the discrepancies are: their most likely sizes, given what a fit left over."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.gap.innovations.discrepancy import Discrepancy
from trms_cli.gap.innovations.kalman import scores

FloatArray = npt.NDArray[np.float64]

#: Share of what acts on an equation that it may always err by: integration, rounding, jitter.
FLOOR = 0.004
#: No discrepancy is larger than what acts there, several times over.
_MOST = 10.0
_SETTLED = 0.05


def likely_shares(
    discrepancy: Discrepancy,
    r: FloatArray,
    shares: FloatArray,
    *,
    moving: npt.NDArray[np.bool_] | None = None,
    iterations: int = 8,
    least: FloatArray | float = FLOOR,
) -> FloatArray:
    """Most likely sizes of the forces.

    Each iteration multiplies the variances by the ratio of the two parts of the likelihood's
    slope, which are equal where it is greatest.

    Parameters
    ----------
    discrepancy : Discrepancy
    r : (m, c, n_y) array
        Measured less predicted.
    shares : (n_d,) array
        Where to begin.
    moving : (n_d,) array of bool or None
        Those that are to be found; None: all.
    least : (n_d,) array or float
        No size is smaller.
    """
    shares = np.maximum(np.asarray(shares, dtype=float), least)
    n = discrepancy.trajectory.x.shape[-1]
    chosen = ~discrepancy.fixed if moving is None else moving & ~discrepancy.fixed
    for _ in range(iterations):
        try:
            filter_ = discrepancy.filter(shares)
        except FloatingPointError:  # so large that numbers no longer hold it
            return np.maximum(shares / 4, least)
        z = discrepancy.whitened(filter_, r[..., None])[..., 0]
        squares, variances = scores(discrepancy.system, filter_, z)
        ratio = squares[n:] / np.maximum(variances[n:], 1e-300)
        # the size is the root of the variance; half of the rest of the way is taken at a time
        after = np.clip(shares * np.clip(np.sqrt(ratio), 0.3, 4.0), least, _MOST)
        after = np.where(chosen, after, shares)
        settled = np.max(np.abs(np.log(after / shares))) < _SETTLED
        shares = after
        if settled:
            break
    return shares


def log_likelihood(discrepancy: Discrepancy, r: FloatArray, shares: FloatArray) -> FloatArray:
    """Log likelihood of what a fit left over, by window, up to a constant, (m,) nats."""
    filter_ = discrepancy.filter(shares)
    z = discrepancy.whitened(filter_, r[..., None])[..., 0]
    found: FloatArray = -0.5 * (z**2).sum(axis=(1, 2)) - 0.5 * filter_.logdet
    return found
