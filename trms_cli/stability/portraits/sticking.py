"""Where dry friction holds an axis or a rotor: the set on which trajectories end.

At zero rate friction takes any torque up to its bound. The set is found as the equations find it: a
point whose rate is zero belongs to it if, one integration step later, the rate is still zero with
the impulses of friction and not zero without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.wording import symbol
from trms_cli.models.dry_friction import SPEEDS
from trms_cli.models.model import Model
from trms_cli.stability.portraits.rest_points import RestPoint
from trms_cli.stability.portraits.section import PortraitCoordinates, StateSection, rate_names

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


def has_dry_friction(model: Model) -> bool:
    """Whether impulses act on a model's states."""
    import casadi as ca

    x, u, p, w = model.symbols()
    return not ca.is_equal(model.impulse(x, u, p, w, _STEP), x, 1)


def sticking_sets(
    section: StateSection, window: FloatArray, rests: Sequence[RestPoint]
) -> tuple[StickingSet, ...]:
    """The sets in a window (n_c, 2) of a plane in which a rate that friction acts on can be set.

    They are looked for all along the line of zero rate, and closely around the rest points.
    """
    coordinates = section.coordinates
    if len(coordinates) != 2 or not has_dry_friction(coordinates.model):
        return ()
    found: list[StickingSet] = []
    for name in _rates(coordinates.model):
        for along in (0, 1):
            line = _line(section, coordinates.names[along], name)
            if line is not None:
                found += _held_on(section, line, window, rests, along)
                break
    return tuple(found)


def _rates(model: Model) -> tuple[str, ...]:
    """What friction can hold: rates of angles, speeds of rotors."""
    speeds = [SPEEDS[rotor] for rotor in model.rotors if SPEEDS.get(rotor) in model.state_names]
    return (*rate_names(model), *speeds)


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
    stuck = _held(line, values)
    if not stuck.any():
        return []
    # Then its ends, each between a point that is held and one that is not.
    edges = np.flatnonzero(np.diff(stuck.astype(int)))
    between = [np.linspace(values[i], values[i + 1], _POINTS // 4) for i in edges]
    values = _within(np.concatenate([values, *between]), window[along])
    stuck = _held(line, values)
    c = section.coordinates.values(_placed(line, values), section.point.u)
    item = line.coordinates.items[1]
    what = symbol(line.coordinates.model.states[item.state].name)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stuck, [False]]).astype(int)))
    return [
        StickingSet(what, c[first:end], along)
        for first, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def _held(line: StateSection, values: FloatArray) -> BoolArray:
    """Whether friction holds the rate of the line at zero, at each of its points (n,)."""
    x = _placed(line, values)
    known = np.isfinite(x).all(axis=1)
    x[~known] = line.point.x
    slopes, _ = line.coordinates.field.linearised(line.point.x, line.point.u)
    step = min(_STEP, _SHARE / float(np.abs(np.linalg.eigvals(slopes)).max()))
    after = []
    for impulses in (True, False):
        rates = []
        for first in range(0, len(x), _POINTS):
            # Always as many at once: the number is part of the compiled function.
            part = x[first : first + _POINTS]
            full = np.vstack([part, np.tile(line.point.x, (_POINTS - len(part), 1))])
            moved = line.coordinates.field.motions(
                full, line.point.u, step, step, impulses=impulses
            )[-1, : len(part)]
            rates.append(np.abs(line.coordinates.values(moved, line.point.u)[:, 1]))
        after.append(np.concatenate(rates))
    held, free = after
    return known & (held <= _HELD * free + 1e-12) & (held < free)


def _placed(line: StateSection, values: FloatArray) -> FloatArray:
    return line.place(np.stack([values, np.zeros(len(values))], axis=1))


def _within(values: FloatArray, limits: FloatArray) -> FloatArray:
    return np.unique(values[(values >= limits[0]) & (values <= limits[1])])
