"""Estimates of the region of attraction by several methods, each with what is proved of it.

Quadratic regions are those of a linear differential inclusion.

In a box |y_i| ≤ r_i the equations are ẏ = A(y) y with A(y) in an interval matrix (see
:meth:`~trms_cli.stability.attraction.system.ReducedSystem.hull`). V = yᵀPy falls there if

    AᵀP + PA ≺ 0        at every corner A of the interval matrix,

and {V ≤ c} attracts to the equilibrium if it lies in the box (Boyd, El Ghaoui, Feron &
Balakrishnan, "Linear Matrix Inequalities in System and Control Theory", SIAM 1994, chs. 4–5).
Two choices of P: of the Lyapunov equation of the linearisation, and the one whose ellipsoid has
the largest volume, with Q = P⁻¹

    maximise log det Q   subject to   A Q + Q Aᵀ + 2β Q ⪯ 0 at the corners,   Q_ii ≤ r_i²

over Q and, outside, over the box. The corners enter as they are violated. A solver's P is a
proposal: what is reported is proved again in interval arithmetic.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.stability.attraction.level_set import (
    LevelProof,
    LyapunovCandidate,
    Rays,
    SampledLevel,
    basis_of,
    expand_level_set,
    frame,
    proved_level,
    quadratic,
    sampled_level,
)
from trms_cli.stability.attraction.system import ReducedSystem
from trms_cli.stability.intervals.interval import Interval, corners, decays, inside_slab
from trms_cli.stability.study import Tell

#: Corners that one problem holds.
_SLOTS = 12
#: Share of the slowest decay rate that is asked for at every corner, for a margin to prove by.
_MARGIN = 1e-3
#: Steps of the search for the box: factors on one radius.
_FACTORS = (1.5, 1.15, 1.05)
#: Gain of log volume that counts.
_LARGER = 1e-3
#: Corners that were active lately and begin the next problem; violated ones that enter at once;
#: problems until a box is given up.
_REMEMBERED, _FRESH, _ATTEMPTS = 8, 3, 12


@dataclass(frozen=True)
class Ellipsoid:
    """{yᵀPy ≤ level}."""

    P: FloatArray  #: (n, n) array
    level: float

    @property
    def extents(self) -> FloatArray:
        """Half its width along each coordinate, (n,)."""
        return np.asarray(np.sqrt(self.level * np.diag(np.linalg.inv(self.P))))

    @property
    def log_volume(self) -> float:
        """Natural logarithm of its volume, in the units of y."""
        n = len(self.P)
        ball = 0.5 * n * math.log(math.pi) - math.lgamma(0.5 * n + 1.0)
        return ball + 0.5 * (n * math.log(self.level) - float(np.linalg.slogdet(self.P)[1]))


def scales(system: ReducedSystem) -> FloatArray:
    """Sizes of the states in proportion to each other, powers of two, (n,).

    Those that balance the linearisation: scaling by them rounds nothing.
    """
    from scipy.linalg import matrix_balance

    _, (scaling, _) = matrix_balance(system.A, permute=False, separate=True)
    return np.asarray(np.exp2(np.round(np.log2(scaling / scaling.max()))))


def from_lyapunov_equation(system: ReducedSystem) -> FloatArray:
    """P of AᵀP + PA = −I in balanced coordinates, (n, n)."""
    from scipy.linalg import solve_continuous_lyapunov

    d = scales(system)
    P = solve_continuous_lyapunov((system.A * d / d[:, None]).T, -np.eye(system.n))
    return np.asarray(0.5 * (P + P.T) / np.outer(d, d))


def is_proved_attracted(
    system: ReducedSystem, shape: Ellipsoid, slabs: FloatArray | None = None
) -> bool:
    """Whether the ellipsoid is proved to be attracted, by the inclusion over its bounding box.

    The equations hold where \\|row · y\\| < 1 for every row of ``slabs`` (k, n) only.
    """
    radii = shape.extents * (1.0 + 1e-9)
    d = np.exp2(np.round(np.log2(radii)))
    P = shape.P * np.outer(d, d)
    walls = [np.eye(system.n)[i] * d[i] / radii[i] for i in system.curved]
    walls += [row * d for row in (() if slabs is None else slabs)]
    if not all(inside_slab(P, shape.level, row) for row in walls):
        return False
    return decays(P, _scaled(system.hull(radii), d))


def largest_level(
    system: ReducedSystem, P: FloatArray, slabs: FloatArray | None = None
) -> Ellipsoid | None:
    """The largest {yᵀPy ≤ c} that the inclusion proves, to 1 %; None if not even a tiny one is."""
    reach = math.inf
    if slabs is not None and len(slabs):
        reach = 1.0 / max(float(row @ np.linalg.solve(P, row)) for row in slabs)

    def holds(level: float) -> bool:
        return level < reach and is_proved_attracted(system, Ellipsoid(P, level), slabs)

    level = _largest(holds, min(1.0, 0.5 * reach))
    return None if level is None else Ellipsoid(P, level)


def optimise_ellipsoid(
    system: ReducedSystem,
    slabs: FloatArray | None = None,
    *,
    first: Ellipsoid | None = None,
) -> Ellipsoid | None:
    """The largest ellipsoid that the inclusion proves, over P and over the box; None if none is.

    ``slabs`` as in :func:`is_proved_attracted`. The search for the box begins at ``first``.
    """
    search = _Search(system, slabs)
    # Boxes that are tried: fewer for many states, whose problems are larger.
    most = max(12, min(60, 100 - 11 * system.n))
    begin = scales(system) if first is None else first.extents
    scale = _largest(lambda s: search.bound(begin * s), 1.0, 0.1)
    best = None if scale is None else search.at(begin * scale)
    walls = list(system.curved)
    for factor in _FACTORS:
        improved = True
        while best and improved:
            improved = False
            for group in [*([i] for i in walls), walls]:
                for change in (factor, 1.0 / factor):
                    # A side that the ellipsoid does not touch is drawn in: it costs nothing.
                    radii = best.extents
                    radii[group] *= change
                    candidate = search.at(radii) if search.solved < most else None
                    if candidate and candidate.log_volume > best.log_volume + _LARGER:
                        best, improved = candidate, True
                        break
    if best is None:
        return None
    # The solver keeps its constraints to its own accuracy only.
    for share in (1.0 - 1e-6, 0.999, 0.99, 0.95, 0.8, 0.5):
        shape = Ellipsoid(best.P, best.level * share)
        if is_proved_attracted(system, shape, slabs):
            return shape
    return None


class _Search:
    """The largest ellipsoid for a given box, by cvxpy and Clarabel; compiled once."""

    def __init__(self, system: ReducedSystem, slabs: FloatArray | None) -> None:
        import cvxpy as cp

        self._system = system
        self._slabs = np.zeros((0, system.n)) if slabs is None else slabs
        n = system.n
        self._Q = cp.Variable((n, n), symmetric=True)
        self._A = [cp.Parameter((n, n)) for _ in range(_SLOTS)]
        self._rows = [cp.Parameter((1, n)) for _ in self._slabs]
        slowest = float(-system.eigenvalues.real.max())
        self._beta = _MARGIN * slowest
        self._idle = -float(np.abs(system.eigenvalues).max()) * np.eye(n)
        Q = self._Q
        constraints: list[Any] = [A @ Q + Q @ A.T + 2.0 * self._beta * Q << 0 for A in self._A]
        # Sides along which nothing is curved do not bound; but no set is ten times its last guess.
        room = [1.0 if i in system.curved else 100.0 for i in range(n)]
        constraints += [Q[i, i] <= room[i] for i in range(n)]
        # ‖row Q^½‖ ≤ 1, as a linear matrix inequality in Q.
        one = np.ones((1, 1))
        constraints += [cp.bmat([[one, row @ Q], [(row @ Q).T, Q]]) >> 0 for row in self._rows]
        self._problem = cp.Problem(cp.Maximize(cp.log_det(Q)), constraints)
        self._active: list[BoolArray] = []
        self.solved = 0

    def at(self, radii: FloatArray) -> Ellipsoid | None:
        """The ellipsoid in the box; None if there is none."""
        self.solved += 1
        bounds = _scaled(self._system.hull(radii), radii)
        if not (np.all(np.isfinite(bounds.lower)) and np.all(np.isfinite(bounds.upper))):
            return None
        spanning = corners(bounds)
        matrices = 0.5 * (spanning.lower + spanning.upper)
        for parameter, row in zip(self._rows, self._slabs, strict=True):
            parameter.value = (row * radii)[None]
        middle = 0.5 * (bounds.lower + bounds.upper)
        masks = self._active[-_REMEMBERED:]
        for _ in range(_ATTEMPTS):
            vertices = [np.where(mask, bounds.upper, bounds.lower) for mask in masks]
            Q = self._solution([middle, *vertices])
            if Q is None:
                return None
            growth = self._growth(matrices, Q)
            worst = [k for k in np.argsort(growth)[::-1][:_FRESH] if growth[k] > -self._beta]
            if not worst:
                inverse = np.linalg.inv(Q)
                P = 0.5 * (inverse + inverse.T) / np.outer(radii, radii)
                return Ellipsoid(P, 1.0)
            fresh = [matrices[k] > middle for k in worst]
            if vertices:
                ranking = np.argsort(self._growth(np.array(vertices), Q))[::-1]
                masks = [masks[k] for k in ranking[: _SLOTS - 1 - len(fresh)]]
            earlier_masks = [
                m for m in masks if not any(np.array_equal(m, other) for other in fresh)
            ]
            masks = [*earlier_masks, *fresh]
            self._active = masks
        return None

    def bound(self, radii: FloatArray) -> bool:
        """Whether the box holds an ellipsoid, and bounds it: a larger one would be of use."""
        ellipsoid, sides = self.at(radii), list(self._system.curved) or list(range(len(radii)))
        return ellipsoid is not None and bool(np.any(ellipsoid.extents[sides] > 0.9 * radii[sides]))

    def _growth(self, matrices: FloatArray, Q: FloatArray) -> FloatArray:
        """Twice the rate at which V may grow at each corner: positive where Q will not do."""
        value, vectors = np.linalg.eigh(Q)
        root, inverse = vectors * np.sqrt(value), (vectors / np.sqrt(value)).T
        transformed = inverse @ matrices @ root  # A in coordinates in which the ellipsoid is a ball
        return np.asarray(np.linalg.eigvalsh(transformed + transformed.transpose(0, 2, 1))[:, -1])

    def _solution(self, matrices: list[FloatArray]) -> FloatArray | None:
        import cvxpy as cp

        for k, parameter in enumerate(self._A):
            # A slot that is not used holds a matrix that asks for nothing.
            parameter.value = matrices[k] if k < len(matrices) else self._idle
        try:
            with warnings.catch_warnings():
                # An inaccurate solution is a proposal like any other.
                warnings.simplefilter("ignore")
                self._problem.solve(solver=cp.CLARABEL, warm_start=False)
        except (cp.SolverError, ArithmeticError):
            return None
        if self._problem.status not in ("optimal", "optimal_inaccurate"):
            return None
        Q = np.asarray(self._Q.value)
        return Q if np.all(np.isfinite(Q)) and np.linalg.eigvalsh(Q)[0] > 0 else None


def _scaled(bounds: Interval, d: FloatArray) -> Interval:
    """A in coordinates y_i / d_i: exact for powers of two, else for a proposal only."""
    factor = d[None, :] / d[:, None]
    return Interval(bounds.lower * factor, bounds.upper * factor)


def _largest(holds: Callable[[float], bool], start: float, accuracy: float = 1e-2) -> float | None:
    """The largest number for which something holds that holds for all smaller ones."""
    low, high = start, start
    while not holds(low):
        low, high = low / 4.0, low
        if low < 1e-12 * start:
            return None
    if high == low:
        high = 4.0 * low
        while holds(high):
            low, high = high, 4.0 * high
            if high > 1e12 * start:
                raise ModelError(
                    "the set that is proved has no bound", remedy="give a box: study.box"
                )
    while high > low * (1.0 + accuracy):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


Method = Literal["lyapunov", "inclusion", "level_set", "integrals", "quartic"]

#: What each method is called in tables and figures.
LABELS: dict[Method, str] = {
    "lyapunov": "Lyapunov equation",
    "inclusion": "LMI over a box",
    "level_set": "quadratic, level set",
    "integrals": "with integrals of the rates",
    "quartic": "polynomial of degree 4",
}
#: States up to which functions with many weights are fitted unasked, and proofs by boxes are tried:
#: the number of boxes grows with a power of the states.
_FEW = 3
#: Share of the sampled level that is to be proved: V̇ = 0 on the level itself.
_SHARE = 0.98
_RAYS = 600
#: Gain of log volume over the quadratic below which a fitted V counts as no other.
_GAIN = 0.01
#: Share of a sampled level below which what boxes proved of it is not worth a row.
_TRIFLE = 0.01
#: Samples from which the volume of a set that is no ellipsoid is counted.
_COUNTED = 60_000


@dataclass(frozen=True)
class RegionEstimate:
    """{V < level} around the equilibrium."""

    method: Method
    candidate: LyapunovCandidate
    level: float  #: Proved if ``proved``, else only sampled
    proved: bool
    means: str  #: What proves it, in words
    #: (n, n) array; the set lies in the image of the unit cube by it; what V does elsewhere does
    #: not count
    frame: FloatArray
    #: Level at which sampling found V̇ = 0, an upper bound; None where it was not looked for
    sampled: float | None = None
    samples: int = 0  #: Points that were looked at for it
    boxes: int = 0  #: That the proof needed

    @property
    def label(self) -> str:
        return LABELS[self.method]

    def contains(self, y: FloatArray) -> BoolArray:
        """Which of the deviations (m, n) belong to it."""
        near = np.all(np.abs(np.linalg.solve(self.frame, y.T)) <= 1.0, axis=0)
        return np.asarray(near & (self.candidate.values(y) < self.level))

    def draw(self, count: int, seed: int) -> FloatArray:
        """Deviations in it, uniformly, (m, n); fewer than ``count`` if it is hard to hit."""
        n = self.candidate.system.n
        random, samples = np.random.default_rng(seed), np.zeros((0, n))
        for _ in range(40):
            y = random.uniform(-1.0, 1.0, (4 * count, n)) @ self.frame.T
            samples = np.vstack([samples, y[self.contains(y)]])
            if len(samples) >= count:
                break
        return samples[:count]

    @cached_property
    def log_volume(self) -> float:
        """Natural logarithm of its volume, in the units of y."""
        n = self.candidate.system.n
        z = np.random.default_rng(0).uniform(-1.0, 1.0, (_COUNTED, n))
        share = float(np.mean(self.contains(z @ self.frame.T)))
        whole = n * math.log(2.0) + float(np.linalg.slogdet(self.frame)[1])
        return whole + (math.log(share) if share > 0.0 else -math.inf)

    @cached_property
    def extents(self) -> FloatArray:
        """How far it goes from the equilibrium along each coordinate, to the farther side, (n,)."""
        return np.asarray(np.abs(self.bounds).max(axis=0))

    @cached_property
    def bounds(self) -> FloatArray:
        """The lowest and highest deviation of each coordinate, (2, n).

        Of starts drawn in it and moved outwards on their rays, as far as the set goes: evaluated
        on the set, not proved, and short of the true bounds by the gap between rays.
        """
        y = self.draw(4000, 1)
        for factor in (1.1, 1.01, 1.001):
            moving = np.arange(len(y))
            for _ in range(60):
                moving = moving[self.contains(factor * y[moving])]
                if not len(moving):
                    break
                y[moving] *= factor
        return np.array([y.min(axis=0, initial=0.0), y.max(axis=0, initial=0.0)])


def methods_for(system: ReducedSystem) -> tuple[Method, ...]:
    """All methods for a few states; without those that fit many weights for more."""
    return tuple(LABELS) if system.n <= _FEW else ("lyapunov", "inclusion", "level_set")


def estimates(
    system: ReducedSystem,
    limits: FloatArray,
    methods: Sequence[Method],
    most: int,
    tell: Tell,
    linear_inside: tuple[ReducedSystem, FloatArray] | None = None,
) -> list[RegionEstimate]:
    """Estimates by the methods asked for; one that finds nothing is left out.

    Nothing is sought beyond \\|y_i\\| ≤ limits_i, (n,), nor by more than ``most`` boxes for one
    proof. ``linear_inside`` holds, for the methods by inclusion, simpler equations, and rows (k,
    n): they are the same where \\|row · y\\| < 1 for every row.
    """
    walls, simple = np.diag(1.0 / limits), system
    if linear_inside is not None:
        simple = linear_inside[0]
        walls = np.vstack([walls, linear_inside[1]])
    tell("Lyapunov equation of the linearisation")
    P = from_lyapunov_equation(system)
    first = largest_level(simple, P, walls)
    best = None
    if set(methods) - {"lyapunov"}:
        tell("linear matrix inequalities over a box")
        best = optimise_ellipsoid(simple, walls, first=first)
    results: list[RegionEstimate] = []
    ellipsoids: dict[Method, Ellipsoid | None] = {"lyapunov": first, "inclusion": best}
    for method, shape in ellipsoids.items():
        if method in methods and shape is not None:
            results.append(_ellipsoid(method, system, shape.P / shape.level))
    level_methods: list[Method] = [m for m in ("level_set", "integrals", "quartic") if m in methods]
    shapes = [shape for shape in (Ellipsoid(P, 1.0), best) if shape is not None]
    starts = []
    for P in (shape.P / shape.level for shape in shapes if level_methods):
        rays, candidate = Rays.draw(P, limits, _RAYS, 0), quadratic(system, P)
        level = sampled_level(candidate, rays)
        if level is not None:
            starts.append(_Start(candidate, level, rays))
    for method in level_methods:
        results += _by_level_set(method, system, starts, most, tell)
    return results


@dataclass(frozen=True)
class _Start:
    candidate: LyapunovCandidate
    level: SampledLevel
    rays: Rays


def _by_level_set(
    method: Method, system: ReducedSystem, starts: Sequence[_Start], most: int, tell: Tell
) -> list[RegionEstimate]:
    tell(f"{LABELS[method]}: sampling")
    reached = []
    for start in starts:
        if method == "level_set":
            reached.append((start.candidate, start.level))
            continue
        basis = basis_of(system, 4) if method == "quartic" else basis_of(system, 2, integrals=True)
        if len(basis.names) > len(start.candidate.weights):
            reached.append(expand_level_set(start.candidate, start.level, basis, start.rays))
    if not reached:
        return []
    candidate, level = max(reached, key=lambda pair: pair[1].log_volume)
    largest = max(start.level.log_volume for start in starts)
    if method != "level_set" and level.log_volume < largest + _GAIN:
        return []  # the weights are a quadratic's, which has a row of its own
    proof = LevelProof(0.0, 0, False, frame(candidate, level))
    if system.n <= _FEW:
        tell(f"{LABELS[method]}: proof by boxes")
        proof = proved_level(
            candidate, level, most, _SHARE, lambda words: tell(f"{LABELS[method]}: {words}")
        )

    def estimate(height: float, proved: bool, means: str) -> RegionEstimate:
        by = level.level, level.samples, proof.boxes
        return RegionEstimate(method, candidate, height, proved, means, proof.frame, *by)

    results = []
    if proof.level > _TRIFLE * level.level:
        results.append(estimate(proof.level, True, "V̇ < 0 by interval branch and bound"))
    if not proof.complete:
        means = f"V̇ < 0 at {level.samples} samples only"
        results.append(estimate(_SHARE * level.level, False, means))
    return results


def _ellipsoid(method: Method, system: ReducedSystem, P: FloatArray) -> RegionEstimate:
    value, vectors = np.linalg.eigh(P)
    means = "AᵀP + PA ≺ 0 at all corners of the interval matrix"
    half_axes = vectors / np.sqrt(value)
    return RegionEstimate(method, quadratic(system, P), 1.0, True, means, half_axes)
