"""Functions V of the deviation, and the level sets in which they fall: sampled, widened, proved.

V is a weighted sum of basis functions: the squares and products of the deviations, on request the
higher monomials up to degree four, and the integrals of the model's own nonlinear rates along one
axis,

    W_ij(y) = ∫₀^{y_j} [f_i(x̄ + s e_j) − f_i(x̄)] ds

(Lur'e and Postnikov's idea: a potential energy is such an integral). The integral is taken by
Gauss's rule with few nodes; the sum, not the integral, *is* the basis function, and its slopes are
its own: nothing that is proved of V rests on the quadrature.

Sampling gives an upper bound of the level, and a proposal. On rays from the equilibrium the first
point is sought where V̇ ≥ 0, and from the lowest of them V is minimised along V̇ = 0. No level above
the value that is found can be right; that none below is wrong is shown by proof only.

Widening: around a V whose level set {V ≤ c} is right, points are drawn in a larger set, and the
weights of a richer basis are sought that make V fall at all of them, with the largest margin t:

    maximise t   subject to   V̇(y_s) ≤ −t q(y_s),   V(y_s) ≥ 0.02 q(y_s),   mean of V/q = 1

and, near the equilibrium, V̇ ≤ −β V with β a share of the slowest decay there (else V falls by so
little that no bound shows it); q is the quadratic V to begin with. It is a linear programme, solved
by HiGHS. Of the solution the largest level set is taken, and so on while the volume grows. This is
the simulation-free form of the sampled search of Topcu, Packard & Seiler ("Local stability analysis
using simulations and sum-of-squares programming", Automatica 44, 2008).

Proof, by interval branch and bound. For a level c it is shown, in coordinates y = T z in which V is
about \\|z\\|², that

1. V̇ < 0 in a small box N around the equilibrium but at the equilibrium itself. With ∇V(y) = H y and
   f(y) = A y, both H and A averages of second and first derivatives over a segment and so within
   known bounds, V̇ = yᵀ Hᵀ A y, and the symmetric part of Hᵀ A is negative definite for all of them;
2. in every box that covers the rest of a large box Z, V̇ < 0 or V > c;
3. in every box that touches the edge of Z, V > c.

Then no motion leaves {V ≤ c} ∩ Z, for it would have to cross V = c where V falls, or the edge of Z
where V > c; the set is compact and V falls in all of it but at the equilibrium, to which therefore
every motion tends (LaSalle). Nothing is asked of V elsewhere.

Boxes are taken lowest V first, so that the search may stop at any time: all below the lowest box
that is still open is proved. Everything is rounded outwards, and holds for the exact equilibrium.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.stability.attraction.system import ReducedSystem
from trms_cli.stability.intervals.branch_and_bound import (
    BoxSearch,
    branch_and_bound,
    halve_boxes,
    operations,
)
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval, corners, positive_definite

_NODES = 6
#: What an expression with a kink or a jump holds.
_SWITCHES = {
    *(ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_IF_ELSE_ZERO),
    *(ca.OP_SIGN, ca.OP_FABS, ca.OP_FMIN, ca.OP_FMAX, ca.OP_FLOOR, ca.OP_CEIL),
}


@dataclass(frozen=True)
class Basis:
    """Basis functions of y."""

    system: ReducedSystem
    names: tuple[str, ...]  #: ``alpha_v·S_v``, ``∫S_v' d alpha_v``; of each function
    values: ca.Function  #: ``y → b``, (k, 1)

    @cached_property
    def rates(self) -> ca.Function:
        """``y → ḃ`` along the motions, (k, 1)."""
        y = ca.SX.sym("y", self.system.n)
        f = self.system.function(y, ca.DM.zeros(self.system.model.n_x))
        return ca.Function("rates", [y], [ca.jacobian(self.values(y), y) @ f])

    def at(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """b and ḃ at many deviations (m, n), each (m, k)."""
        return np.array(self.values(y.T)).T, np.array(self.rates(y.T)).T


@dataclass(frozen=True)
class LyapunovCandidate:
    """V = weights · b."""

    basis: Basis
    weights: FloatArray  #: (k,) array

    @property
    def system(self) -> ReducedSystem:
        return self.basis.system

    @cached_property
    def function(self) -> ca.Function:
        """``y → V``."""
        y = ca.SX.sym("y", self.system.n)
        value = ca.dot(ca.SX(ca.DM(self.weights)), self.basis.values(y))
        return ca.Function("V", [y], [value])

    @cached_property
    def both(self) -> ca.Function:
        """``(y, e) → V, V̇``."""
        y, e = self.system.symbols()
        value = self.function(y)
        rate = ca.jacobian(value, y) @ self.system.function(y, e)
        return ca.Function("both", [y, e], [value, rate])

    @cached_property
    def hessian(self) -> ca.Function:
        """``(y, e) → ∂²V/∂y²``, dense; e is not used."""
        y, e = self.system.symbols()
        return ca.Function("hessian", [y, e], [ca.densify(ca.hessian(self.function(y), y)[0])])

    @cached_property
    def P(self) -> FloatArray:
        """Half the second derivative at the equilibrium: V ≈ yᵀPy near it, (n, n)."""
        zero = np.zeros(self.system.n)
        return 0.5 * np.array(self.hessian(zero, np.zeros(self.system.model.n_x)))

    def at(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """V and V̇ at many deviations (m, n), each (m,)."""
        value, rate = self.both(y.T, np.zeros(self.system.model.n_x))
        return np.array(value).ravel(), np.array(rate).ravel()

    def values(self, y: FloatArray) -> FloatArray:
        """V at many deviations (m, n), (m,)."""
        return np.array(self.function(y.T)).ravel()


def quadratic(system: ReducedSystem, P: FloatArray) -> LyapunovCandidate:
    """V = yᵀPy."""
    basis = basis_of(system)
    pairs = itertools.combinations_with_replacement(range(system.n), 2)
    weights = [P[i, j] * (1.0 if i == j else 2.0) for i, j in pairs]
    return LyapunovCandidate(basis, np.array(weights))


def basis_of(system: ReducedSystem, degree: int = 2, *, integrals: bool = False) -> Basis:
    """Monomials of degrees 2 to ``degree`` (at most 4), and on request the integrals of the rates.

    Integrals are those of rates that are curved along an axis, and smooth.
    """
    y = ca.SX.sym("y", system.n)
    terms: list[ca.SX] = []
    labels: list[str] = []
    for size in range(2, degree + 1):
        for group in itertools.combinations_with_replacement(range(system.n), size):
            term = ca.SX(1)
            for i in group:
                term *= y[i]
            terms.append(term)
            labels.append(_power(system.names, group))
    if integrals:
        for i, j in _curved_pairs(system):
            terms.append(_integral(system, y, i, j))
            labels.append(f"∫{system.names[i]}' d{system.names[j]}")
    return Basis(system, tuple(labels), ca.Function("basis", [y], [ca.vertcat(*terms)]))


def _power(names: Sequence[str], group: tuple[int, ...]) -> str:
    parts = []
    for i in dict.fromkeys(group):
        count = group.count(i)
        parts.append(names[i] + ("" if count == 1 else "²³⁴"[count - 2]))
    return "·".join(parts)


def _curved_pairs(system: ReducedSystem) -> list[tuple[int, int]]:
    """(i, j) where ∂f_i/∂y_j depends on y_j, smoothly: along which axis a rate is curved."""
    y, e = system.symbols()
    slopes = system.slopes(y, e)
    pairs = []
    for i, j in itertools.product(range(system.n), repeat=2):
        slope = ca.Function("slope", [y, e], [slopes[i, j]])
        # A rate with a kink would give V, summed at nodes, slopes that jump.
        if ca.jacobian_sparsity(slopes[i, j], y[j]).nnz() and not operations(slope) & _SWITCHES:
            pairs.append((i, j))
    return pairs


def _integral(system: ReducedSystem, y: ca.SX, i: int, j: int) -> ca.SX:
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    zero = ca.DM.zeros(system.model.n_x)
    at_rest = system.function(ca.DM.zeros(system.n), zero)[i]
    total = ca.SX(0)
    for node, weight in zip(nodes, weights, strict=True):
        along = ca.SX.zeros(system.n)
        along[j] = 0.5 * (1.0 + node) * y[j]
        total += 0.5 * weight * (system.function(along, zero)[i] - ca.SX(at_rest))
    return total * y[j]


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


@dataclass(frozen=True)
class Rays:
    """Directions from the equilibrium, the same for all functions."""

    root: FloatArray  #: (n, n) array; y = root z: coordinates in which V is about \\|z\\|²
    ends: FloatArray  #: (m, n) array; where each ray meets the limits

    @classmethod
    def draw(cls, P: FloatArray, limits: FloatArray, count: int, seed: int) -> Rays:
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
        local_minimum = _refined(candidate, rays, places[k], bool(at_end[k]))
        if local_minimum is not None and local_minimum[0] < _ELSEWHERE * allowed[k]:
            allowed[k], places[k] = local_minimum
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
    solution = minimize(
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
    level, slope = (float(v) for v in at(solution.x)[:2])
    y = rays.root @ solution.x
    limits = np.abs(rays.ends).max(axis=0)
    away = np.linalg.norm(solution.x) > 1e-2 * np.linalg.norm(z0)
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
    first: LyapunovCandidate, level: SampledLevel, basis: Basis, rays: Rays
) -> tuple[LyapunovCandidate, SampledLevel]:
    """The candidate of a richer basis with the largest level set that sampling finds.

    ``first`` is quadratic, ``level`` its own, and its functions are the first ones of the basis. It
    is returned in the new basis where nothing better is found.
    """
    random = np.random.default_rng(0)
    weights = np.zeros(len(basis.names))
    weights[: len(first.weights)] = first.weights
    best, best_level = LyapunovCandidate(basis, weights), level
    growth = _GROWTH
    for _ in range(_ROUNDS):
        y, near = _points(best, best_level, growth, random)
        trial = _fitted(basis, y, near, first)
        reached = None if trial is None else sampled_level(trial, rays)
        if trial is None or reached is None or reached.log_volume < best_level.log_volume + 0.01:
            growth *= 0.5
            if growth < _LEAST_GROWTH:
                break
            continue
        best, best_level = trial, reached
    return best, best_level


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
    solution = linprog(cost, rows, right, mean, [1.0], bounds, method="highs")
    if solution.status != 0 or solution.x[-1] <= 0.0:
        return None
    return LyapunovCandidate(basis, solution.x[:-1] / size)


#: Boxes that are halved at once.
_BATCH = 1024
#: A box narrower than this share of Z is not halved again.
_NARROWEST = 2.0**-16
#: Sides of Z beyond those of the sampled level set.
_BEYOND = 1.05
#: Parts of the segments over which slopes are averaged.
_PARTS = 8


@dataclass(frozen=True)
class LevelProof:
    """What branch and bound proved."""

    level: float  #: V falls in {V < level}, which is attracted; 0 where nothing is proved
    boxes: int  #: That were looked at
    complete: bool  #: Whether all boxes up to the level that was proposed are closed
    frame: FloatArray  #: (n, n) array; T: Z is the image of the unit cube


def proved_level(
    candidate: LyapunovCandidate,
    sampled: SampledLevel,
    most: int,
    share: float = 1.0,
    tell: Callable[[str], None] | None = None,
) -> LevelProof:
    """Prove as much of a sampled level set as a number of boxes allows.

    A share of the sampled level is tried: on the level itself V̇ = 0.
    """
    search = _Search(candidate, sampled)
    inner = search.inner()
    if inner == 0.0:
        return LevelProof(0.0, 0, False, search.T)
    target = share * sampled.level
    stuck, count = np.inf, 1

    def visit(boxes: Interval, keys: FloatArray) -> tuple[Interval, FloatArray, int]:
        nonlocal stuck, count
        # Only what lies below the lowest box that cannot be closed is worth the trouble.
        boxes = boxes[keys < min(target, stuck)]
        halves = halve_boxes(boxes, np.argmax(boxes.width, axis=1))
        value, falls = search.bounds(halves)
        edge = np.any((halves.lower <= -1.0) | (halves.upper >= 1.0), axis=1)
        core = np.all((halves.lower >= -inner) & (halves.upper <= inner), axis=1)
        open_ = ~core & (edge | ~falls) & (value < target)
        narrow = open_ & (halves.width.max(axis=1) < 2.0 * _NARROWEST)
        stuck = min(stuck, float(value[narrow].min(initial=np.inf)))
        open_ &= ~narrow
        spent = len(value)
        if tell and (count + spent) // (32 * _BATCH) != count // (32 * _BATCH):
            fraction = max(0.0, min(target, float(keys.min()))) / target
            tell(f"{count + spent} boxes, proved to {fraction:.0%} of the level")
        count += spent
        return halves[open_], value[open_], spent

    whole = Interval(-np.ones((1, candidate.system.n)), np.ones((1, candidate.system.n)))
    result = branch_and_bound(
        BoxSearch(whole, search.bounds(whole)[0], 1),
        visit,
        budget=most,
        enough=lambda lowest: lowest >= min(target, stuck),
        chunk=_BATCH,
        whole_chunks=True,
    )
    reached = min(target, stuck, result.lowest)
    return LevelProof(max(reached, 0.0), result.examined, reached >= target, search.T)


def frame(candidate: LyapunovCandidate, sampled: SampledLevel) -> FloatArray:
    """T of a cube around the sampled level set, in the axes of V's second derivative, (n, n)."""
    value, vectors = np.linalg.eigh(candidate.P)
    root = vectors / np.sqrt(np.maximum(value, 1e-12 * value[-1]))
    reach = np.abs(np.linalg.solve(root, sampled.edge.T)).max(axis=1)
    return np.asarray(root * (_BEYOND * reach))


