"""Where the trajectories of a portrait begin."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.stability.portraits.section import Section

FloatArray = npt.NDArray[np.float64]

#: Starts of a plane and of a space, of the model alone; and of a closed loop.
DEFAULT_COUNT = {2: 28, 3: 16}
LOOP_COUNT = 8
#: Share of the starts in a plane that lie inside the window instead of on its edge.
_INSIDE = 0.4
_CANDIDATES = 400
#: Plane filling with the least structure (Roberts 2018): the plastic numbers of 2 and 3 dimensions.
_PLASTIC = {2: 1.3247179572447460, 3: 1.2207440846057596}


def given_starts(section: Section, starts: Sequence[Mapping[str, float]]) -> FloatArray:
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
            if name in coordinates.names:
                c[coordinates.names.index(name)] = value
            elif name in model.state_names:
                states[model.state_index(name)] = value
            else:
                raise ConfigurationError(
                    f"{name!r} is neither a coordinate of this portrait nor a state",
                    where=f"starts[{number}].{name}",
                    remedy=nearest(name, {*coordinates.names, *model.state_names}),
                )
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


def default_starts(section: Section, window: FloatArray, count: int) -> FloatArray:
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


def loop_starts(section: Section, window: FloatArray, count: int) -> FloatArray:
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


def _entering(section: Section, window: FloatArray) -> FloatArray:
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


def _placed(section: Section, shares: FloatArray, window: FloatArray) -> FloatArray:
    return _finite(section.place(_scaled(shares, window)))


def _finite(x: FloatArray) -> FloatArray:
    return x[np.isfinite(x).all(axis=1)]
