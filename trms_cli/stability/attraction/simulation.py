"""The region of attraction itself, by simulation: which starts come to rest at the equilibrium.

A motion has come to rest as soon as it has entered a set that is proved to be attracted; before
that it may have left for good (far outside the box) or be undecided when the time is over. The
equations are integrated as the model's simulation integrates them, without dry friction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise
from trms_cli.models.operating_point import refined
from trms_cli.models.vector_field import LONGEST_STEP, VectorField, without_impulses
from trms_cli.stability.attraction.estimates import RegionEstimate
from trms_cli.stability.attraction.inclusion import from_lyapunov_equation
from trms_cli.stability.attraction.system import ReducedSystem

IntArray = npt.NDArray[np.int8]
Inside = Callable[[FloatArray], BoolArray]

#: What became of a motion.
SETTLED, UNDECIDED, LEFT = 1, 0, -1
#: Motions that are integrated at once: one compiled function for all calls.
_BLOCK = 512
#: s between two looks at the states, and between two looks at who has arrived.
_STEP, _CHUNK = 0.1, 4.0
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class ConfidenceShare:
    """A share with its confidence interval (95 %, Clopper and Pearson)."""

    value: float  #: the best guess
    lower: float  #: lower end
    upper: float  #: upper end

    def over(self, other: ConfidenceShare) -> ConfidenceShare:
        """The ratio of two, its interval the widest that both allow; at most 1 if they say so."""
        return ConfidenceShare(
            self.value / other.value if other.value else math.nan,
            self.lower / other.upper if other.upper else math.nan,
            self.upper / other.lower if other.lower else math.inf,
        )


def share_of(hits: int, count: int) -> ConfidenceShare:
    """The share of hits among independent draws."""
    from scipy.special import betaincinv

    tail = 0.5 * (1.0 - _CONFIDENCE)
    low = 0.0 if hits == 0 else float(betaincinv(hits, count - hits + 1, tail))
    high = 1.0 if hits == count else float(betaincinv(hits + 1, count - hits, 1.0 - tail))
    return ConfidenceShare(hits / count if count else math.nan, low, high)


def fates(
    system: ReducedSystem, starts: FloatArray, inside: Inside, duration: float, far: FloatArray
) -> IntArray:
    """What becomes of motions from deviations (m, n) within a duration (s), (m,).

    :data:`SETTLED` once ``inside`` says of a deviation that it has arrived, :data:`LEFT` beyond
    \\|y_i\\| > far_i, else :data:`UNDECIDED`.
    """
    return _followed(system, starts, inside, duration, far)[0]


def _followed(
    system: ReducedSystem, starts: FloatArray, inside: Inside, duration: float, far: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Fates, and the deviations (m, n) where each motion was last seen."""
    kept, origin = list(system.kept), system.point.x
    found = np.zeros(len(starts), dtype=np.int8)
    found[inside(starts)] = SETTLED
    waiting = np.flatnonzero(found == UNDECIDED)
    if not len(waiting):
        return found, starts
    mover = _Mover(system)
    states = np.tile(mover.rest, (len(starts), 1))
    states[:, kept] += starts
    for _ in range(math.ceil(duration / _CHUNK)):
        if not len(waiting):
            break
        for first in range(0, len(waiting), _BLOCK):
            rows = waiting[first : first + _BLOCK]
            path = mover.moved(states[rows])
            y = path[:, :, kept] - origin[kept]
            states[rows] = path[-1]
            with np.errstate(invalid="ignore"):
                gone = np.any(~(np.abs(y) <= far), axis=(0, 2))
            finite = np.where(np.isfinite(y), y, np.inf)
            arrived = inside(finite.reshape(-1, system.n)).reshape(-1, len(rows)).any(axis=0)
            found[rows] = np.where(gone, LEFT, np.where(arrived, SETTLED, UNDECIDED))
        waiting = waiting[found[waiting] == UNDECIDED]
    return found, states[:, kept] - origin[kept]


