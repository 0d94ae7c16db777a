"""Attractors that do not come to rest: many motions, their returns, and Newton's method on them.

A motion that still moves after the transient is cut by a plane that it crosses again and again (a
Poincaré section: the most moving angle passes its middle, rising). Where it comes back close to
where it was one or a few crossings ago, the stretch in between is a guess of a periodic orbit, and
:class:`~trms_cli.stability.cycles.shooting.Shooting` closes it, stable or not. Transients are
searched the same way: they pass by unstable cycles slowly.

A limit cycle is an isolated periodic orbit. Where orbits of one command fill a continuum instead,
each of another size, a step from one to the next is no deviation that grows or decays: besides the
multiplier along the orbit a second one is 1 (Kuznetsov 2004, ch. 1.5: an orbit without other
multipliers on the circle is isolated). Such orbits neither attract nor repel, and no command has
to be found for them: the start decides which one is gone round.

The pair of multipliers at 1 is a double root: an error δ of the monodromy matrix splits it by √δ,
while the pair's mean is off by δ only. One orbit with such a pair may lie on a fold of limit
cycles; a continuum shows several, clearly of different size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.models.model import Model
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.cycles.shooting import Orbit, Shooting

Fate = Literal["rest", "settling", "cycle", "moves on", "leaves"]
FATES: tuple[Fate, ...] = ("rest", "settling", "cycle", "moves on", "leaves")

#: Swing of the controlled states over the last quarter of a motion, rad, below which it rests.
_AT_REST = 1e-3
#: The last quarter swings less than this part of the one before: it settles.
_SETTLING = 0.98
#: Most crossings that a guess of an orbit spans.
_LONGEST_RETURN = 4
#: Best returns that are tried of a motion that moves on; of one that settles, the best.
_TRIED = 3
#: An orbit that swings less is an equilibrium, rad.
_SMALLEST = 5e-3
#: Two orbits of one command are the same below this relative difference of period and swings.
_SAME_ORBIT = 1e-4


@dataclass(frozen=True)
class SearchMotion:
    """One start and what became of it."""

    path: FloatArray  #: (n, n_x) array
    #: ``rest``; ``settling``: still moves, less and less; ``cycle``: repeats itself; ``moves on``:
    #: neither; ``leaves``: all bounds, or over the top again and again
    fate: Fate
    swing: float  #: Of the most moving controlled state over the last quarter


@dataclass(frozen=True)
class OrbitSearch:
    """What a search found."""

    motions: Sequence[SearchMotion]
    orbits: Sequence[Orbit]  #: Different ones, by rising period
    step: float  #: s between the states of a motion's path
    #: Orbits that are not isolated, by rising period: no limit cycles, and none of ``orbits``
    continuum: Sequence[Orbit] = ()

    def count(self, fate: Fate) -> int:
        return sum(motion.fate == fate for motion in self.motions)


def has_impulses(model: Model) -> bool:
    """Whether dry friction or stops act: then a motion has no slopes, and no Newton's method."""
    x, u, p, w = model.symbols()
    after = ca.densify(model.impulse(x, u, p, w, 0.01))
    return not ca.is_equal(after, x, 0)


def starts_in(centre: FloatArray, box: FloatArray, count: int) -> FloatArray:
    """Evenly spread starts in a box around a state, (count, n_x): a Halton sequence, no chance.

    ``centre``, ``box``: (n_x,); middle and half-widths; a width of zero keeps the state.
    """
    from scipy.stats import qmc

    free = np.flatnonzero(box > 0)
    starts = np.tile(centre, (count, 1))
    if free.size:
        shares = qmc.Halton(d=int(free.size), scramble=False).random(count + 1)[1:]
        starts[:, free] += (2.0 * shares - 1.0) * box[free]
    return starts


def half_widths(model: Model, x: FloatArray, given: Mapping[str, float]) -> FloatArray:
    """Half-widths of the box of starts by state: what is given, else by the state's kind.

    Controlled angles: half of the way to the stops (0.5 rad without). Other states: 1 (a rate), or
    a third of their value at the equilibrium, whichever is more.
    """
    widths = np.maximum(1.0, np.abs(x) / 3.0)
    for name in model.controlled:
        i = model.state_index(name)
        if model.states[i].unit == "rad":
            stop = model.stops.get(name, 1.0)
            widths[i] = 0.5 * stop if np.isfinite(stop) else 0.5
    for name, width in given.items():
        widths[model.state_index(name)] = width
    return widths


