"""Invariant manifolds of saddles: the separatrices of a portrait.

At a saddle the eigenvectors of the linearisation are tangent to the curves along which motions
leave it (integrated forwards) and reach it (integrated backwards). In a plane that is invariant
both are curves, and the second kind divides the starts by where they end. In a space of three
states the motions into a saddle with one unstable direction fill a surface: it is shown by some of
its motions, begun on a small ring around the saddle. Where the portrait is a projection of more
states, only the motions out of a saddle with a single unstable direction are curves, and shown.

Dry friction is left out: with it a saddle is a set, not a point.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.stability.portraits.rest_points import RestPoint
from trms_cli.stability.portraits.section import StateSection

#: How far from the saddle a manifold begins, in shares of the window.
_BESIDE = 1e-4
#: How far outside the window it is followed, in shares of it.
_BEYOND = 0.02
_RING = 20
_TOLERANCE = 1e-7
#: Widths of the window, and parts of the duration after which the length is looked at.
_LONGEST, _PARTS = 3.0, 10
#: s between points of a motion of the whole model.
_STEP = 0.02
#: 1/s. Slower than this is no direction of a saddle.
_NO_RATE = 1e-6


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
    if invariant and rest.in_section:
        return _of_plane(section, window, rest, duration)
    return _of_whole(section, window, rest, duration)


def _of_plane(
    section: StateSection, window: FloatArray, rest: RestPoint, duration: float
) -> tuple[Separatrix, ...]:
    def field(c: FloatArray) -> FloatArray:
        return section.rates(c)[0]

    width = np.ptp(window, axis=1)
    found: list[Separatrix] = []
    for into, directions in _spaces(section.slopes(rest.c), width):
        for direction, surface in directions:
            start = rest.c + _BESIDE * width * direction
            path = _followed(field, lambda c: c, start, into, window, duration)
            found.append(Separatrix(_whole(path, rest.c, into), into, surface))
    return tuple(found)


def _of_whole(
    section: StateSection, window: FloatArray, rest: RestPoint, duration: float
) -> tuple[Separatrix, ...]:
    coordinates, u = section.coordinates, section.point.u
    values, vectors = np.linalg.eig(coordinates.linear.a(rest.x, u))
    width = np.ptp(window, axis=1)
    found = []
    for into, chosen in ((False, values.real > _NO_RATE), (True, values.real < -_NO_RATE)):
        if chosen.sum() != 1:
            continue
        vector = vectors[:, chosen][:, 0].real
        ahead = coordinates.values(rest.x + 1e-6 * vector, u) - rest.c
        size = float(np.abs(ahead / width).max()) / 1e-6
        if size < 1e-6:
            continue
        beside = rest.x + np.array([[-1.0], [1.0]]) * _BESIDE / size * vector
        if into:
            paths = [
                _followed(
                    lambda x: coordinates.field.rates(x, u),
                    lambda x: coordinates.values(x, u),
                    start,
                    into,
                    window,
                    duration,
                )
                for start in beside
            ]
        else:
            moved = coordinates.field.motions(beside, u, duration, _STEP, impulses=False)
            paths = [_cut(path, window) for path in coordinates.values(moved, u).swapaxes(0, 1)]
        found += [Separatrix(_whole(path, rest.c, into), into) for path in paths]
    return tuple(found)


def _spaces(
    slopes: FloatArray, width: FloatArray
) -> list[tuple[bool, list[tuple[FloatArray, bool]]]]:
    """Directions (in shares of the window) out of a saddle and into it; a ring for a surface."""
    scaled = slopes * width / width[:, None]
    values, vectors = np.linalg.eig(scaled)
    found: list[tuple[bool, list[tuple[FloatArray, bool]]]] = []
    for into, chosen in ((False, values.real > _NO_RATE), (True, values.real < -_NO_RATE)):
        basis = np.linalg.svd(
            np.hstack([vectors[:, chosen].real, vectors[:, chosen].imag]), full_matrices=False
        )[0][:, : int(chosen.sum())]
        if basis.shape[1] == 1:
            found.append((into, [(sign * basis[:, 0], False) for sign in (-1.0, 1.0)]))
        elif basis.shape[1] == 2:
            turns = 2 * np.pi * np.arange(_RING) / _RING
            ring = [np.cos(t) * basis[:, 0] + np.sin(t) * basis[:, 1] for t in turns]
            found.append((into, [(direction, True) for direction in ring]))
    return found


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


def _cut(path: FloatArray, window: FloatArray) -> FloatArray:
    """A motion (n, n_c) until it leaves the window or is long enough."""
    width = np.ptp(window, axis=1)
    outside = np.any(
        (path < window[:, 0] - _BEYOND * width) | (path > window[:, 1] + _BEYOND * width), axis=1
    )
    steps = np.linalg.norm(np.diff(path, axis=0) / width, axis=1)
    over = outside | ~np.isfinite(path).all(axis=1)
    over[1:] |= np.cumsum(steps) > _LONGEST
    return path[: int(np.argmax(over)) + 1] if over.any() else path


def _whole(path: FloatArray, saddle: FloatArray, into: bool) -> FloatArray:
    """From the saddle or to it."""
    whole = np.vstack([saddle, path])
    return whole[::-1] if into else whole
