"""V along motions of the model: what the proofs say, seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.models.model import Model
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.lyapunov.candidate import EnergyCandidate
from trms_cli.stability.lyapunov.certificate import StabilityClaim
from trms_cli.stability.lyapunov.level_search import Wells, rays

_STEP = 0.05
_DOUBLINGS = 60
_HALVINGS = 50
#: Rise of V, as a share of its level at the start, that the integrator's error may make.
_ERROR = 1e-6


@dataclass(frozen=True)
class LevelMotions:
    """Motions from one level set."""

    time: FloatArray  #: (n,) array; s
    y: FloatArray  #: (n, m, 3k) array; states of motion
    value: FloatArray  #: (n, m) array; V, J
    level: float  #: V at the start, J

    @property
    def rise(self) -> float:
        """The largest rise of V above anything it was before, as a share of the level."""
        before = np.minimum.accumulate(self.value, axis=0)
        return float(np.max(self.value - before) / self.level)

    @property
    def left(self) -> float:
        """The largest share of V that is left at the end."""
        return float(np.max(self.value[-1]) / self.level)


def on_level(
    candidate: EnergyCandidate, wells: Wells, level: float, directions: FloatArray
) -> FloatArray:
    """States of motion with V = level, one on each ray that meets it in the well: (m, 3k)."""
    y, k = candidate.centre, candidate.energy.k
    angles = directions[:, 2 * k :]
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.where(
            angles > 0.0,
            (wells.ends.upper - y[2 * k :]) / angles,
            (wells.ends.lower - y[2 * k :]) / angles,
        )
    ends = np.where(angles == 0.0, np.inf, ends).min(axis=1)

    def below(steps: FloatArray) -> BoolArray:
        return np.asarray(candidate.value(y + steps[:, None] * directions) < level)

    low, high = np.zeros(len(directions)), np.minimum(1e-3, ends)
    for _ in range(_DOUBLINGS):
        short = below(high) & (high < ends)
        if not short.any():
            break
        low = np.where(short, high, low)
        high = np.where(short, np.minimum(2.0 * high, ends), high)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        under = below(middle)
        low, high = np.where(under, middle, low), np.where(under, high, middle)
    found = y + low[:, None] * directions
    return np.asarray(found[np.abs(candidate.value(found) - level) < 1e-6 * level])


def plane_directions(candidate: EnergyCandidate, axis: str, count: int) -> FloatArray:
    """Directions in the plane of one angle and its rate, the rotors settled: (count, 3k)."""
    energy = candidate.energy
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) + 0.3
    found = np.zeros((count, 3 * energy.k))
    found[:, energy.index("alpha", axis)] = 0.5 * np.cos(turn)
    found[:, energy.index("Omega", axis)] = np.sin(turn)
    return found


def random_directions(candidate: EnergyCandidate, count: int, seed: int) -> FloatArray:
    """Directions all round, (count, 3k)."""
    return rays(candidate, count, seed)


def motions(
    candidate: EnergyCandidate, model: Model, starts: FloatArray, level: float, duration: float
) -> LevelMotions:
    """Motions of a model, with its effects, from states of motion (m, 3k)."""
    states = candidate.states(starts)
    n = states.shape[1]
    whole = np.tile(model.rest(), (len(states), 1))
    whole[:, :n] = states
    path = VectorField(model).motions(whole, candidate.energy.u, duration, _STEP)
    count, m = path.shape[:2]
    y = candidate.motions(path[:, :, :n].reshape(-1, n)).reshape(count, m, -1)
    value = candidate.value(y.reshape(count * m, -1)).reshape(count, m)
    return LevelMotions(np.linspace(0.0, _STEP * (count - 1), count), y, value, level)


def motions_claim(seen: LevelMotions, duration: float) -> StabilityClaim:
    """Whether V fell along all of them."""
    good = bool(np.isfinite(seen.value).all()) and seen.rise <= _ERROR
    return StabilityClaim(
        "seen",
        f"Along {seen.value.shape[1]} motions from the edge of N′ V falls and none leaves N′",
        "simulated" if good else "failed",
        f"largest rise {seen.rise:.1g} of the level; at most {100 * seen.left:.2g} % of V is left "
        f"after {duration:g} s",
    )
