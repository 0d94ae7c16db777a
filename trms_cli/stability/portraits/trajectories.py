"""The window of a portrait, where its trajectories begin, and where each of them ends.

An angle's window reaches a little beyond the rest points around the operating point, and as far as
the stops. That of any other coordinate holds what it does in free motions from the edges of the
angles' windows; and, where these do not move it (a rotor's speed, a current), what it does when the
command steps to its bounds.

Of a closed loop the command follows from what the controller and its observer remember, not from
the state alone: there is no field in the plane, so no nullclines, and trajectories may cross.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.models.operating_point import refine_operating_point
from trms_cli.stability.closed_loop import LoopRun, run_loop
from trms_cli.stability.portraits.invariant_sets import RestPoint, StickingSet, rest_point, search
from trms_cli.stability.portraits.section import PortraitCoordinates, StateSection
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts

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
    coordinates: PortraitCoordinates, limits: Mapping[str, tuple[float, float]]
) -> dict[int, tuple[float, float]]:
    """The limits that were given, by place.

    Raises ConfigurationError for a name that is no coordinate of the portrait, and limits in
    reverse.
    """
    window = {}
    for name, (low, high) in limits.items():
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
        window[coordinates.names.index(name)] = (float(low), float(high))
    return window


def default_window(
    section: StateSection, fixed_limits: Mapping[int, tuple[float, float]], *, around: bool = False
) -> FloatArray:
    """Limits of each coordinate, (n_c, 2); what is given stays.

    ``around``: only the surroundings of the operating point, as the starts of a closed loop are.
    """
    coordinates, point = section.coordinates, section.point
    centre = coordinates.values(point.x, point.u)
    window = np.full((len(coordinates), 2), np.nan)
    for place, limits in fixed_limits.items():
        window[place] = limits
    angles = [
        place
        for place, item in enumerate(coordinates.items)
        if not item.is_rate and item.unit == "rad"
    ]
    for place in angles:
        if place not in fixed_limits:
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
    is_moving = free[1] - free[0] > _UNMOVED * (push[1] - push[0])
    low, high = free if is_moving else push
    centre = float(section.coordinates.values(section.point.x, section.point.u)[place])
    if around and not is_moving:
        # A loop is started near its goal, not at full speed.
        low, high = centre + 0.3 * (low - centre), centre + 0.3 * (high - centre)
    middle = centre if is_moving else (low + high) / 2
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
    still = np.tile(point.x, (len(commands), 1))
    push = field.motions(still, commands, _TYPICAL, _STEP, impulses=False)
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
            known_names = {*coordinates.names, *model.state_names}
            unknown = f"{name!r} is neither a coordinate of this portrait nor a state"
            require_known(name, known_names, unknown, f"starts[{number}].{name}")
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


#: Points while a mode lasts that is over within a step, and between them in its time constants.
_FINE_STEPS, _FINE = 40, 0.2
#: Starts of motions that are integrated at once.
_MOST_AT_ONCE = 64


@dataclass(frozen=True)
class PortraitTrajectory:
    """A trajectory."""

    time: FloatArray  #: (n,) array; s
    x: FloatArray  #: (n, n_x) array
    c: FloatArray  #: (n, n_c) array; coordinates
    #: (n,) bool array; whether a command is at its bound; False throughout for the model alone
    saturated: BoolArray


def trajectories(
    section: StateSection, starts: FloatArray, duration: float, step: float
) -> tuple[PortraitTrajectory, ...]:
    """Motions of the whole model from starts (m, n_x) with the section's command held.

    Where a mode is over within a step (an armature's current: 0.1 ms), finer points come first: a
    line from the start to the end of the first step would show the fall along it aslant.
    """
    coordinates, u = section.coordinates, section.point.u
    slopes, _ = coordinates.field.linearised(section.point.x, u)
    fastest = float(np.abs(np.linalg.eigvals(slopes).real).max())
    fine = _FINE / fastest if fastest * step > 1.0 else 0.0  # s; 0 where a step shows it
    time: FloatArray = np.arange(max(1, round(duration / step)) + 1, dtype=np.float64) * step
    if fine:
        early = np.arange(_FINE_STEPS + 1) * fine
        time = np.concatenate([early, early[-1] + time[1:]])
    paths: list[PortraitTrajectory] = []
    for first in range(0, len(starts), _MOST_AT_ONCE):
        part = starts[first : first + _MOST_AT_ONCE]
        if fine:
            initial_motion = coordinates.field.motions(part, u, _FINE_STEPS * fine, fine)
            rest = coordinates.field.motions(initial_motion[-1], u, duration, step)
            x = np.concatenate([initial_motion, rest[1:]])
        else:
            x = coordinates.field.motions(part, u, duration, step)
        never = np.zeros(len(time), dtype=bool)
        for i in range(len(part)):
            c = coordinates.values(x[:, i], u)
            paths.append(PortraitTrajectory(time, x[:, i], c, never))
    return tuple(paths)


def drawn_points(
    trajectory: PortraitTrajectory, window: FloatArray, apart: float, longest: float = np.inf
) -> tuple[FloatArray, BoolArray]:
    """A trajectory for drawing: points some distance apart, up to a length, within the window.

    Distances are shares of the window's width. Returns points (n, n_c), NaN outside, and whether a
    command is at its bound, (n,).
    """
    c = trajectory.c
    steps = np.linalg.norm(np.diff(c, axis=0) / np.ptp(window, axis=1), axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps, nan=np.inf))])
    finite = np.isfinite(length)
    end = min(float(length[finite][-1]), longest)
    indices = np.unique(np.searchsorted(length[finite], np.arange(0.0, end + apart / 2, apart)))
    indices = indices[indices < finite.sum()]
    points = c[indices].copy()
    inside = np.all((points >= window[:, 0]) & (points <= window[:, 1]), axis=1)
    # One point beyond each way out, so that lines reach the edge.
    near = inside.copy()
    near[1:] |= inside[:-1]
    near[:-1] |= inside[1:]
    points[~near] = np.nan
    return points, trajectory.saturated[indices]


#: A command within this share of its bound is at it.
_AT_BOUND = 1e-6


def loop_trajectories(
    section: StateSection, loop: LoopParts, starts: FloatArray, duration: float, tell: Tell
) -> tuple[list[PortraitTrajectory], list[LoopRun]]:
    """Runs of the loop from starts (m, n_x), its references at the section's operating point."""
    coordinates, point = section.coordinates, section.point
    model = coordinates.model
    bound = model.input_bounds()[1] * (1.0 - _AT_BOUND)
    paths, runs = [], []
    for number, start in enumerate(starts, 1):
        tell(f"run {number} of {len(starts)}")
        offset = dict(zip(model.state_names, (start - point.x).tolist(), strict=True))
        run = run_loop(model, loop, point, duration, offset=offset)
        # What is held back is the command as given: a loop's path to the motors bounds it too.
        saturated = np.any(np.abs(run.applied) >= bound, axis=1)
        c = coordinates.values(run.x, run.applied)
        paths.append(PortraitTrajectory(run.time, run.x, c, saturated))
        runs.append(run)
    return paths, runs


What = Literal["rest", "rest outside", "line", "held", "stuck", "moving", "turning", "gone"]

#: Share of the window's width within which a motion has arrived.
NEAR = 0.02
#: The last part of a motion, which must lie there.
_TAIL = 0.1


@dataclass(frozen=True)
class TrajectoryEnd:
    """Where some of the motions end."""

    #: ``rest``: at an equilibrium of the window; ``rest outside``: at one outside; ``line``: on a
    #: line of them. ``held``: on a sticking set; ``stuck``: standing still elsewhere under dry
    #: friction. ``moving``: still on its way in the window; ``turning``: half a turn or more
    #: outside it and moving; ``gone``: outside otherwise.
    what: What
    members: tuple[int, ...]  #: Numbers of the journeys
    #: s after which each stays within 2 % of the window's width of its end; empty where nothing is
    #: reached
    times: tuple[float, ...] = ()
    rest: RestPoint | None = None
    sticking_set: StickingSet | None = None


def ends_of(
    section: StateSection,
    window: FloatArray,
    rests: Sequence[RestPoint],
    paths: Sequence[PortraitTrajectory],
    sticking: Sequence[StickingSet] = (),
    *,
    dry_friction: bool = False,
    search_beyond: bool = True,
) -> tuple[TrajectoryEnd, ...]:
    """The motions by their ends, the most frequent end first.

    With dry friction something may stand still where there is no equilibrium of f; equilibria
    outside the window are looked for on request, where motions seem to rest.
    """
    known_rests, near = list(rests), NEAR * np.ptp(window, axis=1)

    def end_of(path: PortraitTrajectory) -> tuple[What, int, float]:
        """What, the place of its rest point or sticking set, and when."""
        c = path.c
        if not np.isfinite(c[-1]).all():
            return "gone", -1, np.inf
        tail = c[-max(2, round(_TAIL * len(c))) :]
        still = bool(np.all(np.ptp(tail, axis=0) <= near))
        for place, sticking_set in enumerate(sticking):
            if still and sticking_set.holds(c[-1], near):
                return "held", place, _arrival(path, c[-1], near)
        for place, rest in enumerate(known_rests):
            if np.all(np.abs(tail - rest.c) <= near):
                return "rest", place, _arrival(path, rest.c, near)
        if still and search_beyond:
            x = refine_operating_point(section.coordinates.field, path.x[-1], section.point.u)
            beyond = None if x is None else rest_point(section, x)
            if beyond is not None and np.all(np.abs(tail - beyond.c) <= near):
                known_rests.append(beyond)
                return "rest", len(known_rests) - 1, _arrival(path, beyond.c, near)
        if still and dry_friction:
            return "stuck", -1, _arrival(path, c[-1], near)
        past = np.maximum(window[:, 0] - c[-1], c[-1] - window[:, 1])
        angles = [item.unit == "rad" for item in section.coordinates.items]
        if np.any(past[angles] > np.pi):
            return "turning", -1, np.inf
        inside = np.all((tail >= window[:, 0]) & (tail <= window[:, 1]))
        return "moving" if inside else "gone", -1, np.inf

    groups: dict[tuple[What, int], list[tuple[int, float]]] = {}
    for number, trajectory in enumerate(paths):
        what, place, time = end_of(trajectory)
        if what == "rest" and known_rests[place].line:
            what, place = "line", -1
        elif what == "rest" and place >= len(rests):
            c = known_rests[place].c
            inside = np.all((c >= window[:, 0]) & (c <= window[:, 1]))
            what = "rest" if inside else "rest outside"
        groups.setdefault((what, place), []).append((number, time))
    ends = []
    for (what, place), members in groups.items():
        times = tuple(time for _, time in members if np.isfinite(time))
        rest = known_rests[place] if what in ("rest", "rest outside") else None
        sticking_set = sticking[place] if what == "held" else None
        ends.append(
            TrajectoryEnd(what, tuple(number for number, _ in members), times, rest, sticking_set)
        )
    return tuple(sorted(ends, key=lambda end: -len(end.members)))


def _arrival(trajectory: PortraitTrajectory, goal: FloatArray, near: FloatArray) -> float:
    """s after which it stays near."""
    away = np.flatnonzero(~np.all(np.abs(trajectory.c - goal) <= near, axis=1))
    return float(trajectory.time[min(away[-1] + 1, len(trajectory.time) - 1)]) if len(away) else 0.0
