"""Equilibria over one command, the Hopf points among them, and the branches of cycles born there.

At a Hopf bifurcation a pair of eigenvalues ±jω crosses the imaginary axis, and a cycle of period
2π/ω is born. It is unstable and exists on the side where the equilibrium is stable (subcritical),
or the other way round (supercritical). The branch is followed by its arc length (Keller 1977), so
that it goes around folds, where a stable and an unstable cycle meet and vanish.

On a switch, where the slopes of the two sides differ, the eigenvalues are those of their mean
(:mod:`trms_cli.stability.local.linear`), as in the other studies.

After Kuznetsov (2004), ch. 3.4 and 10.2.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from trms_cli.core.arrays import BoolArray, ComplexArray, FloatArray
from trms_cli.models.continuation import follow
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, refine_operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.cycles.orbits import MARGIN, BranchCondition, Orbit, Shooting, pack_unknowns
from trms_cli.stability.local.linear import Linear

#: V, between two equilibria over a command at the most.
_STEP = 0.02
#: Growth below this is rounding, 1/s.
_NO_GROWTH = 1e-9


@dataclass(frozen=True)
class EquilibriumBranch:
    """Equilibria over one command, the others held."""

    commands: FloatArray  #: (n,) array; V, rising
    x: FloatArray  #: (n, n_x) array
    #: (n,) array; largest real part of the eigenvalues, 1/s; directions that nothing pulls back
    #: left out
    growth: FloatArray


@dataclass(frozen=True)
class Hopf:
    """Where a pair of eigenvalues crosses the imaginary axis."""

    x: FloatArray  #: The equilibrium
    u: FloatArray  #: The equilibrium
    omega: float  #: rad/s
    #: (n_x,) complex array; the eigenvector, its largest entry of size 1
    mode: ComplexArray


def equilibria_over(model: Model, x: FloatArray, u: FloatArray, channel: int) -> EquilibriumBranch:
    """The equilibria that one is part of, over a command, as far as they go within its limits."""
    field = VectorField(model)
    places = [(float(u[channel]), x)]
    for direction in (1.0, -1.0):
        places += _one_way(field, x, u, channel, direction)
    linear = Linear(model)
    commands, states = (np.array(side) for side in zip(*places, strict=True))
    order = np.argsort(commands)
    along, equilibria = commands[order], states[order]
    pairs = zip(equilibria, along, strict=True)
    growth = np.array([_growth(linear, row, _with(u, channel, v)) for row, v in pairs])
    return EquilibriumBranch(along, equilibria, growth)


def _one_way(
    field: VectorField, x: FloatArray, u: FloatArray, channel: int, direction: float
) -> Iterator[tuple[float, FloatArray]]:
    """Commands and equilibria from one on, up to the command's limit."""
    low, high = (float(bound[channel]) for bound in field.model.input_bounds())

    def attempt(
        place: tuple[float, FloatArray, FloatArray], ahead: float
    ) -> tuple[tuple[float, FloatArray, FloatArray] | None, float]:
        at, here, slope = place
        goal = float(np.clip(at + direction * ahead, low, high))
        increment = abs(goal - at)
        following = refine_operating_point(field, here + slope * increment, _with(u, channel, goal))
        bound = 0.2 + 20.0 * increment * (1.0 + float(np.abs(here).max()))
        if following is None or np.abs(following - here).max() > bound:
            return None, ahead / 2.0
        slope = (following - here) / increment if increment else slope
        return (goal, following, slope), min(2.0 * ahead, _STEP)

    for at, here, _ in follow((float(u[channel]), x, np.zeros_like(x)), attempt, _STEP, 1e-4):
        yield at, here
        if at == (high if direction > 0 else low):
            return