class _Mover:
    """Motions over a chunk of time: one compiled function for a block of them."""

    def __init__(self, system: ReducedSystem) -> None:
        model = without_impulses(system.model)
        substeps = math.ceil(_STEP / LONGEST_STEP - 1e-9)
        discrete = discretise(model, _STEP, substeps)
        self.rest = discrete.initial(system.point.x, system.point.u)
        self._every = BufferedFunction(discrete.step.map(_BLOCK))
        _, commands, p, _ = self._every.inputs
        commands.reshape(model.n_u, _BLOCK, order="F")[:] = system.point.u[:, None]
        values = model.parameters.values
        if p.size:
            p.reshape(values.size, _BLOCK, order="F")[:] = values[:, None]

    def moved(self, states: FloatArray) -> FloatArray:
        """(k, m, n) states after each of k steps, from (m, n) with m up to a block."""
        x, m = self._every.inputs[0], len(states)
        # A block that is not full repeats its states: one size, one function.
        x[...] = np.resize(states, (_BLOCK, states.shape[1])).T
        path = np.empty((round(_CHUNK / _STEP), m, states.shape[1]))
        for k in range(len(path)):
            self._every()
            x[...] = self._every.outputs[0]
            path[k] = x[:, :m].T
        return path


def failures(
    system: ReducedSystem,
    sets: Sequence[RegionEstimate],
    count: int,
    duration: float,
    seed: int,
    cut: bool = False,
) -> list[tuple[int, int]]:
    """A test of estimates by simulation: starts in each that are decided, and failures among them.

    To rest comes what ends where yᵀPy, of the linearisation's Lyapunov equation, is a hundredth of
    what it is on the smallest set's edge: deep inside all of them. Where the duration is ``cut``,
    shorter than the slowest mode needs for that, a motion that is still in its set, at a lower V
    than it began with, has not failed but is undecided, and not counted.
    """
    P = from_lyapunov_equation(system)
    starts = [_with_edge(estimate, count, seed) for estimate in sets]
    drawn = [y for y in starts if len(y)]
    if not drawn:
        return [(0, 0) for _ in sets]
    least = min(float(np.einsum("ij,jk,ik->i", y, P, y).max()) for y in drawn)

    def arrived(y: FloatArray) -> BoolArray:
        near = np.where(np.isfinite(y), y, 1e6)
        return np.asarray(np.einsum("ij,jk,ik->i", near, P, near) < 1e-2 * least)

    fate, last = _followed(system, np.vstack(drawn), arrived, duration, np.full(system.n, np.inf))
    ends = np.cumsum([len(y) for y in starts])
    told = []
    for estimate, y, end in zip(sets, starts, ends, strict=True):
        own, at = fate[end - len(y) : end], last[end - len(y) : end]
        lost, still = own != SETTLED, np.zeros(len(y), dtype=bool)
        waits = np.flatnonzero(own == UNDECIDED)
        if cut and len(waits):
            V = estimate.candidate.values
            still[waits] = estimate.contains(at[waits]) & (V(at[waits]) < V(y[waits]))
        told.append((int(np.sum(~still)), int(np.sum(lost & ~still))))
    return told


def _with_edge(estimate: RegionEstimate, count: int, seed: int) -> FloatArray:
    """Starts in a set, half of them as near to its edge as it goes on their ray."""
    starts = estimate.drawn(count, seed)
    for _ in range(40):
        further = starts.copy()
        further[::2] *= 1.05
        kept = estimate.contains(further)
        starts[kept] = further[kept]
    return starts


@dataclass(frozen=True)
class OtherRest:
    """Another equilibrium at the same command: its deviation (n,), and whether it attracts."""

    y: FloatArray  #: deviation from the equilibrium studied
    stable: bool  #: all eigenvalues in the left half plane


def other_rests(system: ReducedSystem, limits: FloatArray, seed: int = 0) -> list[OtherRest]:
    """Other equilibria in the box that Newton's method finds from random starts."""
    field, kept = VectorField(system.model), list(system.kept)
    random = np.random.default_rng(seed)
    found: list[OtherRest] = []
    for draw in random.uniform(-1.0, 1.0, (60, system.n)) * limits:
        start = system.point.x.copy()
        start[kept] += draw
        x = refined(field, start, system.point.u)
        if x is None:
            continue
        y = x[kept] - system.point.x[kept]
        scale = np.maximum(limits, 1e-9)
        known = [np.zeros(system.n), *(rest.y for rest in found)]
        if np.any(np.abs(y) > limits) or min(np.abs((y - k) / scale).max() for k in known) < 1e-4:
            continue
        slope = field.linearised(x, system.point.u)[0][np.ix_(kept, kept)]
        found.append(OtherRest(y, bool(np.linalg.eigvals(slope).real.max() < 0.0)))
    return sorted(found, key=lambda rest: float(np.linalg.norm(rest.y / limits)))
