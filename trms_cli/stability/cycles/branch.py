"""Branches of periodic orbits over a command, from a Hopf bifurcation or from a known orbit.

At a Hopf bifurcation a pair of eigenvalues ±jω crosses the imaginary axis, and a cycle of period
2π/ω is born. It is unstable and exists on the side where the equilibrium is stable (subcritical),
or the other way round (supercritical). The branch is followed by its arc length (Keller 1977), so
that it goes around folds, where a stable and an unstable cycle meet and vanish.

After Kuznetsov (2004), ch. 3.4 and 10.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.stability.cycles.hopf import Hopf
from trms_cli.stability.cycles.shooting import MARGIN, Orbit, Row, Shooting, packed

FloatArray = npt.NDArray[np.float64]
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
    ended: str  #: Why it was not followed further

    def commands(self, channel: int) -> FloatArray:
        """V, (n,)."""
        return np.array([orbit.u[channel] for orbit in self.orbits])

    def changes(self, channel: int, state: int) -> list[Change]:
        """Folds, period doublings and tori."""
        found = []
        for i in range(len(self.orbits) - 1):
            one, other = self.orbits[i : i + 2]
            if _outside(one) == _outside(other) or (
                _unresolved(one) and _unresolved(other) and not self._turns(i, channel)
            ):
                continue
            before, after = abs(one.largest), abs(other.largest)
            share = (1.0 - before) / (after - before) if after != before else 0.5
            share = min(max(share, 0.0), 1.0)
            kind = _kind(one.largest if abs(before - 1) < abs(after - 1) else other.largest)
            rows = np.array([_row(orbit, channel, state) for orbit in self.orbits])
            values = rows[i] + share * (rows[i + 1] - rows[i])
            if kind == "fold" and 0 < i < len(rows) - 2:
                values = _turn(rows[i - 1 : i + 3])
            command, period, swing, lowest, highest = values.tolist()
            found.append(Change(kind, command, period, swing, lowest, highest, after=i))
        return found

    def stable(self) -> npt.NDArray[np.bool_]:
        """Of each orbit; one whose multiplier is not resolved from 1 is as the nearest that is."""
        told = np.array([orbit.stable for orbit in self.orbits], dtype=bool)
        clear = np.flatnonzero([not _unresolved(orbit) for orbit in self.orbits])
        if not clear.size:
            return told
        nearest = np.abs(np.arange(len(told))[:, None] - clear[None, :]).argmin(axis=1)
        return np.asarray(told[clear[nearest]])

    def _turns(self, i: int, channel: int) -> bool:
        """Whether the command turns back about the step after an orbit."""
        steps = np.diff(self.commands(channel)[max(i - 1, 0) : i + 3])
        return bool(steps.min() < 0.0 < steps.max())


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
    """The branch of cycles that begins at a Hopf point.

    Parameters
    ----------
    limits : int
        Most orbits.
    """
    m = shooting.pieces
    turn = np.exp(2j * np.pi * np.arange(m) / m)
    away = np.real(turn[:, None] * hopf.mode[None, :])
    period = 2.0 * math.pi / hopf.omega
    place = packed(np.tile(hopf.x, (m, 1)), period, hopf.u, _nowhere(channel))
    direction = np.concatenate([away.ravel(), [0.0, 0.0]])
    weights = direction / float(direction @ direction)
    first = None
    size = 0.5 * _BORN
    # Where the model's slope jumps at the equilibrium, only a cycle that is large beside the shift
    # of the Hopf point between the two sides can be reached from there.
    for _ in range(5):
        row = Row(channel, weights, place, size)
        first = shooting.closed(hopf.x + size * away, period, hopf.u, row=row)
        if first is not None:
            break
        size *= 2.0
    if first is None:
        return Branch([], "no cycle closed beside the Hopf point")
    return followed(shooting, first, channel, limits, before=place)


def _nowhere(channel: int) -> Row:
    return Row(channel, np.zeros(0), np.zeros(0), 0.0)


def followed(
    shooting: Shooting,
    first: Orbit,
    channel: int,
    limits: int,
    *,
    before: FloatArray | None = None,
    towards: float = 1.0,
) -> Branch:
    """A branch from an orbit on.

    Parameters
    ----------
    before : array, optional
        A place on the branch before the first orbit, from which it is followed away.
    towards : float
        Without such a place: the sign by which the command changes first.
    """
    model = shooting.model
    low, high = (float(bound[channel]) for bound in model.input_bounds())
    row = _nowhere(channel)
    scale = _scale(first)
    orbits = [first]
    z = packed(first.nodes, first.period, first.u, row)
    if before is None:
        u = first.u.copy()
        u[channel] += towards * 0.005
        second = shooting.closed(first.nodes, first.period, u)
        if second is None:
            return Branch(orbits, "the next orbit was not found")
        orbits.append(second)
        before, z = z, packed(second.nodes, second.period, second.u, row)
    step, ended = _FIRST_STEP, f"{limits} orbits"
    while len(orbits) < limits:
        secant = (z - before) / scale
        tangent = secant / float(np.linalg.norm(secant))
        guess = z + step * tangent * scale
        m, n = shooting.pieces, model.n_x
        command = orbits[-1].u.copy()
        command[channel] = guess[m * n + 1]
        trial = shooting.closed(
            guess[: m * n].reshape(m, n),
            float(guess[m * n]),
            command,
            row=Row(channel, tangent / scale, z, step),
        )
        turned = (
            trial is not None
            and float((trial.u - orbits[-1].u)[channel] * (z - before)[m * n + 1]) < 0.0
        )
        if turned and step > _TURNING_STEP:
            # A fold lies here: come up to it in small steps.
            step = max(step / 3.0, _TURNING_STEP)
            continue
        if trial is None or _jumped(orbits[-1], trial, step):
            step /= 2.0
            if step < _LEAST_STEP:
                ended = "Newton's method found no next orbit"
                break
            continue
        if trial.swing.max() < 0.25 * _BORN:
            ended = "the cycle shrinks to a point: a Hopf bifurcation"
            break
        before, z = z, packed(trial.nodes, trial.period, trial.u, row)
        orbits.append(trial)
        step = min(1.4 * step, _MOST_STEP)
        if not low <= trial.u[channel] <= high:
            ended = "the command's limit"
            break
        if trial.period > _LONGEST * first.period:
            ended = (
                f"the period grows beyond {trial.period:.3g} s: the orbit draws near to one that "
                "leaves an equilibrium and returns to it (homoclinic)"
            )
            break
        if trial.trivial_error > _WORST_TRIVIAL:
            orbits.pop()
            ended = "the orbit is too unstable to be known well"
            break
        if _beyond(model, trial):
            ended = "far beyond the mechanical stops"
            break
    return Branch(orbits, ended)


def _scale(orbit: Orbit) -> FloatArray:
    """By what a change of each unknown is measured."""
    swings = np.maximum(np.maximum(orbit.swing, 0.5), 0.3 * np.abs(orbit.path).max(axis=0))
    each = np.tile(swings, (len(orbit.nodes), 1)).ravel() * math.sqrt(len(orbit.nodes))
    return np.concatenate([each, [orbit.period, _COMMAND_SCALE]])


def _jumped(one: Orbit, other: Orbit, step: float) -> bool:
    """Whether another branch was found, or the equilibrium, instead of the next orbit."""
    if other.swing.max() < 1e-4:
        return True
    return bool(np.abs(other.swing - one.swing).max() > 0.3 + 4.0 * step * one.swing.max())


def _beyond(model: Model, orbit: Orbit) -> bool:
    return any(
        float(np.abs(orbit.path[:, model.state_index(name)]).max()) > _BEYOND_STOPS * stop
        for name, stop in model.stops.items()
        if name in model.state_names
    )
