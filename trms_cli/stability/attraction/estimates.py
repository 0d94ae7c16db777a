"""Estimates of the region of attraction by several methods, each with what is proved of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.stability.attraction.inclusion import (
    Ellipsoid,
    from_lyapunov_equation,
    largest_level,
    optimise_ellipsoid,
)
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
from trms_cli.stability.study import Tell

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

    def drawn(self, count: int, seed: int) -> FloatArray:
        """Deviations in it, uniformly, (m, n); fewer than ``count`` if it is hard to hit."""
        n = self.candidate.system.n
        random, found = np.random.default_rng(seed), np.zeros((0, n))
        for _ in range(40):
            y = random.uniform(-1.0, 1.0, (4 * count, n)) @ self.frame.T
            found = np.vstack([found, y[self.contains(y)]])
            if len(found) >= count:
                break
        return found[:count]

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
        y = self.drawn(4000, 1)
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
    found: list[RegionEstimate] = []
    for method, shape in (("lyapunov", first), ("inclusion", best)):
        if method in methods and shape is not None:
            found.append(_ellipsoid(method, system, shape))  # type: ignore[arg-type]
    shapes = [shape for shape in (Ellipsoid(P, 1.0), best) if shape is not None]
    wanted = [m for m in ("level_set", "integrals", "quartic") if m in methods]
    if wanted:
        starts = _sampled(system, shapes, limits)
        for method in wanted:
            found += _by_level_set(method, system, starts, most, tell)  # type: ignore[arg-type]
    return found


@dataclass(frozen=True)
class _Start:
    candidate: LyapunovCandidate
    level: SampledLevel
    rays: Rays


def _sampled(
    system: ReducedSystem, shapes: Sequence[Ellipsoid], limits: FloatArray
) -> list[_Start]:
    found = []
    for shape in shapes:
        P = shape.P / shape.level
        rays = Rays.drawn(P, limits, _RAYS, 0)
        candidate = quadratic(system, P)
        level = sampled_level(candidate, rays)
        if level is not None:
            found.append(_Start(candidate, level, rays))
    return found


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
            reached.append(expand_level_set(start.candidate, start.level, basis, start.rays, 0))
    if not reached:
        return []
    candidate, level = max(reached, key=lambda pair: pair[1].log_volume)
    largest = max(start.level.log_volume for start in starts)
    if method != "level_set" and level.log_volume < largest + _GAIN:
        return []  # the weights are a quadratic's, which has a row of its own
    proof = LevelProof(0.0, 0, False, 0.0, frame(candidate, level))
    if system.n <= _FEW:
        tell(f"{LABELS[method]}: proof by boxes")
        proof = proved_level(
            candidate, level, most, _SHARE, lambda words: tell(f"{LABELS[method]}: {words}")
        )
    common = {"sampled": level.level, "samples": level.samples, "boxes": proof.boxes}
    found = []
    if proof.level > _TRIFLE * level.level:
        means = "V̇ < 0 by interval branch and bound"
        found.append(
            RegionEstimate(method, candidate, proof.level, True, means, proof.frame, **common)  # type: ignore[arg-type]
        )
    if not proof.complete:
        means = f"V̇ < 0 at {level.samples} samples only"
        found.append(
            RegionEstimate(
                method,
                candidate,
                _SHARE * level.level,
                False,
                means,
                frame(candidate, level),
                **common,  # type: ignore[arg-type]
            )
        )
    return found


def _ellipsoid(method: Method, system: ReducedSystem, shape: Ellipsoid) -> RegionEstimate:
    value, vectors = np.linalg.eigh(shape.P / shape.level)
    return RegionEstimate(
        method,
        quadratic(system, shape.P / shape.level),
        1.0,
        True,
        "AᵀP + PA ≺ 0 at all corners of the interval matrix",
        vectors / np.sqrt(value),
    )