def hopf_points(model: Model, curve: EquilibriumBranch, u: FloatArray, channel: int) -> list[Hopf]:
    """Where a complex pair crosses along a curve of equilibria, by bisection."""
    field, linear = VectorField(model), Linear(model)
    points = []
    # Growth that is rounding has no sign: a pair that stays on the axis crosses it nowhere.
    clear = np.flatnonzero(np.abs(curve.growth) > _NO_GROWTH)
    for i, j in pairwise(clear):
        if (curve.growth[i] < 0) == (curve.growth[j] < 0):
            continue
        low, high = curve.commands[i], curve.commands[j]
        x, sign = curve.x[i], curve.growth[i] < 0
        for _ in range(40):
            middle = 0.5 * (low + high)
            trial = refine_operating_point(field, x, _with(u, channel, middle))
            if trial is None:
                break
            if (_growth(linear, trial, _with(u, channel, middle)) < 0) == sign:
                low, x = middle, trial
            else:
                high = middle
        at = _with(u, channel, low)
        values, vectors = (part.astype(complex) for part in np.linalg.eig(linear.a(x, at)))
        k = int(np.argmax(np.where(_pulled(values), values.real, -np.inf)))
        if abs(values[k].imag) < 1e-6:
            continue  # a real eigenvalue: a fold of equilibria
        mode = vectors[:, k] if values[k].imag > 0 else vectors[:, k].conj()
        mode = mode / mode[int(np.argmax(np.abs(mode)))]
        points.append(Hopf(x, at, float(abs(values[k].imag)), mode))
    return points


def _with(u: FloatArray, channel: int, value: float) -> FloatArray:
    changed = u.copy()
    changed[channel] = value
    return changed


def _pulled(values: ComplexArray) -> BoolArray:
    """Eigenvalues but those of a direction in which nothing changes."""
    return np.asarray(np.abs(values) > 1e-9)


def _growth(linear: Linear, x: FloatArray, u: FloatArray) -> float:
    values = np.linalg.eigvals(linear.a(x, u)).astype(complex)
    nonzero_values = values[_pulled(values)]
    return float(nonzero_values.real.max()) if nonzero_values.size else 0.0


Kind = Literal["fold", "period doubling", "torus"]

#: Swing of the first cycle beside a Hopf point, rad (or the unit of the largest state); doubled
#: where none is reached.
_BORN = 0.02
#: Step along the branch, in shares of the orbit's scales: first, least, most.
_FIRST_STEP, _LEAST_STEP, _MOST_STEP = 0.05, 1e-4, 0.25
#: The same where the branch turns back in the command.
_TURNING_STEP = 0.03
#: Errors of the trivial multiplier by which another one differs from 1, to be told from it.
_RESOLVED = 3.0
#: V, that counts as much along the branch as a change by the scale of a state.
_COMMAND_SCALE = 0.1
#: Beyond this many first periods, or this error of the trivial multiplier, it is not followed.
_LONGEST, _WORST_TRIVIAL = 3.0, 1e-2
#: A branch is followed to this many swings of a state beyond its stops.
_BEYOND_STOPS = 1.5


@dataclass(frozen=True)
class Change:
    """Where the stability of the cycles of a branch changes, between two of its orbits."""

    #: ``fold``: a multiplier passes +1; ``period doubling``: −1; ``torus``: a pair passes the
    #: circle elsewhere
    kind: Kind
    command: float  #: By interpolation. V, s, rad.
    period: float  #: By interpolation. V, s, rad.
    swing: float  #: By interpolation. V, s, rad.
    lowest: float  #: Of the state, likewise
    highest: float  #: Of the state, likewise
    after: int = 0  #: Position of the orbit before it