def search_orbits(
    model: Model,
    starts: FloatArray,
    u: FloatArray,
    duration: float,
    shooting: Shooting | None,
    step: float = 0.02,
) -> OrbitSearch:
    """Motions from all starts, and the periodic orbits that they lead to.

    Parameters
    ----------
    starts : (m, n_x)
    u : (n_u,)
        Held.
    duration, step : float
        s.
    shooting : Shooting or None
        None: motions only (dry friction has no slopes).
    """
    paths = VectorField(model).motions(starts, u, duration, step)
    rows = [model.state_index(name) for name in model.controlled]
    motions, orbits = [], list[Orbit]()
    for i in range(starts.shape[0]):
        path = paths[:, i]
        fate, swing = _fate(path[:, rows])
        row = rows[int(np.argmax(np.ptp(path[-len(path) // 4 :, rows], axis=0)))]
        if shooting is not None and fate != "leaves":
            tried = _TRIED if fate == "moves on" else 1
            orbits += _closed(shooting, path, row, u, step, tried)
        if fate == "moves on" and _repeats(path, row, step):
            fate = "cycle"
        motions.append(SearchMotion(path, fate, swing))
    every = different(orbits)
    family = continuum(every)
    isolated = [orbit for orbit in every if not any(orbit is one for one in family)]
    if shooting is not None:
        family = different([gone_round_once(shooting, orbit) for orbit in family])
    return OrbitSearch(motions, isolated, step, family)


def _fate(angles: FloatArray) -> tuple[Fate, float]:
    n = len(angles)
    if not np.all(np.isfinite(angles)):
        return "leaves", float("inf")
    last, before = angles[3 * n // 4 :], angles[n // 2 : 3 * n // 4]
    swing, earlier = (float(np.ptp(part, axis=0).max()) for part in (last, before))
    if swing > 2.0 * np.pi:
        return "leaves", swing
    if swing < _AT_REST:
        return "rest", swing
    if swing < _SETTLING * earlier:
        return "settling", swing
    return "moves on", swing


def crossings(values: FloatArray) -> npt.NDArray[np.intp]:
    """Samples after which values rise through their middle of the last quarter."""
    tail = values[3 * len(values) // 4 :]
    middle = 0.5 * (tail.max() + tail.min())
    return np.flatnonzero((values[:-1] < middle) & (values[1:] >= middle))


def _repeats(path: FloatArray, row: int, step: float) -> bool:
    """Whether the end of a motion comes back to where it was, within 2 % of its swing."""
    at = crossings(path[:, row])
    swing = np.maximum(np.ptp(path[3 * len(path) // 4 :], axis=0), 1e-9)
    for turns in range(1, 2 * _LONGEST_RETURN + 1):
        if len(at) <= turns:
            return False
        # Between samples by the state itself: the crossing lies up to a step away.
        one, other = (_at_crossing(path, row, int(k)) for k in (at[-1], at[-1 - turns]))
        if float((np.abs(one - other) / swing.max()).max()) < 0.02:
            return True
    return False


def _at_crossing(path: FloatArray, row: int, k: int) -> FloatArray:
    tail = path[3 * len(path) // 4 :, row]
    middle = 0.5 * (tail.max() + tail.min())
    low, high = path[k, row], path[k + 1, row]
    return np.asarray(path[k] + (middle - low) / (high - low) * (path[k + 1] - path[k]))


def _closed(
    shooting: Shooting, path: FloatArray, row: int, u: FloatArray, step: float, tried: int
) -> list[Orbit]:
    """Orbits from a motion's best returns."""
    at = crossings(path[:, row])
    candidates = []
    for turns in range(1, _LONGEST_RETURN + 1):
        for first, last in zip(at[:-turns], at[turns:], strict=True):
            stretch = path[first : last + 1]
            swing = float(np.ptp(stretch[:, row]))
            if swing < _SMALLEST or last - first < 10:
                continue
            miss = float(np.abs(path[last] - path[first]).max()) / swing
            candidates.append((miss * turns, int(first), int(last)))
    orbits = []
    for _, first, last in sorted(candidates)[:tried]:
        stretch = path[first : last + 1]
        picked = np.linspace(0, last - first, shooting.pieces + 1)[:-1].round().astype(int)
        orbit = shooting.closed(stretch[picked], (last - first) * step, u)
        if orbit is not None and orbit.swing.max() > _SMALLEST and orbit.trivial_error < 0.05:
            orbits.append(orbit)
    return orbits


def different(orbits: Sequence[Orbit]) -> list[Orbit]:
    """Each orbit once, gone around once, by rising period."""
    kept: list[Orbit] = []
    for orbit in sorted(orbits, key=lambda one: one.period):
        if not any(_same(orbit, other) for other in kept):
            kept.append(orbit)
    return kept


def _same(orbit: Orbit, other: Orbit) -> bool:
    turns = max(1, round(orbit.period / other.period))
    if abs(orbit.period - turns * other.period) > _SAME_ORBIT * orbit.period:
        return False
    return bool(np.allclose(orbit.swing, other.swing, rtol=1e-2, atol=1e-3))


#: How far the pair may be split, and its mean be off 1.
_SPLIT, _MEAN = 0.03, 1e-3
#: By which two orbits of a continuum differ in size, relative.
_DIFFERENT = 0.05
#: An orbit that is back this near, as part of its swing, repeats itself.
_REPEATED = 0.01


def continuum(orbits: Sequence[Orbit]) -> list[Orbit]:
    """Those of the orbits of one command that are part of a continuum; empty without one."""
    neutral = [orbit for orbit in orbits if _second_at_one(orbit)]
    sizes = [float(orbit.swing.max()) for orbit in neutral]
    if len(sizes) < 2 or max(sizes) < (1.0 + _DIFFERENT) * min(sizes):
        return []
    return neutral


def gone_round_once(shooting: Shooting, orbit: Orbit) -> Orbit:
    """The orbit of the smallest period, if an orbit goes two to four times round it."""
    last, near = len(orbit.path) - 1, _REPEATED * float(orbit.swing.max())
    for turns in (4, 3, 2):
        if float(np.abs(orbit.path[round(last / turns)] - orbit.path[0]).max()) < near:
            picked = np.linspace(0, last / turns, shooting.pieces + 1)[:-1].round().astype(int)
            once = shooting.closed(orbit.path[picked], orbit.period / turns, orbit.u)
            return orbit if once is None else once
    return orbit


def _second_at_one(orbit: Orbit) -> bool:
    others = orbit.multipliers[1:]
    if not others.size:
        return False
    pair = np.array([orbit.multipliers[0], others[int(np.argmin(np.abs(others - 1.0)))]])
    return bool(np.abs(pair - 1.0).max() < _SPLIT and abs(pair.mean() - 1.0) < _MEAN)
