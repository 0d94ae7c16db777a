"""Periodic orbits: closed by multiple shooting, and searched from many motions.

A periodic orbit of ``ẋ = f(x, u)`` with the command held obeys

    φ(X_i; T/m, u) = X_{i+1},  i = 0 … m−1,  X_m = X_0        m pieces of equal time
    f(x̂_0, u)·(X_0 − x̂_0) = 0                                 where on the orbit it begins

φ is the discretised model's step, many times over. The product of the steps' Jacobians is the
Jacobian of φ to rounding (no differencing), and over a whole period the monodromy matrix, whose
eigenvalues are the Floquet multipliers. One of them is 1, along the orbit: how far the computed one
is from 1 tells how good the orbit is.

Motions are searched for orbits. One that still moves after the transient is cut by a plane that it
crosses again and again (a Poincaré section: the most moving angle passes its middle, rising). Where
it comes back close to where it was one or a few crossings ago, the stretch in between is a guess of
a periodic orbit, and :class:`Shooting` closes it, stable or not. Transients are searched the same
way: they pass by unstable cycles slowly.

A limit cycle is an isolated periodic orbit. Where orbits of one command fill a continuum instead,
each of another size, a step from one to the next is no deviation that grows or decays: besides the
multiplier along the orbit a second one is 1 (Kuznetsov 2004, ch. 1.5: an orbit without other
multipliers on the circle is isolated). Such orbits neither attract nor repel, and no command has
to be found for them: the start decides which one is gone round.

The pair of multipliers at 1 is a double root: an error δ of the monodromy matrix splits it by √δ,
while the pair's mean is off by δ only. One orbit with such a pair may lie on a fold of limit
cycles; a continuum shows several, clearly of different size.

After Kuznetsov, "Elements of Applied Bifurcation Theory" (3rd ed. 2004), ch. 1.5 and 10.2, and
Ascher, Mattheij & Russell (1995) on multiple shooting. The equations of Newton's method are solved
as one dense system: they are few.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter
from trms_cli.models.vector_field import VectorField

_ITERATIONS = 25
#: Largest misfit of a closed orbit, in the states' units.
_CLOSED = 1e-9
#: A Newton step that does not lessen the misfit is halved this often before it is given up.
_HALVINGS = 8
#: Newton's method is given up when the period leaves this share of its guess (or its inverse), or
#: the orbit shrinks by this: it is on its way to an equilibrium.
_SHORTEST, _COLLAPSED = 0.4, 0.05
#: A multiplier this far within the unit circle counts as stable.
MARGIN = 1e-6


@dataclass(frozen=True)
class Orbit:
    """A closed orbit."""

    nodes: FloatArray  #: (m, n_x) array; states at the beginnings of its pieces
    period: float  #: s
    u: FloatArray  #: (n_u,) array; the command held
    #: (n_x,) complex array; floquet multipliers, the trivial one first, then by falling size
    multipliers: ComplexArray
    #: (n + 1, n_x) array; the orbit at equal steps of time, its first state again at the end
    path: FloatArray
    misfit: float  #: Largest residual of the equations

    @property
    def swing(self) -> FloatArray:
        """Peak to peak of each state, (n_x,)."""
        return np.ptp(self.path, axis=0)

    @property
    def trivial_error(self) -> float:
        """How far the multiplier along the orbit is from 1."""
        return float(abs(self.multipliers[0] - 1.0))

    @property
    def largest(self) -> complex:
        """The largest multiplier but the trivial one; 0 for a model of one state."""
        return complex(self.multipliers[1]) if len(self.multipliers) > 1 else 0j

    @property
    def stable(self) -> bool:
        """Whether all multipliers but the trivial one lie within the unit circle."""
        return abs(self.largest) < 1.0 - MARGIN

    @property
    def time(self) -> FloatArray:
        """s, of the rows of ``path``."""
        return np.linspace(0.0, self.period, len(self.path))


@dataclass(frozen=True)
class Pieces:
    """What shooting from the nodes gives."""

    ends: FloatArray  #: (m, n_x) array
    by_state: FloatArray  #: (m, n_x, n_x) array; ∂end/∂node
    by_period: FloatArray  #: (m, n_x) array
    by_input: FloatArray  #: (m, n_x, n_u) array
    path: FloatArray  #: (m, k + 1, n_x) array; the pieces' steps


class Shooting:
    """Shoots orbits of a model with equations in a number of ``pieces``, m.

    More pieces make Newton's method surer for orbits that leave their neighbours fast. The
    integration ``steps`` of a period are rounded up to a multiple of them.
    """

    def __init__(self, model: Model, pieces: int = 10, steps: int = 800) -> None:
        self.model, self.field, self.pieces = model, VectorField(model), pieces
        self.per_piece = math.ceil(steps / pieces)

    @cached_property
    def _step(self) -> BufferedFunction:
        step = 1.0 / (self.pieces * self.per_piece)
        linearised = discretise(InPeriods(self.model), step).linearised()
        return BufferedFunction(linearised.map(self.pieces))

    def shoot(self, nodes: FloatArray, period: float, u: FloatArray) -> Pieces:
        """Motions from all nodes at once, with their slopes."""
        m, n, n_u = self.pieces, self.model.n_x, self.model.n_u
        step = self._step
        x, command, p, w = step.inputs
        x[...] = nodes.T
        command[...] = u[:, None]
        p[...] = np.append(self.field.parameters, period)[:, None]
        w[...] = 0.0
        by_state = np.broadcast_to(np.eye(n), (m, n, n)).copy()
        by_period, by_input = np.zeros((m, n)), np.zeros((m, n, n_u))
        path = np.empty((m, self.per_piece + 1, n))
        path[:, 0] = nodes
        after, slope, input_slope, parameter_slope, _ = step.outputs
        last = len(self.field.parameters)
        for k in range(self.per_piece):
            step()
            a = slope.reshape(n, n, m, order="F").transpose(2, 0, 1)
            b = input_slope.reshape(n, n_u, m, order="F").transpose(2, 0, 1)
            g = parameter_slope.reshape(n, last + 1, m, order="F")[:, last].T
            by_state = a @ by_state
            by_period = (a @ by_period[:, :, None])[:, :, 0] + g
            by_input = a @ by_input + b
            x[...] = after
            path[:, k + 1] = after.T
        return Pieces(path[:, -1].copy(), by_state, by_period, by_input, path)

    def find_orbit(
        self, nodes: FloatArray, period: float, u: FloatArray, *, row: BranchCondition | None = None
    ) -> Orbit | None:
        """The orbit near a guess of its nodes (m, n_x), period (s) and command, by Newton's method.

        The steps are damped; None where there is none. A ``row`` frees one command, and fixes the
        place on a branch of orbits instead.
        """
        anchor, direction = nodes[0].copy(), self.field.rates(nodes[0], u)
        size = float(np.linalg.norm(direction))
        if size < 1e-12:
            return None
        direction = direction / size
        widest = float(np.ptp(nodes, axis=0).max())
        z = pack_unknowns(nodes, period, u, None if row is None else row.channel)
        linearised = self._equations(z, u, anchor, direction, row)
        for _ in range(_ITERATIONS):
            if linearised is None:
                return None
            residual, slope, _ = linearised
            misfit = float(np.abs(residual).max())
            if misfit < _CLOSED:
                return self._orbit(z, u, row, misfit, linearised[2])
            change = np.linalg.lstsq(slope, residual, rcond=1e-13)[0]
            for halving in range(_HALVINGS):
                trial = z - change / 2.0**halving
                evaluation = self._equations(trial, u, anchor, direction, row)
                if evaluation is not None and np.abs(evaluation[0]).max() < misfit:
                    break
            else:
                # At the limit of rounding a step may not lessen what is small already.
                small = misfit < 1e3 * _CLOSED
                return self._orbit(z, u, row, misfit, linearised[2]) if small else None
            z, linearised = trial, evaluation
            now = z[: nodes.size].reshape(nodes.shape)
            if not _SHORTEST < z[nodes.size] / period < 1.0 / _SHORTEST or (
                row is None and np.ptp(now, axis=0).max() < _COLLAPSED * widest
            ):
                return None
        return None

    def _equations(
        self,
        z: FloatArray,
        u: FloatArray,
        anchor: FloatArray,
        direction: FloatArray,
        row: BranchCondition | None,
    ) -> tuple[FloatArray, FloatArray, Pieces] | None:
        """Residuals, their slopes and the pieces; None where a motion leaves all bounds."""
        m, n = self.pieces, self.model.n_x
        nodes, period, command = unpack_unknowns(z, m, n, u, row)
        if not (period > 0 and np.all(np.isfinite(z))):
            return None
        pieces = self.shoot(nodes, period, command)
        if not (np.all(np.isfinite(pieces.ends)) and np.all(np.isfinite(pieces.by_state))):
            return None
        following = np.roll(nodes, -1, axis=0)
        residual = [(pieces.ends - following).ravel(), [float(direction @ (nodes[0] - anchor))]]
        slope = np.zeros((m * n + 1, z.size))
        for i in range(m):
            rows = slice(i * n, (i + 1) * n)
            slope[rows, rows] = pieces.by_state[i]
            j = (i + 1) % m
            slope[rows, j * n : (j + 1) * n] -= np.eye(n)
            slope[rows, m * n] = pieces.by_period[i]
            if row is not None:
                slope[rows, m * n + 1] = pieces.by_input[i, :, row.channel]
        slope[m * n, :n] = direction
        if row is not None:
            residual.append([float(row.weights @ (z - row.place)) - row.length])
            slope = np.vstack([slope, row.weights])
        return np.concatenate([np.asarray(part, dtype=float) for part in residual]), slope, pieces

    def _orbit(
        self,
        z: FloatArray,
        u: FloatArray,
        row: BranchCondition | None,
        misfit: float,
        pieces: Pieces,
    ) -> Orbit:
        m, n = self.pieces, self.model.n_x
        nodes, period, command = unpack_unknowns(z, m, n, u, row)
        monodromy = np.eye(n)
        for i in range(m):
            monodromy = pieces.by_state[i] @ monodromy
        path = np.vstack([pieces.path[:, :-1].reshape(-1, n), pieces.path[-1, -1:]])
        values = np.linalg.eigvals(monodromy).astype(complex)
        # The one nearest to 1 first, the others by falling size.
        trivial = int(np.argmin(np.abs(values - 1.0)))
        others = np.delete(values, trivial)
        order = np.argsort(-np.abs(others), kind="stable")
        multipliers = np.concatenate([values[trivial : trivial + 1], others[order]])
        return Orbit(nodes, period, command, multipliers, path, misfit)


@dataclass(frozen=True)
class BranchCondition:
    """One more equation, which fixes the place on a branch while a command is free.

    ``weights · (z − place) = length``, z = [nodes, T, the free command].
    """

    channel: int  #: Of the command that is free
    weights: FloatArray  #: (m n_x + 2,) arrays
    place: FloatArray  #: (m n_x + 2,) arrays
    length: float


def pack_unknowns(nodes: FloatArray, period: float, u: FloatArray, free: int | None) -> FloatArray:
    """The unknowns as one vector, with the free command where there is one."""
    tail = [period] if free is None else [period, u[free]]
    return np.concatenate([nodes.ravel(), tail])


def unpack_unknowns(
    z: FloatArray, m: int, n: int, u: FloatArray, row: BranchCondition | None
) -> tuple[FloatArray, float, FloatArray]:
    """Nodes, period and command of a vector of unknowns."""
    command = u.copy()
    if row is not None:
        command[row.channel] = z[m * n + 1]
    return z[: m * n].reshape(m, n), float(z[m * n]), command


#: Name of the period among the parameters.
PERIOD = "the_period"


class InPeriods(Model):
    """A model with equations whose time is counted in periods; the period is its last parameter, s.

    What impulses, delays and sensors add to it is left out: f must be differentiable for the
    variational equations.
    """

    def __init__(self, base: Model) -> None:
        self.take_over(base)
        self.base = base
        self.parameters = base.parameters.concatenate([Parameter(PERIOD, 1.0, "s", lower=0.0)])

    def rest(self) -> FloatArray:
        return self.base.rest()

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n = len(self.base.parameters)
        return p[n] * self.base.dynamics(x, u, p[:n, 0], w)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return self.base.measurement(x, u, p[: len(self.base.parameters), 0])


Fate = Literal["rest", "settling", "cycle", "moves on", "leaves"]
FATES: tuple[Fate, ...] = ("rest", "settling", "cycle", "moves on", "leaves")

#: s between the states of a motion's path.
STEP = 0.02
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


@dataclass(frozen=True)
class OrbitSearch:
    """What a search found."""

    motions: Sequence[SearchMotion]
    orbits: Sequence[Orbit]  #: Different ones, by rising period
    #: Orbits that are not isolated, by rising period: no limit cycles, and none of ``orbits``
    continuum: Sequence[Orbit] = ()

    def count(self, fate: Fate) -> int:
        return sum(motion.fate == fate for motion in self.motions)


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


def half_widths(model: Model, x: FloatArray, overrides: Mapping[str, float]) -> FloatArray:
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
    for name, width in overrides.items():
        widths[model.state_index(name)] = width
    return widths


def search_orbits(
    model: Model,
    starts: FloatArray,
    u: FloatArray,
    duration: float,
    shooting: Shooting | None,
) -> OrbitSearch:
    """Motions from all starts (m, n_x), the command held, and the periodic orbits they lead to.

    Duration in s. Without ``shooting`` motions only: dry friction has no slopes.
    """
    paths = VectorField(model).motions(starts, u, duration, STEP)
    rows = [model.state_index(name) for name in model.controlled]
    motions, orbits = [], list[Orbit]()
    for i in range(starts.shape[0]):
        path = paths[:, i]
        fate = _fate(path[:, rows])
        row = rows[int(np.argmax(np.ptp(path[-len(path) // 4 :, rows], axis=0)))]
        if shooting is not None and fate != "leaves":
            attempts = _TRIED if fate == "moves on" else 1
            orbits += _find_orbits(shooting, path, row, u, attempts)
        if fate == "moves on" and _repeats(path, row):
            fate = "cycle"
        motions.append(SearchMotion(path, fate))
    every = different(orbits)
    family = continuum(every)
    isolated = [orbit for orbit in every if not any(orbit is one for one in family)]
    if shooting is not None:
        family = different([gone_round_once(shooting, orbit) for orbit in family])
    return OrbitSearch(motions, isolated, family)


def _fate(angles: FloatArray) -> Fate:
    n = len(angles)
    if not np.all(np.isfinite(angles)):
        return "leaves"
    last, before = angles[3 * n // 4 :], angles[n // 2 : 3 * n // 4]
    swing, earlier = (float(np.ptp(part, axis=0).max()) for part in (last, before))
    if swing > 2.0 * np.pi:
        return "leaves"
    if swing < _AT_REST:
        return "rest"
    return "settling" if swing < _SETTLING * earlier else "moves on"


def crossings(values: FloatArray) -> npt.NDArray[np.intp]:
    """Samples after which values rise through their middle of the last quarter."""
    tail = values[3 * len(values) // 4 :]
    middle = 0.5 * (tail.max() + tail.min())
    return np.flatnonzero((values[:-1] < middle) & (values[1:] >= middle))


def _repeats(path: FloatArray, row: int) -> bool:
    """Whether the end of a motion comes back to where it was, within 2 % of its swing."""
    at = crossings(path[:, row])
    swing = np.maximum(np.ptp(path[3 * len(path) // 4 :], axis=0), 1e-9)
    tail = path[3 * len(path) // 4 :, row]
    middle = 0.5 * (tail.max() + tail.min())
    # Between samples by the state itself: the crossing lies up to a step away.
    at = at[-2 * _LONGEST_RETURN - 1 :]
    share = (middle - path[at, row]) / (path[at + 1, row] - path[at, row])
    states = path[at] + share[:, None] * (path[at + 1] - path[at])
    return bool(np.any(np.abs(states[:-1] - states[-1:]).max(axis=1) < 0.02 * swing.max()))


def _find_orbits(
    shooting: Shooting, path: FloatArray, row: int, u: FloatArray, attempts: int
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
    for _, first, last in sorted(candidates)[:attempts]:
        stretch = path[first : last + 1]
        picked = np.linspace(0, last - first, shooting.pieces + 1)[:-1].round().astype(int)
        orbit = shooting.find_orbit(stretch[picked], (last - first) * STEP, u)
        if orbit is not None and orbit.swing.max() > _SMALLEST and orbit.trivial_error < 0.05:
            orbits.append(orbit)
    return orbits


def different(orbits: Sequence[Orbit]) -> list[Orbit]:
    """Each orbit once, gone around once, by rising period."""
    distinct_orbits: list[Orbit] = []
    for orbit in sorted(orbits, key=lambda one: one.period):
        if not any(_same(orbit, other) for other in distinct_orbits):
            distinct_orbits.append(orbit)
    return distinct_orbits


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
            once = shooting.find_orbit(orbit.path[picked], orbit.period / turns, orbit.u)
            return orbit if once is None else once
    return orbit


def _second_at_one(orbit: Orbit) -> bool:
    others = orbit.multipliers[1:]
    if not others.size:
        return False
    pair = np.array([orbit.multipliers[0], others[int(np.argmin(np.abs(others - 1.0)))]])
    return bool(np.abs(pair - 1.0).max() < _SPLIT and abs(pair.mean() - 1.0) < _MEAN)