@dataclass(frozen=True)
class Branch:
    """Orbits in their order along a branch."""

    orbits: Sequence[Orbit]
    stop_reason: str  #: Why it was not followed further

    def commands(self, channel: int) -> FloatArray:
        """V, (n,)."""
        return np.array([orbit.u[channel] for orbit in self.orbits])

    def changes(self, channel: int, state: int) -> list[Change]:
        """Folds, period doublings and tori."""
        changes = []
        rows = np.array([_row(orbit, channel, state) for orbit in self.orbits])
        for i, (one, other) in enumerate(pairwise(self.orbits)):
            # Whether the command turns back about the step after an orbit.
            steps = np.diff(rows[max(i - 1, 0) : i + 3, 0])
            turns = bool(steps.min() < 0.0 < steps.max())
            unsure = _unresolved(one) and _unresolved(other) and not turns
            if unsure or _outside(one) == _outside(other):
                continue
            before, after = abs(one.largest), abs(other.largest)
            share = (1.0 - before) / (after - before) if after != before else 0.5
            share = min(max(share, 0.0), 1.0)
            kind = _kind(one.largest if abs(before - 1) < abs(after - 1) else other.largest)
            values = rows[i] + share * (rows[i + 1] - rows[i])
            if kind == "fold" and 0 < i < len(rows) - 2:
                values = _turn(rows[i - 1 : i + 3])
            command, period, swing, lowest, highest = values.tolist()
            changes.append(Change(kind, command, period, swing, lowest, highest, after=i))
        return changes

    def stable(self) -> BoolArray:
        """Of each orbit; one whose multiplier is not resolved from 1 is as the nearest that is."""
        stable = np.array([orbit.stable for orbit in self.orbits], dtype=bool)
        clear = np.flatnonzero([not _unresolved(orbit) for orbit in self.orbits])
        if not clear.size:
            return stable
        nearest = np.abs(np.arange(len(stable))[:, None] - clear[None, :]).argmin(axis=1)
        return np.asarray(stable[clear[nearest]])


def _row(orbit: Orbit, channel: int, state: int) -> list[float]:
    """Command, period, swing, lowest and highest of an orbit."""
    values = orbit.path[:, state]
    low, high = float(values.min()), float(values.max())
    return [float(orbit.u[channel]), orbit.period, high - low, low, high]


def _turn(rows: FloatArray) -> FloatArray:
    """Where the command turns back among four rows: the vertex of a parabola over the swing."""
    swing = rows[:, 2]
    a, b, _ = np.polyfit(swing, rows[:, 0], 2)
    at = float(np.clip(-b / (2.0 * a), swing.min(), swing.max())) if a else float(swing[1])
    return np.array([np.polyval(np.polyfit(swing, column, 2), at) for column in rows.T])


def _unresolved(orbit: Orbit) -> bool:
    """Whether the largest multiplier is as near to 1 as the one along the orbit is known."""
    return bool(abs(abs(orbit.largest) - 1.0) < _RESOLVED * orbit.trivial_error)


def _outside(orbit: Orbit) -> int:
    return int(np.sum(np.abs(orbit.multipliers[1:]) > 1.0 + MARGIN))


def _kind(multiplier: complex) -> Kind:
    if abs(multiplier.imag) > 1e-3 * abs(multiplier):
        return "torus"
    return "fold" if multiplier.real > 0 else "period doubling"


def born_at(shooting: Shooting, hopf: Hopf, channel: int, limits: int) -> Branch:
    """The branch of cycles that begins at a Hopf point, of ``limits`` orbits at most."""
    m = shooting.pieces
    turn = np.exp(2j * np.pi * np.arange(m) / m)
    away = np.real(turn[:, None] * hopf.mode[None, :])
    period = 2.0 * math.pi / hopf.omega
    place = pack_unknowns(np.tile(hopf.x, (m, 1)), period, hopf.u, channel)
    direction = np.concatenate([away.ravel(), [0.0, 0.0]])
    weights = direction / float(direction @ direction)
    first = None
    size = 0.5 * _BORN
    # Where the model's slope jumps at the equilibrium, only a cycle that is large beside the shift
    # of the Hopf point between the two sides can be reached from there.
    for _ in range(5):
        row = BranchCondition(channel, weights, place, size)
        first = shooting.find_orbit(hopf.x + size * away, period, hopf.u, row=row)
        if first is not None:
            break
        size *= 2.0
    if first is None:
        return Branch([], "no cycle closed beside the Hopf point")
    return follow_branch(shooting, first, channel, limits, before=place)


