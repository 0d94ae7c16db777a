"""No periodic orbit in a box, for blocks of more than two states: areas that shrink.

Bendixson's criterion in more dimensions (R. A. Smith 1986, Proc. R. Soc. Edinburgh 104A; Muldowney
1990, Rocky Mountain J. Math. 20): let D be convex, and in some coordinates z = W x let

    λ₁ + λ₂ < 0 on D,    λ₁ ≥ λ₂ ≥ … the eigenvalues of the symmetric part of W J(x) W⁻¹.

Then the flow shrinks every small piece of surface, and no closed orbit lies in D: the surface of
least area that it spans, which lies in D, would be shrunk while its edge stays. For two states
λ₁ + λ₂ is the divergence.

J is enclosed by interval arithmetic on small boxes that cover D; with J = J_c ± J_r,

    λ₁ + λ₂ ≤ (λ₁ + λ₂)(S_c) + 2 ρ(S_r),    S the symmetric parts of W J_c W⁻¹ and |W| J_r |W⁻¹|

(Ky Fan: the sum of the largest eigenvalues is subadditive). W are the modal coordinates of the
equilibrium, its modes scaled against each other. The eigenvalues are computed in floating point,
with a margin that is far above its error.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ModelError
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]

#: 1/s, above the rounding of eigenvalues and of the change of coordinates.
_MARGIN = 1e-6
#: Pieces of the box, by how many states the slopes depend on.
_CUTS = {0: 1, 1: 400, 2: 48, 3: 12, 4: 7}
#: Halvings that find the largest share of the box.
#: Half-widths that are not cut.
_NARROW = 1e-4
_HALVINGS = 6
_SCALES = np.geomspace(0.2, 5.0, 5)


def share_without_orbits(
    slope: ca.Function, members: Sequence[int], x: FloatArray, widths: FloatArray
) -> float:
    """Largest share of a box around an equilibrium that is proved to hold no periodic orbit.

    Parameters
    ----------
    slope : casadi.Function
        ``x → ∂f/∂x`` of the block, (k, k).
    members : sequence of int
        Positions of the block's states in x.
    x, widths : (n_x,) arrays
        The equilibrium and the half-widths; a width of zero keeps a state.

    Returns
    -------
    float
        From 0 (nothing is proved) to 1 (the whole box).
    """
    try:
        enclosure = Enclosure(slope)
        J = np.array(slope(x), dtype=float).reshape(len(members), len(members))
        candidates = _coordinates(J)
    except (np.linalg.LinAlgError, ModelError):
        return 0.0
    acting = sorted({int(j) for j in slope.sparsity_jac(0, 0).get_triplet()[1]})
    acting = [i for i in acting if widths[i] > _NARROW]
    if len(acting) not in _CUTS:
        return 0.0
    best = 0.0
    for T in candidates:
        if _bound(enclosure, T, x, widths, acting, best or 1e-3) >= -_MARGIN:
            continue
        low, high = best, 1.0
        if _bound(enclosure, T, x, widths, acting, 1.0) < -_MARGIN:
            return 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if _bound(enclosure, T, x, widths, acting, middle) < -_MARGIN:
                low = middle
            else:
                high = middle
        best = max(best, low)
    return best


def _coordinates(J: FloatArray) -> list[FloatArray]:
    """Real modal coordinates, the first mode scaled against the others."""
    values, vectors = np.linalg.eig(J)
    columns, done = list[FloatArray](), set[int]()
    groups: list[list[int]] = []
    for i in np.argsort(values.real):
        if int(i) in done:
            continue
        done.add(int(i))
        if abs(values[i].imag) < 1e-12:
            groups.append([len(columns)])
            columns.append(vectors[:, i].real)
            continue
        done.add(int(np.argmin(np.abs(values - values[i].conj()))))
        groups.append([len(columns), len(columns) + 1])
        columns += [vectors[:, i].real, vectors[:, i].imag]
    T = np.column_stack(columns)
    if len(groups) == 1:
        return [T]
    found = []
    for scale in _SCALES:
        scaled = T.copy()
        scaled[:, groups[-1]] *= scale
        np.linalg.inv(scaled)
        found.append(scaled)
    return found


def _bound(
    enclosure: Enclosure,
    T: FloatArray,
    x: FloatArray,
    widths: FloatArray,
    acting: list[int],
    share: float,
) -> float:
    """The largest λ₁ + λ₂ over a share of the box, 1/s."""
    cuts = [np.array([a - share * w, a + share * w]) for a, w in zip(x, widths, strict=True)]
    for i in acting:
        ends = np.linspace(float(cuts[i][0]), float(cuts[i][1]), _CUTS[len(acting)] + 1)
        # A kink at zero is met by boxes on either side of it, not across.
        cuts[i] = np.unique(np.append(ends, 0.0)) if ends[0] < 0.0 < ends[-1] else ends
    lower = np.stack([g.ravel() for g in np.meshgrid(*(c[:-1] for c in cuts))], axis=1)
    upper = np.stack([g.ravel() for g in np.meshgrid(*(c[1:] for c in cuts))], axis=1)
    J = enclosure(Interval.of(lower, upper))[0]
    W = np.linalg.inv(T)
    middle, radius = 0.5 * (J.lower + J.upper), 0.5 * (J.upper - J.lower)
    if not np.all(np.isfinite(radius)):
        return float("inf")
    centre = W @ middle @ T
    around = np.abs(W) @ radius @ np.abs(T)
    values = np.linalg.eigvalsh(0.5 * (centre + centre.transpose(0, 2, 1)))
    reach = np.linalg.eigvalsh(0.5 * (around + around.transpose(0, 2, 1)))
    return float((values[:, -1] + values[:, -2] + 2.0 * np.abs(reach).max(axis=1)).max())
