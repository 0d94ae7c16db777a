"""Ridge regression judged on blocks that it was not fitted to, for many targets at once.

For blocks the leave-one-out formula of linear smoothers holds as it does for samples (Cook &
Weisberg 1982, ch. 3.6): with the hat matrix ``H = Φ(ΦᵀΦ + λ)⁻¹Φᵀ`` and the residuals ``r`` of the
fit to everything, the residuals of block ``b`` when it was left out are ``(I − H_bb)⁻¹ r_b``.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from trms_cli.gap.force.record import FloatArray, IntArray

#: Ridge penalties, relative to the number of samples; features have unit variance.
PENALTIES = (1e-3, 1e-2, 1e-1)


def held_out_errors(
    features: FloatArray,
    targets: FloatArray,
    block: IntArray,
    penalties: tuple[float, ...] = PENALTIES,
) -> FloatArray:
    """Squared errors by block of the ridge regression that does best over all blocks.

    Parameters
    ----------
    features : (k, p) array
    targets : (k, t) array
        Each with the penalty that suits it best.
    block : (k,) array of int
        Rising numbers; each block is left out once.
    penalties : tuple of float
        To choose from.

    Returns
    -------
    (n_blocks, t) array
        About the mean of the target over everything.
    """
    spread = features.std(axis=0)
    kept = spread > 1e-9
    phi = (features[:, kept] - features[:, kept].mean(axis=0)) / spread[kept]
    y = targets - targets.mean(axis=0)
    edges = [*np.flatnonzero(np.diff(block, prepend=-1)).tolist(), block.size]
    power, directions = np.linalg.eigh(phi.T @ phi)
    turned = phi @ directions
    inner = turned.T @ y
    best = np.empty((0, 0))
    for penalty in penalties:
        weight = 1.0 / (np.maximum(power, 0.0) + penalty * block.size)
        residual = y - turned @ (weight[:, None] * inner)
        errors = np.empty((len(edges) - 1, y.shape[1]))
        for b, (first, end) in enumerate(pairwise(edges)):
            rows = turned[first:end]
            own = np.eye(end - first) - (rows * weight) @ rows.T
            errors[b] = np.sum(np.linalg.solve(own, residual[first:end]) ** 2, axis=0)
        if best.size:
            best = np.where(errors.sum(axis=0) < best.sum(axis=0), errors, best)
        else:
            best = errors
    return best