def follow_branch(
    shooting: Shooting,
    first: Orbit,
    channel: int,
    limits: int,
    *,
    before: FloatArray | None = None,
    towards: float = 1.0,
) -> Branch:
    """A branch from an orbit on, away from a place on it ``before`` the first orbit.

    ``towards``: without such a place: the sign by which the command changes first.
    """
    model = shooting.model
    low, high = (float(bound[channel]) for bound in model.input_bounds())
    scale = _scale(first)
    orbits = [first]
    z = pack_unknowns(first.nodes, first.period, first.u, channel)
    if before is None:
        u = first.u.copy()
        u[channel] += towards * 0.005
        second = shooting.find_orbit(first.nodes, first.period, u)
        if second is None:
            return Branch(orbits, "the next orbit was not found")
        orbits.append(second)
        before, z = z, pack_unknowns(second.nodes, second.period, second.u, channel)

    def attempt(
        place: tuple[Orbit, FloatArray, FloatArray], step: float
    ) -> tuple[tuple[Orbit, FloatArray, FloatArray] | None, float]:
        last, z, before = place
        secant = (z - before) / scale
        tangent = secant / float(np.linalg.norm(secant))
        guess = z + step * tangent * scale
        command = last.u.copy()
        command[channel] = guess[-1]
        trial = shooting.find_orbit(
            guess[:-2].reshape(last.nodes.shape),
            float(guess[-2]),
            command,
            row=BranchCondition(channel, tangent / scale, z, step),
        )
        turned = trial is not None and float((trial.u - last.u)[channel] * (z - before)[-1]) < 0.0
        if turned and step > _TURNING_STEP:
            # A fold lies here: come up to it in small steps.
            return None, max(step / 3.0, _TURNING_STEP)
        swing_change = None if trial is None else np.abs(trial.swing - last.swing).max()
        if (
            trial is None
            or trial.swing.max() < 1e-4
            or swing_change > 0.3 + 4.0 * step * last.swing.max()
        ):
            # None, the equilibrium, or an orbit of another branch.
            return None, step / 2.0
        at = pack_unknowns(trial.nodes, trial.period, trial.u, channel)
        return (trial, at, z), min(1.4 * step, _MOST_STEP)

    stop_reason = "Newton's method found no next orbit"
    for trial, _, _ in follow((orbits[-1], z, before), attempt, _FIRST_STEP, _LEAST_STEP):
        if trial.swing.max() < 0.25 * _BORN:
            stop_reason = "the cycle shrinks to a point: a Hopf bifurcation"
            break
        orbits.append(trial)
        if not low <= trial.u[channel] <= high:
            stop_reason = "the command's limit"
            break
        if trial.period > _LONGEST * first.period:
            stop_reason = (
                f"the period grows beyond {trial.period:.3g} s: the orbit draws near to one that "
                "leaves an equilibrium and returns to it (homoclinic)"
            )
            break
        if trial.trivial_error > _WORST_TRIVIAL:
            orbits.pop()
            stop_reason = "the orbit is too unstable to be known well"
            break
        if _beyond(model, trial):
            stop_reason = "far beyond the mechanical stops"
            break
        if len(orbits) >= limits:
            stop_reason = f"{limits} orbits"
            break
    return Branch(orbits, stop_reason)


def _scale(orbit: Orbit) -> FloatArray:
    """By what a change of each unknown is measured."""
    swings = np.maximum(np.maximum(orbit.swing, 0.5), 0.3 * np.abs(orbit.path).max(axis=0))
    each = np.tile(swings, (len(orbit.nodes), 1)).ravel() * math.sqrt(len(orbit.nodes))
    return np.concatenate([each, [orbit.period, _COMMAND_SCALE]])


