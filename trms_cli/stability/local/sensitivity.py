"""Why an eigenvalue moves: its derivative by what is varied, entry by entry of A.

For a simple eigenvalue with ``wᵀv = 1``

    dλ/dp = wᵀ (dA/dp) v = Σ_ij w_i (dA_ij/dp) v_j

(Kato, Perturbation Theory for Linear Operators, ch. 2), so each physical equation has its share.
dA/dp is exact: ``∂A/∂p`` and, through the operating point that moves along, ``∂A/∂x dx/dp +
∂A/∂u du/dp``, with dx/dp and du/dp by the implicit function theorem.

The loop that a share stands in is read off the signal flow graph of ``sI − A`` at ``s = λ``: the
edge j → i has the gain ``A_ij/(s − A_ii)``, and by Mason's rule an eigenvalue is where the
determinant of the graph, made of the gains of its cycles, vanishes (Mason 1956, Proc. IRE 44).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.local.sweep import Path, Place

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

#: 1/s: nearer to a pole of its own, an edge has no gain to speak of.
_NO_GAIN = 1e-9
#: Loops longer than this are no explanation.
_LONGEST = 6


@dataclass(frozen=True)
class Share:
    """Part of dλ/dp that one entry of A has."""

    row: int  #: The entry
    column: int  #: The entry
    change: float  #: dA_ij/dp
    part: complex  #: Its part of dλ/dp, 1/s per unit of what is varied


@dataclass(frozen=True)
class Loop:
    """A cycle of the signal flow graph."""

    states: tuple[int, ...]  #: In the order of cause and effect; the last acts on the first
    gain: complex  #: At s = λ


@dataclass(frozen=True)
class Sensitivity:
    """dλ/dp of one eigenvalue at one place."""

    total: complex  #: dλ/dp, 1/s per unit
    direct: complex  #: What of it would remain if the operating point did not move
    shares: tuple[Share, ...]  #: By the size of their real parts, largest first


def sensitivity(path: Path, place: Place, track: int) -> Sensitivity:
    """dλ/dp and its shares for one eigenvalue of a place."""
    direction = path.direction()
    moved = path.balance.tangent(place.held, place.point, direction)
    along = np.concatenate([moved, direction.p])
    alone = np.concatenate([np.zeros(path.model.n_x), moved[path.model.n_x :], direction.p])
    if path.kind == "parameter":
        alone[: len(moved)] = 0.0
    where = (place.point.x, place.point.u)
    change = path.linear.change(*where, along, path.side, place.held.p)
    still = path.linear.change(*where, alone, path.side, place.held.p)
    left, right = place.spectrum.left[:, track], place.spectrum.right[:, track]
    scale: complex = 1.0
    if path.model.sample_time is not None:
        scale = 1.0 / (complex(place.spectrum.values[track]) * path.model.sample_time)
    parts = scale * left[:, None] * change * right[None, :]
    shares = [
        Share(int(i), int(j), float(change[i, j]), complex(parts[i, j]))
        for i, j in np.argwhere(change != 0.0)
    ]
    shares.sort(key=lambda share: -abs(share.part.real))
    direct = complex(scale * (left @ still @ right))
    return Sensitivity(complex(parts.sum()), direct, tuple(shares))


def loops_through(a: FloatArray, row: int, column: int, s: complex) -> tuple[Loop, ...]:
    """Cycles of the signal flow graph through an entry, the strongest first.

    Parameters
    ----------
    a : (n, n) array
    row, column : int
        The entry; on the diagonal it is a loop by itself.
    s : complex
        Where the gains are taken. None are returned where one of them is infinite.
    """
    if np.any(np.abs(s - np.diag(a)) < _NO_GAIN):
        return ()  # a state that integrates alone: the graph has no finite gains there
    if row == column:
        return (Loop((row,), complex(a[row, row] / s)),)
    found = [
        Loop((column, *way), _gain(a, (column, *way), s))
        for way in _ways(a, row, column, (column,))
    ]
    return tuple(sorted(found, key=lambda loop: -abs(loop.gain)))


def _ways(a: FloatArray, begin: int, end: int, met: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Ways from a state back to another, without a state twice."""
    if a[end, begin] != 0.0:
        yield (begin,)
    if len(met) + 1 >= _LONGEST:
        return
    for following in np.flatnonzero(a[:, begin]):
        k = int(following)
        if k not in (*met, begin, end):
            for rest in _ways(a, k, end, (*met, begin)):
                yield (begin, *rest)


def _gain(a: FloatArray, states: tuple[int, ...], s: complex) -> complex:
    gain: complex = 1.0
    for cause, effect in zip(states, (*states[1:], states[0]), strict=True):
        gain *= a[effect, cause] / (s - a[effect, effect])
    return gain
