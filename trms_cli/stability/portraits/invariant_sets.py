"""What motions of a portrait end on or are parted by: rest points, sticking sets, separatrices.

Rest points are searched by Newton's method from many starts: a search and no proof;
``study=equilibria`` bounds what it can have missed.

A sticking set is where dry friction holds an axis or a rotor: at zero rate friction takes any
torque up to its bound. The set is found as the equations find it: a point whose rate is zero
belongs to it if, one integration step later, the rate is still zero with the impulses of friction
and not zero without them.

Separatrices are the invariant manifolds of saddles. At a saddle the eigenvectors of the
linearisation are tangent to the curves along which motions leave it (integrated forwards) and reach
it (integrated backwards). In a plane that is invariant both are curves, and the second kind divides
the starts by where they end. In a space of three states the motions into a saddle with one unstable
direction fill a surface: it is shown by some of its motions, begun on a small ring around the
saddle. Where the portrait is a projection of more states, only the motions out of a saddle with a
single unstable direction are curves, and shown. Dry friction is left out of them: with it a saddle
is a set, not a point.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, ComplexArray, FloatArray, stretches
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.wording import symbol
from trms_cli.models.operating_point import refine_operating_point
from trms_cli.models.vector_field import has_impulses
from trms_cli.stability.portraits.section import PortraitCoordinates, StateSection, rate_names

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
    is_visible: BoolArray
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
    unseen = [i for i in coordinates.others if coordinates.model.states[i].unit == "rad"]
    equilibria: list[FloatArray] = []
    for start in (point.x, *starts[np.isfinite(starts).all(axis=1)]):
        x = refine_operating_point(coordinates.field, start, point.u)
        if x is None or len(equilibria) >= _MOST:
            continue
        c = coordinates.values(x, point.u)
        if np.any(c < window[:, 0] - _SAME * width) or np.any(c > window[:, 1] + _SAME * width):
            continue
        if np.any(np.abs(x - point.x)[unseen] > _HALF_A_TURN):
            continue
        scale = np.maximum(1.0, np.abs(x))
        if all(np.abs((x - other) / scale).max() > _SAME for other in equilibria):
            equilibria.append(x)
    points: list[RestPoint] = []
    for rest in (rest_point(section, x) for x in equilibria):
        # Of a continuum that the portrait shows as one point, one is enough.
        again = any(np.all(np.abs(rest.c - other.c) <= 1e-4 * width) for other in points)
        if rest.isolated or not again:
            points.append(rest)
    return tuple(sorted(points, key=lambda rest: tuple(rest.c.round(6))))


def rest_point(section: StateSection, x: FloatArray) -> RestPoint:
    """An equilibrium with what its linearisation tells.

    On a switch that is the mean of both sides, as in ``study=local``: a small swing spends half of
    its time on either.
    """
    coordinates, point = section.coordinates, section.point
    a = coordinates.linear.a(x, point.u)
    switches = tuple(switch.state for switch in coordinates.linear.switches(x, point.u))
    # Of a real matrix: real eigenvalues then have no imaginary part, not even rounding.
    eigenvalues, vectors = (part.astype(complex) for part in np.linalg.eig(a))
    order = np.lexsort((eigenvalues.imag, np.abs(eigenvalues.real).round(9)))
    eigenvalues, vectors = eigenvalues[order], vectors[:, order]
    c = coordinates.values(x, point.u)
    placed = section.place(c)[0]
    near = 1e-5 * np.maximum(1.0, np.abs(x))
    on = bool(np.isfinite(placed).all() and np.all(np.abs(placed - x) <= near))
    visible_modes, line = (
        _visible_modes(vectors, coordinates.own),
        _on_a_line(section, x, eigenvalues, vectors),
    )
    return RestPoint(x, c, eigenvalues, kind_of(eigenvalues), on, visible_modes, line, switches)


def _visible_modes(vectors: ComplexArray, own: tuple[int, ...]) -> BoolArray:
    """Modes whose participation factors |v_ki w_ik| (Pérez-Arriaga 1982) are large in some states.

    Where the eigenvectors do not span the space, all are.
    """
    try:
        left_vectors = np.linalg.inv(vectors)
    except np.linalg.LinAlgError:
        return np.ones(len(vectors), dtype=bool)
    shares = np.abs(vectors * left_vectors.T)
    is_visible: BoolArray = shares[list(own)].sum(axis=0) >= _SHOWN * shares.sum(axis=0)
    return is_visible


def _on_a_line(
    section: StateSection, x: FloatArray, eigenvalues: ComplexArray, vectors: ComplexArray
) -> bool:
    """Whether a direction in which nothing pulls moves the coordinates."""
    none = np.abs(eigenvalues) <= _no_rate(eigenvalues)
    coordinates, u = section.coordinates, section.point.u
    for vector in vectors[:, none].real.T:
        away = 1e-4 * vector
        displacement = coordinates.values(x + away, u) - coordinates.values(x, u)
        if np.abs(displacement).max() > 1e-3 * np.abs(away).max():
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


_POINTS = 400
#: s: the longest step of the trial, and the longest in time constants of the fastest mode. A
#: current that decays within the step would not show what the friction had to hold at its start.
_STEP, _SHARE = 1e-3, 1e-3
#: Rate after a step, in shares of what it would be without friction, that counts as none.
_HELD = 1e-3


@dataclass(frozen=True, eq=False)
class StickingSet:
    """A part of the portrait in which dry friction holds something still."""

    what: str  #: ``α_v`` or ``ω_v``: what is held
    c: FloatArray  #: (n, n_c) array; points along it, from one end to the other
    along: int  #: The coordinate along which the set extends

    @property
    def reach(self) -> tuple[float, float]:
        """Its ends, in the coordinate along which it extends."""
        return float(self.c[0, self.along]), float(self.c[-1, self.along])

    def holds(self, c: FloatArray, near: FloatArray) -> bool:
        """Whether a point (n_c,) is on it, or as near as ``near`` (n_c,)."""
        other = 1 - self.along
        beside = np.interp(c[self.along], self.c[:, self.along], self.c[:, other])
        low, high = self.reach
        reached = low - near[self.along] <= c[self.along] <= high + near[self.along]
        return bool(reached and abs(c[other] - beside) <= near[other])


def sticking_sets(
    section: StateSection, window: FloatArray, rests: Sequence[RestPoint]
) -> tuple[StickingSet, ...]:
    """The sets in a window (n_c, 2) of a plane in which a rate that friction acts on can be set.

    They are looked for all along the line of zero rate, and closely around the rest points.
    """
    coordinates = section.coordinates
    if len(coordinates) != 2 or not has_impulses(coordinates.model):
        return ()
    sets: list[StickingSet] = []
    model = coordinates.model
    # What friction can hold: rates of angles, speeds of rotors.
    for name in (*rate_names(model), *model.rotor_speeds.values()):
        for along in (0, 1):
            line = _line(section, coordinates.names[along], name)
            if line is not None:
                sets += _held_on(section, line, window, rests, along)
                break
    return tuple(sets)


def _line(section: StateSection, along: str, rate: str) -> StateSection | None:
    """The same plane by a coordinate of its own and a rate; None where the two do not span it."""
    coordinates = section.coordinates
    if along == rate:
        return None
    try:
        other = PortraitCoordinates(coordinates.field, (along, rate), section.point)
    except ConfigurationError:
        return None
    if other.own != coordinates.own:
        return None
    return StateSection(other, section.point, section.settled)


def _held_on(
    section: StateSection,
    line: StateSection,
    window: FloatArray,
    rests: Sequence[RestPoint],
    along: int,
) -> list[StickingSet]:
    """The sets on the line where the rate is zero."""
    width = float(np.ptp(window[along]))
    near = width * np.geomspace(1e-6, 0.05, _POINTS // 20)
    around = [rest.c[along] + side * near for rest in rests for side in (-1.0, 1.0)]
    values = _within(
        np.concatenate([np.linspace(window[along, 0], window[along, 1], _POINTS), *around]),
        window[along],
    )
    stuck = _is_held(line, values)
    if not stuck.any():
        return []
    # Then its ends, each between a point that is held and one that is not.
    edges = np.flatnonzero(np.diff(stuck.astype(int)))
    between = [np.linspace(values[i], values[i + 1], _POINTS // 4) for i in edges]
    values = _within(np.concatenate([values, *between]), window[along])
    stuck = _is_held(line, values)
    c = section.coordinates.values(_placed(line, values), section.point.u)
    item = line.coordinates.items[1]
    what = symbol(line.coordinates.model.states[item.state].name)
    return [StickingSet(what, c[first:end], along) for first, end in stretches(stuck)]


def _is_held(line: StateSection, values: FloatArray) -> BoolArray:
    """Whether friction holds the rate of the line at zero, at each of its points (n,)."""
    x = _placed(line, values)
    is_finite = np.isfinite(x).all(axis=1)
    x[~is_finite] = line.point.x
    slopes, _ = line.coordinates.field.linearised(line.point.x, line.point.u)
    step = min(_STEP, _SHARE / float(np.abs(np.linalg.eigvals(slopes)).max()))
    after = []
    for impulses in (True, False):
        rates = []
        for first in range(0, len(x), _POINTS):
            # Always as many at once: the number is part of the compiled function.
            part = x[first : first + _POINTS]
            full = np.vstack([part, np.tile(line.point.x, (_POINTS - len(part), 1))])
            ends = line.coordinates.field.motions(
                full, line.point.u, step, step, impulses=impulses
            )[-1, : len(part)]
            rates.append(np.abs(line.coordinates.values(ends, line.point.u)[:, 1]))
        after.append(np.concatenate(rates))
    with_friction, free = after
    return is_finite & (with_friction <= _HELD * free + 1e-12) & (with_friction < free)


def _placed(line: StateSection, values: FloatArray) -> FloatArray:
    return line.place(np.stack([values, np.zeros(len(values))], axis=1))


def _within(values: FloatArray, limits: FloatArray) -> FloatArray:
    return np.unique(values[(values >= limits[0]) & (values <= limits[1])])


#: How far from the saddle a manifold begins, in shares of the window.
_BESIDE = 1e-4
#: How far outside the window it is followed, in shares of it.
_BEYOND = 0.02
_RING = 20
_TOLERANCE = 1e-7
#: Widths of the window, and parts of the duration after which the length is looked at.
_LONGEST, _PARTS = 3.0, 10
#: s between points of a motion of the whole model.
_MOTION_STEP = 0.02
#: 1/s. Slower than this is no direction of a saddle.
_NO_DIRECTION = 1e-6


@dataclass(frozen=True)
class Separatrix:
    """A motion out of a saddle, or into one."""

    c: FloatArray  #: (n, n_c) array; coordinates, in the order of time
    into: bool  #: Into the saddle
    surface: bool = False  #: One of many motions that show a surface


def separatrices(
    section: StateSection, invariant: bool, window: FloatArray, rest: RestPoint, duration: float
) -> tuple[Separatrix, ...]:
    """The manifolds of a saddle that are curves of the portrait, and a surface in a space.

    If the section is invariant its own slopes decide. They are followed until they leave the window
    (n_c, 2), for a duration (s) at most.
    """
    if rest.kind != "saddle":
        return ()
    of = _of_plane if invariant and rest.in_section else _of_whole
    manifolds = []
    for path, into, surface in of(section, window, rest, duration):
        whole = np.vstack([rest.c, path])
        manifolds.append(Separatrix(whole[::-1] if into else whole, into, surface))
    return tuple(manifolds)


def _of_plane(
    section: StateSection, window: FloatArray, rest: RestPoint, duration: float
) -> Iterator[tuple[FloatArray, bool, bool]]:
    """Paths beside a saddle, whether into it, whether on a surface, by the section's own slopes."""

    def field(c: FloatArray) -> FloatArray:
        return section.rates(c)[0]

    width = np.ptp(window, axis=1)
    values, vectors = np.linalg.eig(section.slopes(rest.c) * width / width[:, None])
    for into, selection in _sides(values):
        basis = np.linalg.svd(
            np.hstack([vectors[:, selection].real, vectors[:, selection].imag]), full_matrices=False
        )[0][:, : int(selection.sum())]
        surface = basis.shape[1] == 2
        directions = [sign * basis[:, 0] for sign in (-1.0, 1.0)] if basis.shape[1] == 1 else []
        if surface:
            turns = 2 * np.pi * np.arange(_RING) / _RING
            directions = [np.cos(t) * basis[:, 0] + np.sin(t) * basis[:, 1] for t in turns]
        for direction in directions:
            start = rest.c + _BESIDE * width * direction
            yield _followed(field, lambda c: c, start, into, window, duration), into, surface


