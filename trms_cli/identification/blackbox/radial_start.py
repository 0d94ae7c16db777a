"""Where radial units stand before their widths and centres are trained.

Three ways to choose centres and widths from data:

- k-means (``scipy.cluster.vq``): centres of clusters, the width of each the distance to its
  nearest neighbours (Moody & Darken 1989, Neural Computation 1).
- orthogonal least squares (Chen, Cowan & Grant 1991, IEEE Trans. Neural Networks 2(2)): of many
  candidates, one after another, the one that explains most of what is left of the targets.
- a dyadic grid (Zhang & Benveniste 1992; Zhang 1997): wavelets on grids that halve their spacing
  from level to level, those that data fall into; then selected as above.

The linear weights follow from linear least squares.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from trms_cli.identification.blackbox.radial import Radial
from trms_cli.identification.blackbox.trainable import FloatArray

#: Neighbours whose mean distance is a cluster's width.
_NEIGHBOURS = 3
#: Cells around a sample of a grid of many dimensions: only the nearest is taken beyond this.
_MOST_CORNERS = 4


def clustered(
    z: FloatArray, units: int, width: float, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Centres (n_c, m) of k-means clusters and their widths (n_c,), ``width`` times the spacing."""
    from scipy.cluster.vq import kmeans2

    centres, _ = kmeans2(z, units, minit="++", seed=generator, missing="warn")
    distances = np.sqrt(((centres[:, None, :] - centres[None, :, :]) ** 2).sum(axis=2))
    neighbours = np.sort(distances, axis=1)[:, 1 : 1 + min(_NEIGHBOURS, units - 1)]
    spacing = neighbours.mean(axis=1) if units > 1 else np.full(1, np.sqrt(z.shape[1]))
    return centres, width * np.maximum(spacing, 1e-3)


def dyadic(z: FloatArray, levels: int) -> tuple[FloatArray, FloatArray]:
    """Candidates (n_c, m), (n_c,) on grids of spacing 2, 1, ½ … where data fall.

    Regressors are normalised, so the first level has a wavelet of the width of the data's
    spread; the dilation is the spacing times the square root of the dimension, with which the
    radial wavelet covers its cell.
    """
    dimension = z.shape[1]
    centres, widths = [], []
    for level in range(levels):
        spacing = 2.0 ** (1 - level)
        cells = np.unique(np.round(z / spacing).astype(np.int64), axis=0)
        if dimension <= _MOST_CORNERS:
            around = np.array(list(product((-1, 0, 1), repeat=dimension)))
            cells = np.unique((cells[:, None, :] + around[None]).reshape(-1, dimension), axis=0)
        centres.append(cells * spacing)
        widths.append(np.full(len(cells), spacing * np.sqrt(dimension)))
    return np.vstack(centres), np.concatenate(widths)


def selected(
    candidates: FloatArray, targets: FloatArray, fixed: FloatArray, units: int
) -> list[int]:
    """Columns chosen by orthogonal least squares, in the order of what they explain.

    Parameters
    ----------
    candidates : (n, n_c) array
        Outputs of the candidates.
    targets : (n, n_out) array
    fixed : (n, k) array
        Columns that are in the model anyway: a constant, the linear part.
    units : int
        Columns to choose; fewer where the rest explains nothing.

    Notes
    -----
    The error reduction ratio of a column q, orthogonal to the chosen ones, is the share of the
    targets' sum of squares that it explains, ``Σ_o (qᵀt_o)² / qᵀq``.
    """
    basis, _ = np.linalg.qr(fixed)
    q = candidates - basis @ (basis.T @ candidates)
    rest = targets - basis @ (basis.T @ targets)
    sizes = (candidates**2).sum(axis=0)
    chosen: list[int] = []
    for _ in range(min(units, candidates.shape[1])):
        squares = (q**2).sum(axis=0)
        usable = squares > 1e-8 * sizes  # else it is a sum of those already chosen
        gain = np.where(usable, ((q.T @ rest) ** 2).sum(axis=1) / np.maximum(squares, 1e-300), 0.0)
        best = int(np.argmax(gain))
        if not gain[best] > 0:
            break
        chosen.append(best)
        direction = q[:, best] / np.sqrt(squares[best])
        q = q - np.outer(direction, direction @ q)
        rest = rest - np.outer(direction, direction @ rest)
        q[:, best] = 0.0
    return chosen


def with_linear_weights(
    network: Radial,
    centres: FloatArray,
    widths: FloatArray,
    z: FloatArray,
    targets: FloatArray,
    ridge: float,
) -> FloatArray:
    """θ with the output weights, the linear part and the constant by (ridge) least squares.

    ``ridge`` is relative to the mean square of the columns.
    """
    g = network.units(centres, widths, z)
    columns = np.hstack([g, z, np.ones((len(z), 1))])
    gram = columns.T @ columns
    gram.flat[:: len(gram) + 1] += ridge * float(np.trace(gram)) / len(gram)
    weights = np.linalg.solve(gram, columns.T @ targets).T
    n_c, m = centres.shape
    return network.joined(
        {
            "centres": centres,
            "widths": widths,
            "W": weights[:, :n_c],
            "A": weights[:, n_c : n_c + m],
            "b": weights[:, -1],
        }
    )