def _beyond(model: Model, orbit: Orbit) -> bool:
    return any(
        float(np.abs(orbit.path[:, model.state_index(name)]).max()) > _BEYOND_STOPS * stop
        for name, stop in model.stops.items()
        if name in model.state_names
    )


#: Part of the period and of the swings by which an orbit may be off between its neighbours.
_NEAR = 0.02


@dataclass(frozen=True)
class OverCommand:
    """What there is over a command."""

    curve: EquilibriumBranch  #: Equilibria, as far as the stops
    hopfs: Sequence[Hopf]  #: Within the stops
    #: One for each Hopf point, then those of orbits that are on none of these
    branches: Sequence[Branch]


def follow_over(
    model: Model,
    point: OperatingPoint,
    channel: int,
    orbits: Sequence[Orbit],
    shooting: Shooting | None,
    limit: int,
) -> OverCommand:
    """Equilibria over a command, the Hopf points on them, and all branches of cycles.

    ``orbits`` were found otherwise, at the point's command; without ``shooting`` no cycle can be;
    ``limit``: most orbits of a branch.
    """
    curve = _within_stops(model, equilibria_over(model, point.x, point.u, channel), point)
    hopfs = hopf_points(model, curve, point.u, channel)
    branches: list[Branch] = []
    if shooting is not None:
        branches = [born_at(shooting, hopf, channel, limit) for hopf in hopfs]
        for orbit in orbits:
            if not any(_on(branch, orbit, channel) for branch in branches):
                one, other = (
                    follow_branch(shooting, orbit, channel, limit, towards=sign)
                    for sign in (-1.0, 1.0)
                )
                whole = [*reversed(one.orbits), *other.orbits[1:]]
                branches.append(Branch(whole, f"{one.stop_reason}; {other.stop_reason}"))
    return OverCommand(curve, hopfs, branches)


def at_the_point(
    shooting: Shooting, branches: Sequence[Branch], channel: int, u: FloatArray
) -> list[Orbit]:
    """The orbits of branches at one command, closed between their neighbours."""
    orbits = []
    for branch in branches:
        for one, other in pairwise(branch.orbits):
            before, after = float(one.u[channel] - u[channel]), float(other.u[channel] - u[channel])
            if before * after > 0.0 or before == after:
                continue
            share = before / (before - after)
            nodes = one.nodes + share * (other.nodes - one.nodes)
            orbit = shooting.find_orbit(nodes, one.period + share * (other.period - one.period), u)
            if orbit is not None:
                orbits.append(orbit)
    return orbits


def _within_stops(
    model: Model, curve: EquilibriumBranch, point: OperatingPoint
) -> EquilibriumBranch:
    is_within = np.ones(len(curve.commands), dtype=bool)
    for name, stop in model.stops.items():
        if name in model.state_names:
            is_within &= np.abs(curve.x[:, model.state_index(name)]) <= stop
    if not is_within.any():
        return curve
    return EquilibriumBranch(curve.commands[is_within], curve.x[is_within], curve.growth[is_within])


def _on(branch: Branch, orbit: Orbit, channel: int) -> bool:
    """Whether an orbit is one of a branch: between two neighbours in command, period and swing."""
    for one, other in pairwise(branch.orbits):
        low, high = sorted((one.u[channel], other.u[channel]))
        if not low - 1e-9 <= orbit.u[channel] <= high + 1e-9:
            continue
        share = (orbit.u[channel] - one.u[channel]) / max(high - low, 1e-12)
        share = abs(float(share))
        period = one.period + share * (other.period - one.period)
        swing = one.swing + share * (other.swing - one.swing)
        if abs(period - orbit.period) < _NEAR * orbit.period and np.allclose(
            swing, orbit.swing, rtol=_NEAR, atol=0.02 * float(orbit.swing.max())
        ):
            return True
    return False
