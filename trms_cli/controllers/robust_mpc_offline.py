"""Robust model predictive control by a family of nested ellipsoids made before the run.

After Wan & Kothare 2003 (Automatica 39): the same inequalities as
:mod:`trms_cli.controllers.robust_mpc`, solved once; a step looks its law up. For states ever nearer
to the target, one on each axis of the rig, the inequalities of
:mod:`trms_cli.controllers.robust.lmi` are solved one after the other, each ellipsoid within the
last. In a run the smallest ellipsoid that holds the state is looked up, and its gain interpolated
with that of the next,

    K = a K_i + (1 − a) K_{i+1}      with  z'(a Q_i⁻¹ + (1 − a) Q_{i+1}⁻¹) z = 1

wherever Q_i⁻¹ also falls under K_{i+1} (else K_i acts up to the border).

Here the polytope shrinks with the ellipsoids: each law is made for the coefficients over a box that
holds its ellipsoid, which the state does not leave. They are taken around several targets, so that
one family serves all of them: with less room for the inputs at a target, the ellipsoids shrink by
that share, since laws and inequalities are homogeneous in the state.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.fallback import NOT_FINITE, are_finite, hold_command
from trms_cli.controllers.robust import lmi, polytope
from trms_cli.controllers.robust import regulation as regulation_
from trms_cli.controllers.robust.lmi import Certificate, Inequalities, LmiSolution, Task, certify
from trms_cli.controllers.robust.polytope import box
from trms_cli.controllers.robust.regulation import (
    LAW_NOT_FINITE,
    Aim,
    Positive,
    Regulation,
    RegulationDesign,
    no_law,
)
from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.plugins import require_known
from trms_cli.core.process_cache import cached_result
from trms_cli.core.ranges import NotNegative

#: Share to which the farthest states are brought nearer where no law is found for them.
_SHORTER = 0.8
_SHORTENINGS = 12
#: The box that a law is first tried for, in deviations and in the largest of them.
_REACH, _LEAST_REACH = 1.2, 0.8
_WIDER = 1.1
_WIDENINGS = 8


class Rings(msgspec.Struct):
    """What is kept of a family between runs."""

    inverses: list[list[list[float]]]  #: Q_i⁻¹ from the outermost, each n × n
    gains: list[list[list[float]]]  #: K_i, each m × n
    blends: list[bool]  #: Whether K_i may be mixed with the next
    gammas: list[float]  #: Certified bounds of the cost
    contractions: list[float]  #: Certified, of a step
    positions: list[float]  #: The states that each was made for, as a share of the farthest


@dataclass(frozen=True)
class Family:
    """The lookup."""

    inverses: FloatArray  #: (N, n, n) array; Q_i⁻¹, from the outermost
    gains: FloatArray  #: (N, m, n) array
    blends: BoolArray  #: (N,) array of bool
    rings: Rings
    #: (m,) array; room of the inputs that the family was made for, in units of the scales
    input_bounds: FloatArray

    def share(self, bounds: FloatArray) -> float:
        """How much smaller the ellipsoids are with less room (m,) for the inputs."""
        return float(min(1.0, (bounds / self.input_bounds).min()))

    def gain(self, z: FloatArray) -> tuple[FloatArray, int, float]:
        """The law at a deviation.

        ``z``: (n,); in units of the scales, over :meth:`share`. Returns K, (m, n); the smallest
        ellipsoid that holds z, −1 outside of all, where the outermost gain acts; and z'Q⁻¹z there.
        """
        levels = (self.inverses @ z) @ z
        ring = int(np.searchsorted(levels, 1.0, side="right")) - 1
        if ring < 0:
            return self.gains[0], -1, float(levels[0])
        level = float(levels[ring])
        if ring + 1 == len(levels) or not self.blends[ring]:
            return self.gains[ring], ring, level
        beyond = float(levels[ring + 1])
        a = (beyond - 1.0) / (beyond - level)
        return a * self.gains[ring] + (1.0 - a) * self.gains[ring + 1], ring, level


def make_family(
    design: RegulationDesign,
    regulation: Regulation,
    aims: Sequence[Aim],
    farthest: FloatArray,
    positions: Sequence[float],
) -> Family:
    """The family for all of some targets, from the cache if it was made before.

    ``aims``: the first is the one whose room for the inputs counts. ``farthest``: (k, n); the
    farthest states, in units of the scales. ``positions``: shares of them, from 1 down. Raises
    ConfigurationError if no law is found even near the target.
    """
    inputs = [
        regulation.coordinates.step.serialize(),
        repr(design),
        farthest,
        tuple(positions),
        *(np.concatenate([aim.target.z, aim.target.v]) for aim in aims),
        *(Path(str(module.__file__)).read_bytes() for module in (lmi, polytope, regulation_)),
    ]
    rings = cached_result(
        __file__, inputs, Rings, lambda: _make(design, regulation, aims, farthest, positions)
    )
    return Family(
        np.array(rings.inverses),
        np.array(rings.gains),
        np.array(rings.blends),
        rings,
        regulation.input_bounds(aims[0]),
    )


def _make(
    design: RegulationDesign,
    regulation: Regulation,
    aims: Sequence[Aim],
    farthest: FloatArray,
    positions: Sequence[float],
) -> Rings:
    n = regulation.n
    inequalities = Inequalities(
        n,
        regulation.m,
        2 * len(regulation.model.controlled),
        2**design.principal_components,
        bounded=regulation.bounded,
        states=len(farthest),
        soft=False,
        nested=True,
    )
    rings = Rings([], [], [], [], [], [])
    inside: FloatArray | None = None
    previous: FloatArray | None = None
    far = 1.0
    for position in positions:
        ring = None
        for _ in range(_SHORTENINGS if inside is None else 1):
            ring = _ring(design, regulation, aims, inequalities, far * position * farthest, inside)
            if ring is not None or inside is not None:
                break
            far *= _SHORTER
        if ring is None:
            continue
        task, solution, certificate = ring
        if previous is not None:
            rings.blends[-1] = _falls(task.A, task.B, solution.K, previous)
        inside = solution.Q[0]
        previous = np.linalg.inv(inside)
        rings.inverses.append(previous.tolist())
        rings.gains.append(solution.K.tolist())
        rings.blends.append(False)
        rings.gammas.append(certificate.gamma)
        rings.contractions.append(certificate.contraction)
        rings.positions.append(far * position)
    if not rings.gains:
        raise no_law(regulation.model)
    return rings


def _ring(
    design: RegulationDesign,
    regulation: Regulation,
    aims: Sequence[Aim],
    inequalities: Inequalities,
    z: FloatArray,
    inside: FloatArray | None,
) -> tuple[Task, LmiSolution, Certificate] | None:
    """The law for states z (k, n), its ellipsoid within the box of its own polytope."""
    extents = _REACH * np.abs(z).max(axis=0) + _LEAST_REACH * float(np.abs(z).max())
    for _ in range(_WIDENINGS):
        coefficients = np.concatenate(
            [
                regulation.coefficients.over(aim.target, regulation.region_of(aim.target, extents))
                for aim in aims
            ]
        )
        vertices = box(coefficients, design.principal_components, design.margin)
        task = regulation.task(vertices, aims[0], z)
        solution = inequalities.solve(task, inside)
        if solution is None:
            return None
        certificate = certify(task, solution)
        if not (certificate.stable and certificate.constrained):
            return None
        reached = np.sqrt(np.diag(solution.Q[0]))
        if regulation.covers(aims[0].target, extents, reached):
            return task, solution, certificate
        extents = np.maximum(extents, _WIDER * reached)
    return None


def _falls(A: FloatArray, B: FloatArray, K: FloatArray, inverse: FloatArray) -> bool:
    """Whether z'Q⁻¹z falls under a law at every vertex."""
    closed = A + B @ K
    rest = inverse - np.einsum("kba,bc,kcd->kad", closed, inverse, closed)
    return bool(np.linalg.eigvalsh(rest).min() > 0.0)


