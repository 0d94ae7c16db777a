"""``study=lyapunov``: an energy function, its sets N and N′, and every claim about them checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import ComplexArray
from trms_cli.core.chart import Chart
from trms_cli.core.findings import Findings, Section, Table
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.lyapunov import report
from trms_cli.stability.lyapunov.certificate import (
    EnergyRig,
    LevelMotions,
    LyapunovCertificate,
    StabilityClaim,
    certify,
    motions,
    motions_claim,
    on_level,
    plane_directions,
    rig_of,
)
from trms_cli.stability.lyapunov.level_search import rays
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

#: Share of the barrier at which a function that fails is shown.
_SHOWN = 0.05
#: rad, to either side of a yaw angle.
_BESIDE = 1e-6
#: Motions drawn in the plane of each axis, and for how long, s: pitch is hardly damped.
_IN_PLANE = {"h": (8, 6.0), "v": (2, 25.0)}


@dataclass(frozen=True, kw_only=True)
class Lyapunov:
    """A Lyapunov function of the Newtonian or the Lagrangian rig at a constant command."""

    #: Operating point: angles (rad) or commands (V); empty: the rest without command
    at: Mapping[str, float] = field(default_factory=dict)
    #: The energy; or with cross terms of angles and rates, so that V̇ < 0 at once. ``auto``: the
    #: energy, but for two axes with the tail rotor turning, where it cannot fall.
    function: Literal["auto", "energy", "strict"] = "auto"
    budget: Annotated[int, Meta(ge=1, le=1_000_000)] = 4000  #: Boxes for the proof that V falls
    starts: Annotated[int, Meta(ge=1, le=500)] = 12  #: Motions from the edge of N′
    duration: Annotated[float, Meta(gt=0, le=3600)] = 30.0  #: s, of each
    #: Of the random states at which identities are evaluated and motions begin
    seed: Annotated[int, Meta(ge=0)] = 0

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Find the function, check the claims, and follow motions.

        Raises TrmsError for a model or an effect whose energy is not stated, where the model has no
        such equilibrium, and with a controller.
        """
        subject.require_no_loop(
            "study=lyapunov",
            "leave it out: a function is of a constant command; study=region_of_attraction and "
            "study=margins are about loops",
        )
        rig = rig_of(subject)
        point = operating_point(rig.model, self.at, "study.at")
        certificate = certify(rig, point, self.function, self.budget, self.seed, tell)
        found = certificate.search
        candidate, wells = found.candidate, found.wells
        shown = certificate.inner or _SHOWN * (min(wells.depth, 1.0) if wells.depth > 0.0 else 1e-9)
        tell("motions")
        starts = on_level(candidate, wells, shown, rays(candidate, self.starts, self.seed))
        seen = motions(candidate, subject.model, starts, shown, self.duration)
        further = (motions_claim(seen, self.duration),) if certificate.inner > 0.0 else ()
        paths = {}
        for a in candidate.energy.axes:
            count, drawn = _IN_PLANE[a]
            begin = on_level(candidate, wells, shown, plane_directions(candidate, a, count))
            paths[a] = motions(candidate, subject.model, begin, shown, drawn)
        poles = _eigenvalues(rig, point)
        return Findings(
            "Lyapunov function",
            report.lead(certificate, rig, point, float(poles.real.max()), further),
            _sections(certificate, further, seen, paths, shown),
            report.data(certificate, point, poles, further),
            _warnings(certificate, rig),
        )


def _eigenvalues(rig: EnergyRig, point: OperatingPoint) -> ComplexArray:
    """Of the linearisation; on that side of the cable's switch where they lie further right."""
    field_, found = VectorField(rig.model), []
    for side in (-1.0, 1.0):
        x = point.x.copy()
        if "alpha_h" in rig.model.state_names:
            x[rig.model.state_index("alpha_h")] += side * _BESIDE
        A, _ = field_.linearised(x, point.u)
        found.append(np.asarray(np.linalg.eigvals(A), dtype=complex))
    return max(found, key=lambda poles: float(poles.real.max()))


def _sections(
    certificate: LyapunovCertificate,
    further: tuple[StabilityClaim, ...],
    seen: LevelMotions,
    paths: dict[str, LevelMotions],
    shown: float,
) -> list[Section]:
    outer = certificate.outer if np.isfinite(certificate.outer) else 0.0
    display = max(shown, min(outer, certificate.search.wells.depth))
    tables: list[Table | Chart] = [report.claims_table(certificate, further)]
    rising = report.rising_table(certificate)
    sets: list[Table | Chart] = []
    if certificate.inner > 0.0:
        sets.append(report.extent_table(certificate))
    sets += [
        report.plane_chart(certificate, paths, display),
        report.decay_chart(seen, bool(further) and all(claim.holds for claim in further)),
    ]
    return [
        Section(
            "The function",
            (
                *report.formula(certificate.search.candidate),
                "s is how fast a rotor settles, ω̇ = −s(ω). The function is a reconstruction: those "
                "of the thesis are not public.",
            ),
            [report.well_chart(certificate)],
        ),
        Section(
            "Claims",
            (
                "intervals: proved over boxes with outward rounding; identity: derived, and both "
                "sides evaluated on this model's equations; form: true of the expressions as they "
                "stand; simulated: seen, not proved.",
            ),
            [*tables, *([rising] if rising is not None else [])],
        ),
        Section("N and N′", _about_sets(certificate), sets),
    ]


def _about_sets(certificate: LyapunovCertificate) -> tuple[str, ...]:
    if certificate.outer <= 0.0:
        return ("There are none: the figures show the level set of a function that fails.",)
    if certificate.inner <= 0.0:
        return (
            "N: V is positive but at the equilibrium and falls. There is no N′: no closed level "
            "set keeps clear of the mechanical stops.",
        )
    return (
        "N: V is positive but at the equilibrium and falls. N′: the closed level set within N that "
        "no motion leaves, and that keeps clear of the mechanical stops where N does not.",
    )


def _warnings(certificate: LyapunovCertificate, rig: EnergyRig) -> tuple[str, ...]:
    said = []
    if rig.resisting:
        said.append(
            f"{', '.join(rig.resisting)}: the power of friction, −F|Ω|, only adds to the decay; "
            "the proofs are of the equations without it."
        )
    found = certificate.search
    if 0.0 < certificate.outer < 0.999 * found.wells.depth and not certificate.everywhere:
        said.append(
            "N is what is proved with this function and this budget of boxes, not the region of "
            "attraction, which is larger."
        )
    return tuple(said)
