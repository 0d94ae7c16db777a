"""States at which V rises, found by search and confirmed in interval arithmetic."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.function import Candidate
from trms_cli.stability.lyapunov.search import rays
from trms_cli.stability.lyapunov.well import Wells

FloatArray = npt.NDArray[np.float64]

_RAYS = 1500
_PLACES = 16
_ROUNDS = 4
#: Step along a direction of unit energy at which Q is looked at again: V of some 0.01 J.
_FAR = 0.14


@dataclass(frozen=True)
class Rising:
    """A state at which V rises."""

    x: FloatArray  #: (n_x,) array
    y: FloatArray  #: (3k,) array; the same as a state of motion
    value: float  #: V in J and V̇ in W
    derivative: float  #: V̇ > 0 is confirmed with outward rounding

    @property
    def speed(self) -> float:
        """V̇/V, 1/s."""
        return self.derivative / self.value


def lowest_rising(candidate: Candidate, wells: Wells, ceiling: float) -> Rising | None:
    """The state of lowest V found at which V̇ > 0; None where none is found below the ceiling.

    Parameters
    ----------
    candidate : Candidate
    wells : Wells
    ceiling : float
        J.
    """
    y, k = candidate.centre, candidate.energy.k
    directions = np.concatenate([rays(candidate, _RAYS), _weak(candidate, _FAR)])
    lowest, best = ceiling, None
    reaches = np.geomspace(1e-3, 1.3, _PLACES)
    for turn in range(_ROUNDS):
        steps = math.sqrt(2.0 * lowest) * reaches
        places = (y + directions[:, None, :] * steps[:, None]).reshape(-1, 3 * k)
        angles = places[:, 2 * k :]
        within = ((angles > wells.ends.lower) & (angles < wells.ends.upper)).all(axis=1)
        places = places[within]
        states = candidate.states(places)
        values, rates = candidate.value(places), candidate.derivative(states)
        rises = (rates > 0.0) & (values < lowest)
        if not rises.any():
            break
        at = int(np.argmin(np.where(rises, values, np.inf)))
        found = _confirmed(candidate, states[at], places[at])
        if found is None:
            break
        lowest, best = found.value, found
        # Again around it, ever closer.
        along = (places[at] - y) / math.sqrt(2.0 * lowest)
        spread = np.random.default_rng(turn).normal(size=(_RAYS, 3 * k)) * 0.5 / (1 + turn)
        directions = along * (1.0 + spread)
        reaches = np.linspace(0.6, 1.0, _PLACES)
    return best


def fastest_rising(candidate: Candidate, wells: Wells, ceiling: float) -> Rising | None:
    """Where V falls in no neighbourhood: the state on {V ≈ ceiling/100} with the largest V̇/V."""
    y, k = candidate.centre, candidate.energy.k
    step = math.sqrt(0.02 * ceiling)
    directions = np.concatenate([rays(candidate, _RAYS), _weak(candidate, step)])
    best: Rising | None = None
    for turn in range(_ROUNDS):
        places = y + step * directions
        states = candidate.states(places)
        values, rates = candidate.value(places), candidate.derivative(states)
        angles = places[:, 2 * k :]
        within = ((angles > wells.ends.lower) & (angles < wells.ends.upper)).all(axis=1)
        quality = np.where(within & (rates > 0.0), rates / np.maximum(values, 1e-300), -np.inf)
        at = int(np.argmax(quality))
        if not quality[at] > 0.0:
            break
        found = _confirmed(candidate, states[at], places[at])
        if found is not None and (best is None or found.speed > best.speed):
            best = found
        spread = np.random.default_rng(turn).normal(size=(_RAYS, 3 * k)) * 0.5 / (1 + turn)
        directions = np.concatenate([directions[at] * (1.0 + spread), directions[at : at + 1]])
    return best


def _weak(candidate: Candidate, step: float) -> FloatArray:
    """Directions in which Q is least, at the equilibrium and where that has led: (m, 3k).

    Scaled so that V is about ½ at a step of one.
    """
    size = 3 * candidate.energy.k
    found = [np.eye(size)[i] * sign for i in range(size) for sign in (-1.0, 1.0)]
    at_rest = _least(candidate, candidate.centre)
    found += [at_rest, -at_rest]
    found = [_scaled(candidate, direction) for direction in found]
    for start in tuple(found):
        direction = start
        for _ in range(2):
            place = candidate.centre + step * direction
            least = _least(candidate, place)
            least = least if float(least @ direction) >= 0.0 else -least
            direction = _scaled(candidate, least)
            found.append(direction)
    return np.array(found)


def _least(candidate: Candidate, y: FloatArray) -> FloatArray:
    """The deviation with the eigenvector of Q(y) that falls least, its rotors by their slope."""
    energy, k = candidate.energy, candidate.energy.k
    _, vectors = np.linalg.eigh(candidate.matrices(Interval.point(y[None])).middle[0])
    z = np.concatenate([vectors[:, 0], np.zeros(3 * k - len(vectors))])
    slopes = []
    for a in energy.axes:
        speed = ca.SX.sym("speed")
        slope = ca.jacobian(energy.settling(a, speed), speed)
        at = float(candidate.centre[energy.index("omega", a)])
        slopes.append(float(ca.Function("slope", [speed], [slope])(at)))
    return np.concatenate([z[:k], z[k : 2 * k] / np.array(slopes), z[2 * k :]])


def _scaled(candidate: Candidate, direction: FloatArray) -> FloatArray:
    value = float(candidate.value(candidate.centre + 1e-3 * direction)[0])
    return np.asarray(direction * 1e-3 * math.sqrt(0.5 / max(value, 1e-300)))


def _confirmed(candidate: Candidate, x: FloatArray, y: FloatArray) -> Rising | None:
    """The state, if V̇ > 0 there without doubt."""
    bounds = Enclosure(candidate.energy.derivative)(
        Interval.point(x[None]), candidate.rest, Interval.point(candidate.weights.array())
    )[0]
    if not bounds.lower[0, 0] > 0.0:
        return None
    rate = float(candidate.derivative(x)[0])
    return Rising(x, y, float(candidate.value(y)[0]), rate)
