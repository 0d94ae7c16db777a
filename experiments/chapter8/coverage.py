"""How much of the nonlinear model a polytope contains, and the yaw's gain at standstill."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from experiments.chapter8.judgement import are_inside, independent_cube, remainder
from experiments.chapter8.laws import Bench
from experiments.chapter8.study import FloatArray, Study
from trms_cli.controllers.robust.lmi import certify
from trms_cli.controllers.robust.polytope import box


@dataclass(frozen=True)
class ContainmentCheck:
    """One polytope against independent points."""

    size: float  #: Half-width of its region, in typical sizes
    components: int
    spread: float  #: Largest width of a coefficient, in units of the scales
    inside: float  #: Share of the points whose components are inside
    #: Upper bound on the share outside that holds with the stated confidence (binomial tail)
    outside_bound: float
    median: float  #: Remainder, spectral norm
    largest: float  #: Remainder, spectral norm
    #: Largest that the coefficients leave of the step itself, in units of the scales
    residual: float


@dataclass(frozen=True)
class Gain:
    """A treatment of the standing tail rotor."""

    name: str
    weakest: float  #: Least yaw gain over the largest, among the coefficients
    gamma: float  #: Certified cost of the yaw deviation, NaN without a law
    neglected: float  #: Torque on yaw that the treatment leaves out, N m
    yaw: float  #: What that torque holds off against the cable alone, rad


def study_coverage(study: Study) -> tuple[list[ContainmentCheck], dict[float, FloatArray]]:
    """Every size and number of components; the coefficients by size, for the figure."""
    bench, s = Bench(), study.coverage
    r = bench.regulation
    cube = independent_cube(s.points, r.n + r.m, study.seed)
    checks, clouds = [], {}
    for size in s.sizes:
        region = r.region_of(bench.aim.target, np.full(r.n, size))
        samples = r.coefficients.over(bench.aim.target, region)
        others = r.coefficients.over(bench.aim.target, region, cube)
        residual = r.coefficients.residual(bench.aim.target, region, cube[:2000])
        clouds[size] = others[:1500]
        for components in s.components:
            polytope = box(samples, components, bench.controller.margin)
            inside = are_inside(polytope, others)
            distances = remainder(polytope, others)
            checks.append(
                ContainmentCheck(
                    size,
                    components,
                    float(np.ptp(others, axis=0).max()),
                    float(inside.mean()),
                    _upper_bound(int((~inside).sum()), len(inside), s.confidence),
                    float(np.median(distances)),
                    float(distances.max()),
                    float(np.abs(residual).max()),
                )
            )
    return checks, clouds


def _upper_bound(hits: int, trials: int, risk: float) -> float:
    """Clopper–Pearson bound on a probability after ``hits`` in ``trials`` independent trials."""
    from scipy.stats import beta

    return float(beta.ppf(1.0 - risk, hits + 1, trials - hits)) if hits < trials else 1.0


def study_standstill(study: Study) -> list[Gain]:
    """Lower bounds on the slope of the thrust, then the thrust as a coordinate."""
    s = study.standstill
    rows = []
    speed = Bench(thrust_inputs=[])
    names = {p.name: p.value for p in speed.model.parameters}
    slope = max(names["k_fhp"], names["k_fhn"]) * names["l_t"]
    soft = min(names["k_chp"], names["k_chn"])
    for bound in s.bounds:
        torque = slope * bound**2 / 4
        gain, gamma = _yaw(speed, s.yaw, bound)
        name = "speed" if bound == 0 else f"speed, slope at {bound:g} rad/s at least"
        rows.append(Gain(name, gain, gamma, torque, torque / soft))
    thrust = Bench()
    torque = slope * thrust.controller.smallest_speed**2 / 2
    gain, gamma = _yaw(thrust, s.yaw, 0.0)
    rows.append(Gain("thrust", gain, gamma, torque, torque / soft))
    return rows


def _yaw(bench: Bench, yaw: float, bound: float) -> tuple[float, float]:
    """The weakest yaw gain, and γ, with the slope of the thrust at least that at a speed."""
    r, c, target = bench.regulation, bench.controller, bench.aim.target
    z = bench.deviation((yaw, 0.0), hover=True)
    region = r.region_of(target, c.reach * np.abs(z) + c.least_reach)
    cube = independent_cube(c.points, r.n + r.m, 0)
    cube[: 2 * r.n] = np.clip(3 * cube[: 2 * r.n], -1, 1)
    if bound > 0:
        half = float(region.upper[0] - region.lower[0]) / 2
        cube[:, 0] = np.where(cube[:, 0] < 0, -1, 1) * np.maximum(
            np.abs(cube[:, 0]), min(1.0, bound / half)
        )
    coefficients = r.coefficients.over(target, region, cube)
    row = r.coordinates.names.index("dalpha_h")
    gains = np.abs(coefficients[:, row, 0])
    task = r.task(box(coefficients, c.principal_components, c.margin), bench.aim, z)
    solution = bench.solve(task)
    certificate = None if solution is None else certify(task, solution)
    gamma = (
        certificate.gamma
        if certificate is not None and certificate.stable and certificate.constrained
        else math.nan
    )
    return float(gains.min() / gains.max()), gamma
