"""All equilibria for given inputs, or for all inputs of a range, with proof.

Blocks are solved one after the other, each for every root of those before; a root's bounds are
what the following block is given, so that all that is proved holds for the root itself. An input
may be an interval: then a number of equilibria is proved for each of its values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.stability.equilibria.isolation import BlockEquations, PointBounds, is_regular, isolate
from trms_cli.stability.equilibria.rest_system import RestSystem
from trms_cli.stability.intervals.interval import Interval

IntArray = npt.NDArray[np.int64]

#: A box is cut no further when it is this share of its unknown's scale.
_SHARE_AT_POINTS = 1e-9
_SHARE_OVER_RANGES = 2e-4
#: Parts of a range that are tried before the rest is left untold, by the largest block.
_MOST_RANGES = {1: 600}
_MOST_RANGES_OF_MORE = 200


@dataclass(frozen=True)
class EnclosedEquilibrium:
    """Bounds around one equilibrium, or around a place where one could not be told."""

    z: Interval  #: (n,), of the unknowns
    x: Interval  #: (n_x,), (n_u,)
    u: Interval  #: (n_x,), (n_u,)
    unique: bool  #: Whether exactly one equilibrium is proved to lie within
    exists: bool  #: Whether at least one is


@dataclass(frozen=True)
class Proof:
    """All equilibria in a box for one input, or for each input of a small range."""

    given: Interval  #: (n_v,)
    enclosed: tuple[EnclosedEquilibrium, ...]
    open_ended: bool  #: Whether equilibria with a state beyond 1e6 are not excluded

    @property
    def complete(self) -> bool:
        """Whether the number of equilibria is proved."""
        return all(one.unique for one in self.enclosed)

    @property
    def count(self) -> int | None:
        """How many there are, where that is proved."""
        return len(self.enclosed) if self.complete else None

    @property
    def proved(self) -> tuple[EnclosedEquilibrium, ...]:
        return tuple(one for one in self.enclosed if one.unique)

    @property
    def undecided(self) -> tuple[EnclosedEquilibrium, ...]:
        return tuple(one for one in self.enclosed if not one.unique)


class Prover:
    """Finds and proves equilibria of one system in one box.

    Parameters
    ----------
    system : RestSystem
    box : Interval
        (n,), of its unknowns, infinite where there is no bound.
    scale : (n,) array
        Size of each unknown that counts.

    Raises
    ------
    ModelError
        If the equations cannot be shown to be regular in the box.
    """

    def __init__(self, system: RestSystem, box: Interval, scale: FloatArray) -> None:
        self.system, self.box, self.scale = system, box, scale
        self._blocks = [BlockEquations(system, block) for block in system.blocks]
        self._point = PointBounds(system)
        idle = Interval.point(np.zeros(len(system.given)))
        if not is_regular(system, box, idle):
            raise ModelError(
                f"the equations of model {system.model.name!r} may be singular somewhere in the "
                "box: an inertia, or the yaw of a beam that stands upright",
                where="study.box",
                remedy="give a smaller box, as study.box.alpha_v=[-1,1]",
            )

    def at(self, v: npt.ArrayLike) -> list[Proof]:
        """Proofs for inputs and torques, (m, n_v)."""
        given = Interval.point(np.atleast_2d(v))
        all_ = self._solve(given, _SHARE_AT_POINTS, whole=True)
        x, u = self._point(all_.z, given[all_.owner]) if len(all_.owner) else (all_.z, all_.z)
        proofs: list[list[EnclosedEquilibrium]] = [[] for _ in given.lower]
        for k, one in enumerate(all_.owner):
            known = bool(all_.unique[k]), bool(all_.exists[k])
            proofs[one].append(EnclosedEquilibrium(all_.z[k], x[k], u[k], *known))
        return [Proof(given[k], tuple(own), all_.open_ended) for k, own in enumerate(proofs)]

    def counts(self, lower: npt.ArrayLike, upper: npt.ArrayLike) -> list[int | None]:
        """How many equilibria there are for every input between bounds, (m, n_v) each.

        None where that could not be told.
        """
        given = Interval.of(lower, upper)
        solutions = self._solve(given, _SHARE_OVER_RANGES, whole=False)
        numbers: list[int | None] = np.bincount(
            solutions.owner, minlength=len(given.lower)
        ).tolist()
        for one in solutions.doubtful:
            numbers[one] = None
        return numbers

    def _solve(self, v: Interval, share: float, whole: bool) -> _Solutions:
        """Unless the ``whole`` is asked for, a problem is left at its first doubt."""
        m, n = len(v.lower), self.system.n
        owner = np.arange(m)
        z = Interval.point(np.zeros((m, n)))
        unique, exists, open_ended = np.ones(m, dtype=bool), np.ones(m, dtype=bool), False
        doubtful: list[int] = []
        for block, equations in zip(self.system.blocks, self._blocks, strict=True):
            columns = list(block.unknowns)
            given = Interval(
                np.concatenate([z.lower, v.lower[owner]], axis=1),
                np.concatenate([z.upper, v.upper[owner]], axis=1),
            )
            tolerance = share * self.scale[columns]
            groups = None if whole else owner
            roots = isolate(equations, self.box[columns], given, tolerance, groups)
            before = roots.owner
            lower, upper = z.lower[before], z.upper[before]
            lower[:, columns], upper[:, columns] = roots.box.lower, roots.box.upper
            z, owner = Interval(lower, upper), owner[before]
            unique = unique[before] & roots.unique
            exists = exists[before] & roots.exists
            open_ended |= roots.open_ended
            if not whole:
                doubtful += np.unique([*owner[~unique], *roots.left]).astype(int).tolist()
                sure = ~np.isin(owner, doubtful)
                z, owner, unique, exists = z[sure], owner[sure], unique[sure], exists[sure]
        return _Solutions(owner, z, unique, exists, tuple(doubtful), open_ended)


@dataclass(frozen=True)
class _Solutions:
    """Of many problems at once."""

    owner: IntArray
    z: Interval
    unique: BoolArray
    exists: BoolArray
    doubtful: tuple[int, ...]  #: problems that were left at a doubt
    open_ended: bool


@dataclass(frozen=True)
class RangePiece:
    """A part of a range of one input, in which the number of equilibria is proved or not."""

    lower: float  #: ends of the input
    upper: float  #: ends of the input
    count: int | None  #: For every input of it; None where it could not be told


def over_range(
    prover: Prover, v: FloatArray, index: int, bounds: tuple[float, float], resolution: float
) -> tuple[RangePiece, ...]:
    """Numbers of equilibria for every value of one input.

    The range is cut where a number cannot be told, down to the resolution.

    Parameters
    ----------
    v : (n_v,) array
        The other inputs, and torques.
    index : int
        Position of the input in v.
    resolution : float
        In the input's unit.
    """
    edges = np.linspace(*bounds, 33)
    waiting = list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))
    pieces: list[RangePiece] = []
    tried = 0
    largest = max((len(block.rows) for block in prover.system.blocks), default=1)
    most = _MOST_RANGES.get(largest, _MOST_RANGES_OF_MORE)
    while waiting:
        lower, upper = np.tile(v, (len(waiting), 1)), np.tile(v, (len(waiting), 1))
        lower[:, index], upper[:, index] = np.array(waiting).T
        following: list[tuple[float, float]] = []
        for (a, b), count in zip(waiting, prover.counts(lower, upper), strict=True):
            if count is None and b - a > resolution:
                following += [(a, 0.5 * (a + b)), (0.5 * (a + b), b)]
            else:
                pieces.append(RangePiece(a, b, count))
        tried += len(waiting)
        if tried > most:
            pieces += [RangePiece(a, b, None) for a, b in following]
            break
        waiting = following
    return _merged(sorted(pieces, key=lambda piece: piece.lower))


def _merged(pieces: list[RangePiece]) -> tuple[RangePiece, ...]:
    merged: list[RangePiece] = []
    for piece in pieces:
        if merged and merged[-1].count == piece.count:
            merged[-1] = RangePiece(merged[-1].lower, piece.upper, piece.count)
        else:
            merged.append(piece)
    return tuple(merged)
