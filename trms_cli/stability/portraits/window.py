"""The window of a portrait where none is given: room for rest points and for typical motions.

An angle's window reaches a little beyond the rest points around the operating point, and as far as
the stops. That of any other coordinate holds what it does in free motions from the edges of the
angles' windows; and, where these do not move it (a rotor's speed, a current), what it does when the
command steps to its bounds.

Where the trajectories of a portrait begin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.stability.portraits.invariant_sets import search
from trms_cli.stability.portraits.section import PortraitCoordinates, StateSection

#: rad. A little more than half a turn: rest points of a pendulum on both sides.
_SEARCHED = 3.6
#: rad, of an angle without stops and without a second rest point.
_LEAST_ANGLE = 1.0
_BEYOND = 1.3
_MARGIN = 1.3
#: s of the motions that show what is typical, and s between their points.
_TYPICAL, _STEP = 6.0, 0.02
#: Starts of the free motions, in shares of the way to an angle's edge.
_SHARES = (0.2, 0.4, 0.6, 0.75, 0.95)
#: A coordinate that free motions move by less than this share of what commands do is a rotor's.
_UNMOVED = 0.05
#: rad: reach of the default starts around the goal of a closed loop.
LOOP_REACH = 0.5


def checked_window(
    coordinates: PortraitCoordinates, given: Mapping[str, tuple[float, float]]
) -> dict[int, tuple[float, float]]:
    """The limits that were given, by place.

    Raises ConfigurationError for a name that is no coordinate of the portrait, and limits in
    reverse.
    """
    found = {}
    for name, (low, high) in given.items():
        unknown = f"{name!r} is no coordinate of this portrait"
        require_known(name, coordinates.names, unknown, f"window.{name}")
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ConfigurationError(
                f"[{low:g}, {high:g}] given",
                where=f"window.{name}",
                remedy="the lower limit first, and a higher one: "
                f"[{min(low, high):g}, {max(low, high):g}]"
                if low != high
                else "two different limits",
            )
        found[coordinates.names.index(name)] = (float(low), float(high))
    return found


def default_window(
    section: StateSection, given: Mapping[int, tuple[float, float]], *, around: bool = False
) -> FloatArray:
    """Limits of each coordinate, (n_c, 2); what is given stays.

    ``around``: only the surroundings of the operating point, as the starts of a closed loop are.
    """
    coordinates, point = section.coordinates, section.point
    centre = coordinates.values(point.x, point.u)
    window = np.full((len(coordinates), 2), np.nan)
    for place, limits in given.items():
        window[place] = limits
    angles = [
        place
        for place, item in enumerate(coordinates.items)
        if not item.is_rate and item.unit == "rad"
    ]
    for place in angles:
        if place not in given:
            reach = _angle_reach(section, place, around)
            window[place] = centre[place] - reach, centre[place] + reach
    for place in range(len(coordinates)):
        if np.isnan(window[place, 0]):
            window[place] = _typical(section, place, window, angles, around)
    return window


def _angle_reach(section: StateSection, place: int, around: bool) -> float:
    coordinates, point = section.coordinates, section.point
    model, item = coordinates.model, coordinates.items[place]
    centre = point.x[item.state]
    stop = model.stops.get(item.name, math.inf)
    if around:
        room = stop - abs(centre)
        return min(LOOP_REACH, 0.9 * room) if room > 0.05 else LOOP_REACH
    least = _BEYOND * stop if math.isfinite(stop) and stop < _SEARCHED else _LEAST_ANGLE
    values = coordinates.values(point.x, point.u)
    wide = np.stack([values - _SEARCHED, values + _SEARCHED], axis=1)
    far = [abs(rest.c[place] - centre) for rest in search(section, wide)]
    return max([least, *(_BEYOND * d for d in far)])


def _typical(
    section: StateSection, place: int, window: FloatArray, angles: list[int], around: bool
) -> tuple[float, float]:
    """What a coordinate that is no angle does."""
    freely, pushed = _extents(section, window, angles)
    free, push = freely[place], pushed[place]
    moved = free[1] - free[0] > _UNMOVED * (push[1] - push[0])
    low, high = free if moved else push
    centre = float(section.coordinates.values(section.point.x, section.point.u)[place])
    if around and not moved:
        # A loop is started near its goal, not at full speed.
        low, high = centre + 0.3 * (low - centre), centre + 0.3 * (high - centre)
    middle = centre if moved else (low + high) / 2
    half = max(high - middle, middle - low, 1e-3) * _MARGIN
    return middle - half, middle + half


def _extents(
    section: StateSection, window: FloatArray, angles: list[int]
) -> tuple[FloatArray, FloatArray]:
    """Least and largest coordinates in free motions, and in those under full commands."""
    coordinates, point = section.coordinates, section.point
    model, centre = coordinates.model, coordinates.values(point.x, point.u)
    starts = [point.x]
    for angle in angles:
        for edge in window[angle]:
            for share in _SHARES:
                c = centre.copy()
                c[angle] += share * (edge - centre[angle])
                starts.append(section.place(c)[0])
    field = coordinates.field
    free = coordinates.values(
        field.motions(np.array(starts), point.u, _TYPICAL, _STEP, impulses=False), point.u
    )
    # What turns over the top and gains speed with every turn is not typical.
    for angle in angles:
        outside = ~((free[..., angle] >= window[angle, 0]) & (free[..., angle] <= window[angle, 1]))
        leaves = outside.any(axis=0)
        if not leaves.all():  # as they do where the window is not around the operating point
            free[:, leaves] = np.nan
    bound = model.input_bounds()[1]
    commands = np.array([-bound, bound, point.u])
    push = field.motions(
        np.tile(point.x, (len(commands), 1)), commands, _TYPICAL, _STEP, impulses=False
    )
    return _range(free), _range(coordinates.values(push, commands))


def _range(values: FloatArray) -> FloatArray:
    """(n_c, 2) over all finite rows of (…, n_c)."""
    rows = values.reshape(-1, values.shape[-1])
    rows = rows[np.isfinite(rows).all(axis=1)]
    return np.stack([rows.min(axis=0), rows.max(axis=0)], axis=1)


#: Starts of a plane and of a space, of the model alone; and of a closed loop.
DEFAULT_COUNT = {2: 28, 3: 16}
LOOP_COUNT = 8
#: Share of the starts in a plane that lie inside the window instead of on its edge.
_INSIDE = 0.4
_CANDIDATES = 400
#: Plane filling with the least structure (Roberts 2018): the plastic numbers of 2 and 3 dimensions.
_PLASTIC = {2: 1.3247179572447460, 3: 1.2207440846057596}


def given_starts(section: StateSection, starts: Sequence[Mapping[str, float]]) -> FloatArray:
    """Starts by name, (m, n_x): coordinates of the portrait, and any other state.

    What is not named is at the operating point.

    Raises ConfigurationError for unknown names, and where a start has no place in the section.
    """
    coordinates, point = section.coordinates, section.point
    model = coordinates.model
    centre = coordinates.values(point.x, point.u)
    rows = []
    for number, start in enumerate(starts):
        c, states = centre.copy(), {}
        for name, value in start.items():
            known = {*coordinates.names, *model.state_names}
            unknown = f"{name!r} is neither a coordinate of this portrait nor a state"
            require_known(name, known, unknown, f"starts[{number}].{name}")
            if name in coordinates.names:
                c[coordinates.names.index(name)] = value
            else:
                states[model.state_index(name)] = value
        x = section.place(c)[0]
        if not np.isfinite(x).all():
            raise ConfigurationError(
                f"the settled states have no value at {dict(start)}",
                where=f"starts[{number}]",
                remedy="let them be held: study.others=held",
            )
        for index, value in states.items():
            x[index] = value
        rows.append(x)
    return np.array(rows)


def default_starts(section: StateSection, window: FloatArray, count: int) -> FloatArray:
    """Starts (m, n_x) from which trajectories fill the window (n_c, 2).

    In a plane, points of the edge where the field enters the window, evenly spaced, and points
    inside; in a space, points inside.
    """
    n = len(section.coordinates)
    if n == 3:
        return _placed(section, _filling(count, 0.9, n), window)
    inside = max(1, round(_INSIDE * count))
    edge = _entering(section, window)
    picked = edge[
        np.linspace(0, len(edge), min(count - inside, len(edge)), endpoint=False).astype(int)
    ]
    return _placed(section, np.vstack([picked, _filling(count - len(picked), 0.8, n)]), window)


def loop_starts(section: StateSection, window: FloatArray, count: int) -> FloatArray:
    """Starts (m, n_x) all around the operating point, on the ellipse in the window."""
    coordinates, point = section.coordinates, section.point
    centre = coordinates.values(point.x, point.u)
    room = np.minimum(window[:, 1] - centre, centre - window[:, 0])
    reach = np.where(room > 0, room, np.ptp(window, axis=1) / 2)
    turns = 2 * math.pi * (np.arange(count) + 0.5) / count
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    if len(coordinates) == 3:
        ring = np.hstack([ring, np.where(np.arange(count) % 2, -0.7, 0.7)[:, None]])
    return _finite(section.place(centre + reach * ring))


def _entering(section: StateSection, window: FloatArray) -> FloatArray:
    """Points of the edge (in shares of the window, −1 to 1) where the field points inwards."""
    along = np.linspace(-1.0, 1.0, _CANDIDATES // 4, endpoint=False)
    one = np.ones_like(along)
    edge = np.vstack(
        [
            np.stack([along, -one], axis=1),
            np.stack([one, along], axis=1),
            np.stack([-along, one], axis=1),
            np.stack([-one, -along], axis=1),
        ]
    )
    flow = section.rates(_scaled(edge, window)) / (np.ptp(window, axis=1) / 2)
    # At a corner through both of its edges.
    across = np.where(np.abs(edge) == 1.0, -edge * flow, np.inf)
    inwards = np.nan_to_num(across.min(axis=1), nan=-1.0)
    # Where the field runs along an edge its motions are those of the neighbours.
    steep = inwards > 0.02 * np.linalg.norm(np.nan_to_num(flow), axis=1)
    return 0.999 * edge[steep]


def _filling(count: int, reach: float, n: int) -> FloatArray:
    """Evenly spread points of the cube from −reach to reach, (count, n)."""
    steps = _PLASTIC[n] ** -np.arange(1.0, n + 1.0)
    return reach * (2.0 * np.mod(0.5 + np.arange(1, count + 1)[:, None] * steps, 1.0) - 1.0)


def _scaled(shares: FloatArray, window: FloatArray) -> FloatArray:
    return window.mean(axis=1) + shares * np.ptp(window, axis=1) / 2


def _placed(section: StateSection, shares: FloatArray, window: FloatArray) -> FloatArray:
    return _finite(section.place(_scaled(shares, window)))


def _finite(x: FloatArray) -> FloatArray:
    return x[np.isfinite(x).all(axis=1)]