@dataclass
class RobustMpcOfflineState:
    """What changes during a run."""

    regulation: Regulation
    family: Family
    aim: Aim | None = None  #: The target of the last sample
    share: float = 1.0  #: By which the family's ellipsoids are shrunk at the target


@dataclass(frozen=True, kw_only=True)
class RobustMpcOffline(RegulationDesign):
    """Robust MPC by lookup."""

    #: The farthest states that laws are made for: a deviation of each controlled angle, rad
    widest: Mapping[str, Positive] = field(default_factory=dict)
    #: Half-width of the references that the family serves, rad; beyond, its certificate does not
    #: hold
    targets: Mapping[str, NotNegative] = field(default_factory=dict)
    rings: Annotated[int, Meta(ge=1)] = 12  #: Ellipsoids
    #: States that the innermost is made for, as a share of the farthest
    smallest: Annotated[float, Meta(gt=0, lt=1)] = 0.02

    def init(self, setup: ControlSetup) -> RobustMpcOfflineState:
        """The family, made or read from the user's cache."""
        regulation = Regulation(self, setup)
        model = setup.model
        widest = _angles(self.widest, model.controlled, 0.5, "widest")
        reach = _angles(self.targets, model.controlled, 0.0, "targets")
        farthest = np.array([regulation.angles(row) for row in np.diag(widest)])
        corners = itertools.product((0.0, -1.0, 1.0), repeat=len(reach))
        every = [regulation.aim_at(np.array(corner) * reach) for corner in corners]
        aims = [aim for aim in every if aim.steady.exact]
        positions = np.geomspace(1.0, self.smallest, self.rings).tolist()
        return RobustMpcOfflineState(
            regulation, make_family(self, regulation, aims, farthest, positions)
        )

    def step(
        self, state: RobustMpcOfflineState, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """One sample: target, lookup, command."""
        regulation, family = state.regulation, state.family
        x, w = sample.estimate.x, sample.estimate.disturbance
        if not are_finite(x, w, sample.reference):
            return hold_command(regulation.limited(sample.previous_command), NOT_FINITE)
        if not self.disturbance_compensation:
            w = np.zeros_like(w)
        aim = regulation.aim(sample, state.aim, w)
        if aim is not state.aim:
            state.aim, state.share = aim, family.share(regulation.input_bounds(aim))
        z = regulation.deviation(x, aim.target)
        K, ring, level = family.gain(z / state.share)
        u = regulation.command(x, aim, z, K @ z)
        if not np.isfinite(u).all():  # an estimate beyond all bounds
            return hold_command(regulation.limited(sample.previous_command), LAW_NOT_FINITE)
        message, status = aim.message, Status.OK
        if ring < 0:
            status = Status.RELAXED
            message = message or "outside of all ellipsoids; the outermost law is cut to the limits"
        cost = family.rings.gammas[max(ring, 0)] * level * state.share**2
        return Command(
            u, status, objective=cost, message=message, out_of_reach=aim.steady.projected
        )


def _angles(
    values: Mapping[str, float], controlled: tuple[str, ...], default: float, key: str
) -> FloatArray:
    angle_names = {"alpha_v", "alpha_h", *controlled}
    for name in values:
        require_known(name, angle_names, f"{name!r} is not a controlled angle", f"controller.{key}")
    return np.array([values.get(name, default) for name in controlled])