class _Search:
    """Bounds of V and V̇ in coordinates in which Z is the unit cube."""

    def __init__(self, candidate: LyapunovCandidate, sampled: SampledLevel) -> None:
        system = candidate.system
        self.T = frame(candidate, sampled)
        self._candidate, self._error = candidate, system.error
        z, e = system.symbols()
        y = ca.DM(self.T) @ z
        both = ca.Function("both", [z, e], [ca.vertcat(*candidate.both(y, e))])
        self._both = Enclosure(both)
        self._hessian = Enclosure(ca.Function("H", [z, e], [candidate.hessian(y, e)]))
        self._slopes = Enclosure(ca.Function("A", [z, e], [system.slopes(y, e)]))

    def bounds(self, box: Interval) -> tuple[FloatArray, np.ndarray]:
        """Lower bounds of V, and whether V̇ < 0 is proved, in each box."""
        rough = self._both(box, self._error)[0]
        value, falls = rough.lower[:, 0].copy(), rough.upper[:, 1] < 0.0
        doubtful_rows = np.flatnonzero(~falls)
        if len(doubtful_rows):
            fine = self._both.mean_value(box[doubtful_rows], self._error)
            value[doubtful_rows], falls[doubtful_rows] = fine.lower[:, 0], fine.upper[:, 1] < 0.0
        return np.where(np.isnan(value), -np.inf, value), falls

    def inner(self) -> float:
        """Size of the largest cube N, a power of two, in which the first step holds; 0 for none."""
        sizes = (2.0**-k for k in range(30))
        return next((size for size in sizes if self._falls_in(size)), 0.0)

    def _falls_in(self, size: float) -> bool:
        n = self._candidate.system.n
        r = np.nextafter(size * (np.arange(_PARTS) + 1.0) / _PARTS, np.inf)[:, None]
        box = Interval(-r * np.ones(n), r * np.ones(n))
        H = self._hessian.matrices(box, self._error)[0].mean()[None]
        A = corners(self._slopes.matrices(box, self._error)[0].mean())
        T = Interval.point(self.T[None])
        return bool(np.all(positive_definite(-(T.transposed @ (H.transposed @ (A @ T))))))
