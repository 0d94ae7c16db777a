"""Where the motions of a portrait can rest: a search by Newton's method from many starts.

It is a search and no proof: ``study=equilibria`` bounds what it can have missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, ComplexArray, FloatArray
from trms_cli.models.operating_point import refined
from trms_cli.stability.portraits.section import StateSection

Kind = Literal[
    "stable node",
    "stable focus",
    "unstable node",
    "unstable focus",
    "saddle",
    "saddle focus",
    "centre",
    "undecided",
]

#: Starts of the search along each coordinate, for two and for three of them.
_STARTS = {2: 11, 3: 5}
#: Real parts below this share of the largest eigenvalue, and below 1e-9, count as zero.
_NO_RATE = 1e-10
#: Two rest points closer than this, in shares of the window, are one.
_SAME = 1e-5
_MOST = 24
#: rad: a little more than π. Beyond, the same rest is met again in another turn.
_HALF_A_TURN = 3.6
#: Share of a mode's participation that must lie in the coordinates' states.
_SHOWN = 0.3


@dataclass(frozen=True)
class RestPoint:
    """An equilibrium in the window."""

    x: FloatArray  #: (n_x,) array
    c: FloatArray  #: (n_c,) array; its coordinates
    #: (n_x,) complex array; of the whole model, the slowest first, 1/s; on a switch those of the
    #: mean of both sides' slopes
    eigenvalues: ComplexArray
    kind: Kind  #: By all of them
    in_section: bool  #: Whether the section goes through it; otherwise it is seen in projection
    #: (n_x,) bool array; whether a mode moves what the portrait shows: its participation in the
    #: coordinates' states
    shown: BoolArray
    line: bool  #: Whether it is one of a line of rest points that the portrait shows
    #: The states on either side of which the slopes differ there (the cable's stiffness by the sign
    #: of the yaw)
    switches: tuple[int, ...] = ()

    @property
    def no_rate(self) -> float:
        """1/s: what is below it counts as zero."""
        return _no_rate(self.eigenvalues)

    @property
    def isolated(self) -> bool:
        """Whether its neighbours move; False where an eigenvalue is zero."""
        return bool(np.all(np.abs(self.eigenvalues) > self.no_rate))

    @property
    def stable(self) -> bool:
        return self.kind in ("stable node", "stable focus")


def kind_of(eigenvalues: npt.ArrayLike) -> Kind:
    """What an equilibrium is by the eigenvalues of its linearisation, (n,) in 1/s.

    Zero eigenvalues (a direction in which nothing pulls) are left out.
    """
    values = np.asarray(eigenvalues, dtype=complex)
    none = _no_rate(values)
    moving = values[np.abs(values) > none]
    real = np.where(np.abs(moving.real) <= none, 0.0, moving.real)
    turns = bool(np.any(np.abs(moving.imag) > none))
    if np.any(real > 0) and np.any(real < 0):
        # A swing that grows while all else decays is told from a way out.
        return "saddle focus" if np.all(np.abs(moving.imag[real > 0]) > none) else "saddle"
    if len(moving) == 0 or np.any(real == 0):
        return "centre" if len(moving) and np.all(real == 0) else "undecided"
    if real[0] < 0:
        return "stable focus" if turns else "stable node"
    return "unstable focus" if turns else "unstable node"


def _no_rate(eigenvalues: ComplexArray) -> float:
    return max(1e-9, _NO_RATE * float(np.abs(eigenvalues).max()))


def search(section: StateSection, window: FloatArray) -> tuple[RestPoint, ...]:
    """Equilibria whose coordinates lie in a window (n_c, 2), sorted by them.

    Angles that the portrait does not show are looked at within half a turn of the operating point.
    At most a few of a continuum (a yaw that nothing pulls back) are returned.
    """
    coordinates, point = section.coordinates, section.point
    starts = section.place(grid(window, _STARTS[len(coordinates)]).reshape(-1, len(coordinates)))
    width = np.maximum(window[:, 1] - window[:, 0], 1e-12)
    found: list[FloatArray] = []
    for start in (point.x, *starts[np.isfinite(starts).all(axis=1)]):
        x = refined(coordinates.field, start, point.u)
        if x is None or len(found) >= _MOST:
            continue
        c = coordinates.values(x, point.u)
        if np.any(c < window[:, 0] - _SAME * width) or np.any(c > window[:, 1] + _SAME * width):
            continue
        if _turned(section, x):
            continue
        scale = np.maximum(1.0, np.abs(x))
        if all(np.abs((x - other) / scale).max() > _SAME for other in found):
            found.append(x)
    points: list[RestPoint] = []
    for rest in (rest_point(section, x) for x in found):
        # Of a continuum that the portrait shows as one point, one is enough.
        again = any(np.all(np.abs(rest.c - other.c) <= 1e-4 * width) for other in points)
        if rest.isolated or not again:
            points.append(rest)
    return tuple(sorted(points, key=lambda rest: tuple(rest.c.round(6))))


def _turned(section: StateSection, x: FloatArray) -> bool:
    """Whether an angle that the portrait does not show is more than half a turn away."""
    model = section.coordinates.model
    unseen = [i for i in section.coordinates.others if model.states[i].unit == "rad"]
    return bool(np.any(np.abs(x - section.point.x)[unseen] > _HALF_A_TURN))


def rest_point(section: StateSection, x: FloatArray) -> RestPoint:
    """An equilibrium with what its linearisation tells.

    On a switch that is the mean of both sides, as in ``study=local``: a small swing spends half of
    its time on either.
    """
    coordinates, point = section.coordinates, section.point
    a = coordinates.linear.a(x, point.u)
    switches = tuple(switch.state for switch in coordinates.linear.switches(x, point.u))
    # Of a real matrix: real eigenvalues then have no imaginary part, not even rounding.
    eigenvalues, vectors = (found.astype(complex) for found in np.linalg.eig(a))
    order = np.lexsort((eigenvalues.imag, np.abs(eigenvalues.real).round(9)))
    eigenvalues, vectors = eigenvalues[order], vectors[:, order]
    c = coordinates.values(x, point.u)
    placed = section.place(c)[0]
    near = 1e-5 * np.maximum(1.0, np.abs(x))
    on = bool(np.isfinite(placed).all() and np.all(np.abs(placed - x) <= near))
    return RestPoint(
        x,
        c,
        eigenvalues,
        kind_of(eigenvalues),
        on,
        _shown(vectors, coordinates.own),
        _on_a_line(section, x, eigenvalues, vectors),
        switches,
    )


def _shown(vectors: ComplexArray, own: tuple[int, ...]) -> BoolArray:
    """Modes whose participation factors |v_ki w_ik| (Pérez-Arriaga 1982) are large in some states.

    Where the eigenvectors do not span the space, all are.
    """
    try:
        left = np.linalg.inv(vectors)
    except np.linalg.LinAlgError:
        return np.ones(len(vectors), dtype=bool)
    shares = np.abs(vectors * left.T)
    found: BoolArray = shares[list(own)].sum(axis=0) >= _SHOWN * shares.sum(axis=0)
    return found


def _on_a_line(
    section: StateSection, x: FloatArray, eigenvalues: ComplexArray, vectors: ComplexArray
) -> bool:
    """Whether a direction in which nothing pulls moves the coordinates."""
    none = np.abs(eigenvalues) <= _no_rate(eigenvalues)
    coordinates, u = section.coordinates, section.point.u
    for vector in vectors[:, none].real.T:
        away = 1e-4 * vector
        moved = coordinates.values(x + away, u) - coordinates.values(x, u)
        if np.abs(moved).max() > 1e-3 * np.abs(away).max():
            return True
    return False


def grid(window: FloatArray, count: int) -> FloatArray:
    """Points (count, …, n_c) of a window (n_c, 2), its edges included, first coordinate first."""
    lines = [np.linspace(low, high, count) for low, high in window]
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)


def halving_time(eigenvalue: complex) -> float:
    """s in which what belongs to an eigenvalue halves (or doubles)."""
    return math.log(2.0) / abs(eigenvalue.real) if eigenvalue.real else math.inf


def period(eigenvalue: complex) -> float:
    """s of a whole swing; infinite for what does not swing."""
    return 2.0 * math.pi / abs(eigenvalue.imag) if eigenvalue.imag else math.inf
