"""V fitted so that its level set grows: sampled expansion.

Around a V whose level set {V ≤ c} is right, points are drawn in a larger set, and the weights of a
richer basis are sought that make V fall at all of them, with the largest margin t:

    maximise t   subject to   V̇(y_s) ≤ −t q(y_s),   V(y_s) ≥ 0.02 q(y_s),   mean of V/q = 1

and, near the equilibrium, V̇ ≤ −β V with β a share of the slowest decay there (else V falls by so
little that no bound shows it); q is the quadratic V to begin with. It is a linear programme, solved
by HiGHS. Of the solution the
largest level set is taken (:mod:`~trms_cli.stability.attraction.level_set`), and so on while the
volume grows. This is the simulation-free form of the sampled search of Topcu, Packard & Seiler
("Local stability analysis using simulations and sum-of-squares programming", Automatica 44, 2008).
What is found is a proposal; the proof is another step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.stability.attraction.functions import Basis, Candidate
from trms_cli.stability.attraction.level_set import Rays, SampledLevel, sampled_level

FloatArray = npt.NDArray[np.float64]

_ROUNDS = 16
_POINTS = 1500
#: By how much the set is to grow in a round, in V, at most; halved when a round fails.
_GROWTH = 1.0
_LEAST_GROWTH = 0.05
#: Share of the fastest rate at which any V can fall that is asked for near the equilibrium.
_SHARE = 0.3
_STEEP = 0.1
_HEAVIEST = 20.0


def expanded(
    first: Candidate, level: SampledLevel, basis: Basis, rays: Rays, seed: int
) -> tuple[Candidate, SampledLevel]:
    """The candidate of a basis with the largest level set that sampling finds.

    Parameters
    ----------
    first : Candidate
        Quadratic.
    level : SampledLevel
        Its.
    basis : Basis
        Richer; its first functions are those of ``first``.
    rays : Rays
    seed : int

    Returns
    -------
    (Candidate, SampledLevel)
        ``first`` in the new basis where nothing better is found.
    """
    random = np.random.default_rng(seed)
    weights = np.zeros(len(basis.names))
    weights[: len(first.weights)] = first.weights
    best, found = Candidate(basis, weights), level
    growth = _GROWTH
    for _ in range(_ROUNDS):
        y, near = _points(best, found, growth, random)
        trial = _fitted(basis, y, near, first)
        reached = None if trial is None else sampled_level(trial, rays)
        if trial is None or reached is None or reached.log_volume < found.log_volume + 0.01:
            growth *= 0.5
            if growth < _LEAST_GROWTH:
                break
            continue
        best, found = trial, reached
    return best, found


def _points(
    candidate: Candidate, level: SampledLevel, growth: float, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Points of {V ≤ (1 + growth) level}, and some near the equilibrium."""
    edge = level.edge[random.integers(len(level.edge), size=4 * _POINTS)]
    share = random.uniform(size=(len(edge), 1)) ** (1.0 / edge.shape[1])
    y = edge * share * (1.0 + growth)
    inside = y[candidate.values(y) <= level.level * (1.0 + growth)][:_POINTS]
    few = inside[: _POINTS // 5]
    return inside, few * random.uniform(0.01, 0.2, (len(few), 1))


def _fitted(basis: Basis, far: FloatArray, near: FloatArray, first: Candidate) -> Candidate | None:
    from scipy.optimize import linprog

    y = np.vstack([far, near])
    if len(y) < 10 * len(basis.names):
        return None
    b, rate = basis.at(y)
    q = first.values(y)[:, None]
    size = np.abs(b / q).max(axis=0)
    size[size == 0.0] = 1.0
    b, rate = b / q / size, rate / q / size
    one = np.ones((len(y), 1))
    beta = _SHARE * 2.0 * float(-basis.system.eigenvalues.real.max())
    close = slice(len(far), None)
    rows = np.vstack(
        [
            np.hstack([rate, one]),
            np.hstack([-b, 0.0 * one]),
            np.hstack([rate[close] + beta * b[close], 0.0 * one[close]]),
        ]
    )
    least = np.concatenate([np.full(len(far), -0.02), np.full(len(near), -_STEEP)])
    right = np.concatenate([np.zeros(len(y)), least, np.zeros(len(near))])
    cost = np.zeros(b.shape[1] + 1)
    cost[-1] = -1.0
    mean = np.append(b.mean(axis=0), 0.0)[None]
    # Large weights that cancel would be undone by no bound: intervals do not cancel.
    bounds = [(-_HEAVIEST, _HEAVIEST)] * b.shape[1] + [(None, None)]
    found = linprog(cost, rows, right, mean, [1.0], bounds, method="highs")
    if found.status != 0 or found.x[-1] <= 0.0:
        return None
    return Candidate(basis, found.x[:-1] / size)