def _sides(values: ComplexArray) -> tuple[tuple[bool, BoolArray], tuple[bool, BoolArray]]:
    """Which eigenvalues lead out of a saddle, and which into it."""
    return (False, values.real > _NO_DIRECTION), (True, values.real < -_NO_DIRECTION)


def _of_whole(
    section: StateSection, window: FloatArray, rest: RestPoint, duration: float
) -> Iterator[tuple[FloatArray, bool, bool]]:
    """Likewise by the slopes of all states, where a single direction leads out or in."""
    coordinates, u = section.coordinates, section.point.u
    values, vectors = np.linalg.eig(coordinates.linear.a(rest.x, u))
    width = np.ptp(window, axis=1)
    for into, selection in _sides(values):
        if selection.sum() != 1:
            continue
        vector = vectors[:, selection][:, 0].real
        ahead = coordinates.values(rest.x + 1e-6 * vector, u) - rest.c
        size = float(np.abs(ahead / width).max()) / 1e-6
        if size < 1e-6:
            continue
        beside = rest.x + np.array([[-1.0], [1.0]]) * _BESIDE / size * vector
        if into:
            field = partial(coordinates.field.rates, u=u)
            values_at = partial(coordinates.values, u=u)
            paths = [_followed(field, values_at, at, into, window, duration) for at in beside]
        else:
            states = coordinates.field.motions(beside, u, duration, _MOTION_STEP, impulses=False)
            paths = [
                _truncate(path, window) for path in coordinates.values(states, u).swapaxes(0, 1)
            ]
        for path in paths:
            yield path, into, False


