"""The largest level set of V in which V falls, by sampling: an upper bound, and a proposal.

On rays from the equilibrium the first point is sought where V̇ ≥ 0, and from the lowest of them V
is minimised along V̇ = 0. No level above the value that is found can be right; that none below is
wrong is not shown by this, but by :mod:`trms_cli.stability.attraction.proof`.

V fitted so that its level set grows: sampled expansion.

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

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.stability.attraction.functions import Basis, LyapunovCandidate

_RADII = 120
_REFINED = 8
#: A local minimum above a ray's own level by this factor belongs to another place.
_ELSEWHERE = 1.02


@dataclass(frozen=True)
class SampledLevel:
    """The lowest level at which V was found not to fall."""

    level: float  #: No larger one is right
    at: FloatArray  #: (n,) array; the deviation where V̇ = 0, or where the level meets the limits
    at_limit: bool  #: Whether the limits of the search ended it, not V̇
    log_volume: float  #: Of {V < level}, natural logarithm, from the rays
    edge: FloatArray  #: (m, n) array; where the rays leave {V < level}
    samples: int  #: Points that were looked at

    @property
    def extents(self) -> FloatArray:
        """Half widths of {V < level}, (n,)."""
        return np.asarray(np.abs(self.edge).max(axis=0))


@dataclass(frozen=True)
class Rays:
    """Directions from the equilibrium, the same for all functions."""

    root: FloatArray  #: (n, n) array; y = root z: coordinates in which V is about \\|z\\|²
    ends: FloatArray  #: (m, n) array; where each ray meets the limits

    @classmethod
    def drawn(cls, P: FloatArray, limits: FloatArray, count: int, seed: int) -> Rays:
        """Uniform directions in the metric of P, as far as \\|y_i\\| ≤ limits_i; with opposites."""
        value, vectors = np.linalg.eigh(P)
        root = vectors / np.sqrt(value)
        half = count // 2 if len(P) > 1 else 1  # a line has two directions
        z = np.random.default_rng(seed).normal(size=(half, len(P)))
        z /= np.linalg.norm(z, axis=1)[:, None]
        y = np.vstack([z, -z]) @ root.T
        return cls(root, y / np.max(np.abs(y) / limits, axis=1)[:, None])


def sampled_level(candidate: LyapunovCandidate, rays: Rays) -> SampledLevel | None:
    """The level up to which no sample contradicts V̇ < 0; None if V̇ ≥ 0 next to the equilibrium."""
    n = candidate.system.n
    # The same relative distance everywhere: a small set is seen as well as a large one.
    shares = np.geomspace(1e-3, 1.0, _RADII)
    y = (rays.ends[:, None, :] * shares[None, :, None]).reshape(-1, n)
    value, rate = (v.reshape(len(rays.ends), -1) for v in candidate.at(y))
    wrong = (rate >= 0.0) | ~np.isfinite(rate) | ~np.isfinite(value)
    wrong[:, 0] |= value[:, 0] <= 0.0
    if np.any(wrong[:, 0]):
        return None
    row = np.arange(len(value))
    at_end = ~np.any(wrong, axis=1)
    first = np.where(at_end, len(shares) - 1, np.argmax(wrong, axis=1))
    # A ray is content with a level that V reaches on it before V̇ goes wrong.
    allowed = np.maximum.accumulate(value, axis=1)[row, np.where(at_end, first, first - 1)]
    # Between two samples V̇ is taken to be straight.
    before = np.maximum(first - 1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.clip(rate[row, before] / (rate[row, before] - rate[row, first]), 0.0, 1.0)
    part = np.where(at_end, 1.0, np.nan_to_num(part))
    crossing = value[row, before] + part * (value[row, first] - value[row, before])
    share = shares[before] + part * (shares[first] - shares[before])
    allowed = np.maximum(allowed, np.nan_to_num(crossing, nan=-np.inf))
    order = np.argsort(allowed)
    places = rays.ends * share[:, None]
    for k in order[:_REFINED]:
        found = _refined(candidate, rays, places[k], bool(at_end[k]))
        if found is not None and found[0] < _ELSEWHERE * allowed[k]:
            allowed[k], places[k] = found
    best = int(np.argmin(allowed))
    level, place = float(allowed[best]), places[best]
    inside = value < level
    # The radius at which each ray leaves the level set, by interpolation.
    last = np.minimum(np.argmax(~inside, axis=1), first)
    low = np.where(last > 0, value[row, np.maximum(last - 1, 0)], 0.0)
    start = np.where(last > 0, shares[np.maximum(last - 1, 0)], 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.clip((level - low) / (value[row, last] - low), 0.0, 1.0)
    radius = start + np.nan_to_num(part) * (shares[last] - start)
    edge = rays.ends * radius[:, None]
    return SampledLevel(
        level, place, bool(at_end[best]), _log_volume(edge, rays.root), edge, y.shape[0]
    )


def _log_volume(edge: FloatArray, root: FloatArray) -> float:
    """Of the star-shaped set whose edge is seen in uniform directions of z."""
    n = edge.shape[1]
    z = np.linalg.solve(root, edge.T).T
    mean = float(np.mean(np.linalg.norm(z, axis=1) ** n))
    ball = 0.5 * n * math.log(math.pi) - math.lgamma(0.5 * n + 1.0)
    return ball + math.log(max(mean, 1e-300)) + float(np.linalg.slogdet(root)[1])


def _refined(
    candidate: LyapunovCandidate, rays: Rays, start: FloatArray, at_limit: bool
) -> tuple[float, FloatArray] | None:
    """A local minimum of V where V̇ ≥ 0 (or on the limit), from a start near one."""
    from scipy.optimize import minimize

    if at_limit:
        return None
    z = ca.SX.sym("z", candidate.system.n)
    value, rate = candidate.both(ca.DM(rays.root) @ z, ca.DM.zeros(candidate.system.model.n_x))
    at = ca.Function("at", [z], [value, rate, ca.gradient(value, z), ca.gradient(rate, z)])
    z0 = np.linalg.solve(rays.root, start)
    v0 = abs(float(at(z0)[0])) or 1.0
    scale = v0 * float(np.abs(candidate.system.eigenvalues).max())
    found = minimize(
        lambda p: float(at(p)[0]) / v0,
        z0,
        jac=lambda p: np.array(at(p)[2]).ravel() / v0,
        constraints=[
            {
                "type": "ineq",
                "fun": lambda p: float(at(p)[1]) / scale,
                "jac": lambda p: np.array(at(p)[3]).ravel() / scale,
            }
        ],
        method="SLSQP",
        options={"maxiter": 80, "ftol": 1e-10},
    )
    level, slope = (float(v) for v in at(found.x)[:2])
    y = rays.root @ found.x
    limits = np.abs(rays.ends).max(axis=0)
    away = np.linalg.norm(found.x) > 1e-2 * np.linalg.norm(z0)
    usable = away and level > 0.0 and slope > -1e-5 * scale and bool(np.all(np.abs(y) <= limits))
    return (level, y) if usable and np.isfinite(level) else None


_ROUNDS = 16
_POINTS = 1500
#: By how much the set is to grow in a round, in V, at most; halved when a round fails.
_GROWTH = 1.0
_LEAST_GROWTH = 0.05
#: Share of the fastest rate at which any V can fall that is asked for near the equilibrium.
_SHARE = 0.3
_STEEP = 0.1
_HEAVIEST = 20.0


def expand_level_set(
    first: LyapunovCandidate, level: SampledLevel, basis: Basis, rays: Rays, seed: int
) -> tuple[LyapunovCandidate, SampledLevel]:
    """The candidate of a richer basis with the largest level set that sampling finds.

    ``first`` is quadratic, ``level`` its own, and its functions are the first ones of the basis. It
    is returned in the new basis where nothing better is found.
    """
    random = np.random.default_rng(seed)
    weights = np.zeros(len(basis.names))
    weights[: len(first.weights)] = first.weights
    best, found = LyapunovCandidate(basis, weights), level
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
    candidate: LyapunovCandidate, level: SampledLevel, growth: float, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Points of {V ≤ (1 + growth) level}, and some near the equilibrium."""
    edge = level.edge[random.integers(len(level.edge), size=4 * _POINTS)]
    share = random.uniform(size=(len(edge), 1)) ** (1.0 / edge.shape[1])
    y = edge * share * (1.0 + growth)
    inside = y[candidate.values(y) <= level.level * (1.0 + growth)][:_POINTS]
    few = inside[: _POINTS // 5]
    return inside, few * random.uniform(0.01, 0.2, (len(few), 1))


def _fitted(
    basis: Basis, far: FloatArray, near: FloatArray, first: LyapunovCandidate
) -> LyapunovCandidate | None:
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
    return LyapunovCandidate(basis, found.x[:-1] / size)