def _followed(
    field: Callable[[FloatArray], FloatArray],
    coordinates: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    backwards: bool,
    window: FloatArray,
    duration: float,
) -> FloatArray:
    """Coordinates along a motion, (n, n_c), in order of integration.

    Until it leaves the window; a motion out of a saddle, which may wind into a focus for ever, also
    until it is :data:`_LONGEST` widths long.
    """
    from scipy.integrate import solve_ivp

    sign = -1.0 if backwards else 1.0
    width = np.ptp(window, axis=1)
    low, high = window[:, 0] - _BEYOND * width, window[:, 1] + _BEYOND * width

    def room(t: float, x: FloatArray) -> float:
        c = coordinates(x)
        return float(np.minimum(c - low, high - c).min())

    room.terminal = True  # type: ignore[attr-defined]
    times = np.linspace(0.0, duration, _PARTS + 1)
    path: list[FloatArray] = []
    for begin, end in itertools.pairwise(times):
        solution = solve_ivp(
            lambda t, x: sign * field(x),
            (begin, end),
            start,
            method="LSODA",
            events=room,
            rtol=_TOLERANCE,
            atol=_TOLERANCE * np.maximum(0.1, np.abs(start)),
        )
        path += [coordinates(x) for x in solution.y.T]
        length = np.linalg.norm(np.diff(np.array(path), axis=0) / width, axis=1).sum()
        if solution.status != 0 or (length > _LONGEST and not backwards):
            break
        start = solution.y[:, -1]
    return np.array(path)


def _truncate(path: FloatArray, window: FloatArray) -> FloatArray:
    """A motion (n, n_c) until it leaves the window or is long enough."""
    width = np.ptp(window, axis=1)
    outside = np.any(
        (path < window[:, 0] - _BEYOND * width) | (path > window[:, 1] + _BEYOND * width), axis=1
    )
    steps = np.linalg.norm(np.diff(path, axis=0) / width, axis=1)
    over = outside | ~np.isfinite(path).all(axis=1)
    over[1:] |= np.cumsum(steps) > _LONGEST
    return path[: int(np.argmax(over)) + 1] if over.any() else path
