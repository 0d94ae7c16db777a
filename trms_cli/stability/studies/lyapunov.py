"""``study=lyapunov``: an energy function, its sets N and N′, and every claim about them checked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import BoolArray, ComplexArray, FloatArray
from trms_cli.core.chart import Axis, Chart, Contour, Curve, Line, Mark, Note, Panel, Points, Region
from trms_cli.core.findings import (
    Column,
    Datum,
    Findings,
    Judgement,
    Measure,
    Section,
    Table,
    json_data,
    round_significant,
    table,
)
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.intervals.interval import Interval, definite
from trms_cli.stability.lyapunov.candidate import EnergyCandidate, rays
from trms_cli.stability.lyapunov.certificate import (
    EnergyRig,
    LevelMotions,
    LyapunovCertificate,
    RisingState,
    StabilityClaim,
    certify,
    motions,
    motions_claim,
    on_level,
    plane_directions,
    rig_of,
)
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
        result = certificate.search
        candidate, wells = result.candidate, result.wells
        display_level = certificate.inner or _SHOWN * (
            min(wells.depth, 1.0) if wells.depth > 0.0 else 1e-9
        )
        tell("motions")
        starts = on_level(candidate, wells, display_level, rays(candidate, self.starts, self.seed))
        sample_motions = motions(candidate, subject.model, starts, display_level, self.duration)
        further = (motions_claim(sample_motions, self.duration),) if certificate.inner > 0.0 else ()
        paths = {}
        for a in candidate.energy.axes:
            count, plane_duration = _IN_PLANE[a]
            begin = on_level(candidate, wells, display_level, plane_directions(candidate, a, count))
            paths[a] = motions(candidate, subject.model, begin, display_level, plane_duration)
        poles = _eigenvalues(rig, point)
        return Findings(
            "Lyapunov function",
            lead(certificate, rig, point, float(poles.real.max()), further),
            _sections(certificate, further, sample_motions, paths, display_level),
            data(certificate, point, poles, further),
            _warnings(certificate, rig),
            _measures(certificate, further),
        )


def _eigenvalues(rig: EnergyRig, point: OperatingPoint) -> ComplexArray:
    """Of the linearisation; on that side of the cable's switch where they lie further right."""
    field_, spectra = VectorField(rig.model), []
    for side in (-1.0, 1.0):
        x = point.x.copy()
        if "alpha_h" in rig.model.state_names:
            x[rig.model.state_index("alpha_h")] += side * _BESIDE
        A, _ = field_.linearised(x, point.u)
        spectra.append(np.asarray(np.linalg.eigvals(A), dtype=complex))
    return max(spectra, key=lambda poles: float(poles.real.max()))


def _sections(
    certificate: LyapunovCertificate,
    further: tuple[StabilityClaim, ...],
    sample_motions: LevelMotions,
    paths: dict[str, LevelMotions],
    display_level: float,
) -> list[Section]:
    outer = certificate.outer if np.isfinite(certificate.outer) else 0.0
    display = max(display_level, min(outer, certificate.search.wells.depth))
    claims: list[Table | Chart] = [claims_table(certificate, further)]
    if certificate.rising is not None:
        claims.append(rising_table(certificate, certificate.rising))
    sets: list[Table | Chart] = []
    if certificate.inner > 0.0:
        sets.append(extent_table(certificate))
    sets += [
        plane_chart(certificate, paths, display),
        decay_chart(sample_motions, bool(further) and all(claim.holds for claim in further)),
    ]
    return [
        Section(
            "The function",
            (
                *formula(certificate.search.candidate),
                "s is how fast a rotor settles, ω̇ = −s(ω). The function is a reconstruction: those "
                "of the thesis are not public.",
            ),
            [well_chart(certificate)],
        ),
        Section(
            "Claims",
            (
                "intervals: proved over boxes with outward rounding; identity: derived, and both "
                "sides evaluated on this model's equations; form: true of the expressions as they "
                "stand; simulated: seen, not proved.",
            ),
            claims,
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
    warnings = []
    if rig.resisting:
        warnings.append(
            f"{', '.join(rig.resisting)}: the power of friction, −F|Ω|, only adds to the decay; "
            "the proofs are of the equations without it."
        )
    result = certificate.search
    if 0.0 < certificate.outer < 0.999 * result.wells.depth and not certificate.everywhere:
        warnings.append(
            "N is what is proved with this function and this budget of boxes, not the region of "
            "attraction, which is larger."
        )
    return tuple(warnings)


_JUDGED: dict[str, Judgement] = {"failed": "bad", "open": "doubtful", "simulated": ""}
_SPOKEN = {"Omega": "Ω", "omega": "ω", "alpha": "α"}
_UNIT = {"Omega": "rad/s", "omega": "rad/s", "alpha": "rad"}


def formula(candidate: EnergyCandidate) -> list[str]:
    """V with its numbers, a line a term."""
    energy, w, c = candidate.energy, candidate.weights, candidate.energy.c
    y = candidate.centre
    rates = {a: f"Ω_{a}" for a in energy.axes}
    if w.strict:
        cross = {"h": w.cross_h, "v": w.cross_v}
        rates = {
            a: f"(Ω_{a} + {cross[a]:.3g} (α_{a} − {_place(candidate, 'alpha', a)}))"
            for a in energy.axes
        }
    gamma = "" if w.yaw == 1.0 else f"{w.yaw:g} · "
    lines = []
    if energy.k == 2 and energy.weighted:
        lines.append(f"V = {gamma}½ J_h(α_v) {rates['h']}² + ½ J_v {rates['v']}²")
    elif energy.k == 2:
        lines.append(f"V = ½ yᵀM(α_v) y, y = ({rates['h']}, {rates['v']})")
    else:
        (a,) = energy.axes
        inertia = float(candidate.inertias(Interval.point(y[None])).upper[0, 0, 0])
        lines.append(f"V = ½ · {inertia:.4g} kg m² · {rates[a]}²")
    for a in energy.axes:
        if a == "h":
            stiff = f"½ k_ch(α_h) α_h² [{c['k_chp']:.4g}, {c['k_chn']:.4g} N m/rad]"
            lines.append(
                f"  + {gamma}U_h: {stiff}, tilted to rest at {_place(candidate, 'alpha', a)}"
            )
        else:
            size = math.hypot(*energy.gravity)
            tilt = math.atan2(-energy.gravity[0], -energy.gravity[1])
            rest = float(y[energy.index("alpha", a)])
            lines.append(
                f"  + U_v: {size:.4g} N m · [cos({rest + tilt:.4g}) − cos(α_v + {tilt:.4g}) "
                f"− sin({rest + tilt:.4g}) (α_v − {_place(candidate, 'alpha', a)})]"
            )
    if w.strict:
        lines.append("  + ½ α̃ᵀΓE(K − M E)α̃")
    for a in energy.axes:
        weight = w.rotor_h if a == "h" else w.rotor_v
        lines.append(
            f"  + {weight:.4g} · ∫ s_{a} dω_{a} from {_place(candidate, 'omega', a)} rad/s to ω_{a}"
        )
    return lines


def _place(candidate: EnergyCandidate, what: str, axis: str) -> str:
    value = float(candidate.centre[candidate.energy.index(what, axis)])
    return f"{0.0 if abs(value) < 5e-9 else value:.4g}"


def _measures(
    certificate: LyapunovCertificate, further: tuple[StabilityClaim, ...]
) -> list[Measure]:
    """The levels of N and N′, and how many of the claims hold."""
    claims = [*certificate.claims, *further]
    held = sum(claim.holds for claim in claims)
    good: Judgement = "good" if claims and held == len(claims) else "bad"
    measures = [Measure("claims that hold", f"{held} of {len(claims)}", "", good)]
    if certificate.outer > 0.0:
        outer = "all states" if certificate.everywhere else certificate.outer
        unit = "" if certificate.everywhere else "J"
        measures.append(Measure("N: V <", outer, unit, "", "falls and goes to rest"))
    if certificate.inner > 0.0:
        measures.append(Measure("N′: V ≤", certificate.inner, "J", "", "no motion leaves it"))
    return measures


def lead(
    certificate: LyapunovCertificate,
    rig: EnergyRig,
    point: OperatingPoint,
    growth: float,
    further: tuple[StabilityClaim, ...] = (),
) -> tuple[str, ...]:
    """The answer; what is not shown comes first, and nothing is said that rests on it."""
    result, words = certificate.search, point.words(rig.model)
    kind = "strict function" if result.candidate.weights.strict else "energy"
    if certificate.outer <= 0.0:
        rising, conclusion = certificate.rising, f"the {kind} is a Lyapunov function on any set"
        failure = [f"At {words} it is not proved that {conclusion}."]
        if rising is not None:
            failure = [
                f"At {words} the {kind} is no Lyapunov function: about the equilibrium V rises.",
                f"At a state with V = {rising.value:.3g} J, V̇ = {rising.derivative:.3g} W.",
            ]
        others = (
            "No other function can be one either: the linearisation is unstable (growth "
            f"{growth:.3g} 1/s)."
            if growth > 0.0
            else f"The linearisation is stable (decay {-growth:.3g} 1/s), so that other functions "
            "exist: study=region_of_attraction finds them by computation."
        )
        return *failure, others
    unshown = [claim for claim in (*certificate.claims, *further) if not claim.holds]
    if unshown:
        which = "; ".join(f"“{claim.statement}” ({claim.how})" for claim in unshown)
        return (
            f"At {words} it is not shown that the {kind} is a Lyapunov function on the sets below. "
            f"What does not hold, or is left open: {which}.",
            f"The levels that were found, {_level(certificate)}, count only if that is settled.",
        )
    sentences = [
        f"At {words} the equilibrium is globally asymptotically stable: the {kind} falls at all "
        "states of the equations, and N is the whole space."
        if certificate.everywhere
        else f"At {words} the {kind} is a Lyapunov function on N, the part of {{V < "
        f"{certificate.outer:.4g} J}} about the equilibrium; what ends N is "
        f"{_end_of_outer(certificate)}."
    ]
    if certificate.inner <= 0.0:
        sentences.append(
            f"There is no N′: the equilibrium is at {certificate.bounded_by} or beyond it, so that "
            "no set about it keeps clear of the stop."
        )
        return tuple(sentences)
    ends = f"below {certificate.bounded_by}" if certificate.bounded_by[:3] == "the" else ""
    goal = "comes to rest where friction holds it" if rig.dry else "goes to the equilibrium"
    sentences.append(
        f"N′ = {{V <= {certificate.inner:.4g} J}}, {ends}, is compact, no motion leaves it, and "
        f"every motion in it {goal}."
    )
    if certificate.rising is not None:
        sentences.append(
            f"V rises at a state with V = {certificate.rising.value:.3g} J: beyond that level this "
            "function can prove nothing."
        )
    return tuple(sentences)


def _level(certificate: LyapunovCertificate) -> str:
    outer = f"V < {certificate.outer:.4g} J" if math.isfinite(certificate.outer) else "all states"
    inner = f"V <= {certificate.inner:.4g} J" if certificate.inner > 0.0 else "none"
    return f"N: {outer}, N′: {inner}"


def _end_of_outer(certificate: LyapunovCertificate) -> str:
    result = certificate.search
    if certificate.outer >= result.wells.depth * (1.0 - 1e-6):
        assert result.wells.saddles is not None
        ends = result.wells.ends[-1]  # pitch is the last axis where it moves
        low, high = (result.candidate.well_at("v", float(end)) for end in (ends.lower, ends.upper))
        which = result.wells.saddles[0 if low < high else 1]
        return f"the saddle at alpha_v = {which:.4g} rad"
    return "the decay of V, proved up to there"


def claims_table(certificate: LyapunovCertificate, further: tuple[StabilityClaim, ...]) -> Table:
    """Every claim and how it was checked."""
    return table(
        (*certificate.claims, *further),
        [
            Column("claim", "statement"),
            Column("checked by", lambda claim: Datum(claim.how, _JUDGED.get(claim.how, "good"))),
            Column("figures", "detail"),
        ],
        "Claims",
    )


def extent(certificate: LyapunovCertificate) -> dict[str, tuple[float, float]]:
    """How far N′ reaches in each state of motion."""
    candidate = certificate.search.candidate
    box = candidate.extent(certificate.inner, certificate.search.wells.ends)
    pairs = zip(candidate.energy.names(), box.lower, box.upper, strict=True)
    return {name: (float(low), float(high)) for name, low, high in pairs}


def extent_table(certificate: LyapunovCertificate) -> Table:
    """The box around N′."""
    rest = certificate.search.candidate.centre
    return Table(
        ("state", "from", "equilibrium", "to"),
        [
            [_head(name), round(low, 4), round(float(centre), 4) + 0.0, round(high, 4)]
            for (name, (low, high)), centre in zip(extent(certificate).items(), rest, strict=True)
        ],
        "The box around N′, each state with the others at the equilibrium",
    )


def rising_table(certificate: LyapunovCertificate, rising: RisingState) -> Table:
    """The counterexample."""
    names = certificate.search.candidate.energy.names()
    state = zip(names, rising.y, strict=True)
    rows = [(_head(name), round_significant(value, 6)) for name, value in state]
    rows.append(("V [J]", round_significant(rising.value)))
    rows.append(("V̇ [W]", round_significant(rising.derivative)))
    return Table(("at the state", ""), rows, "Where V rises, confirmed with outward rounding")


def _head(name: str) -> str:
    """``Ω_h [rad/s]``."""
    what, axis = name.split("_")
    return f"{_SPOKEN[what]}_{axis} [{_UNIT[what]}]"


def data(
    certificate: LyapunovCertificate,
    point: OperatingPoint,
    poles: ComplexArray,
    further: tuple[StabilityClaim, ...],
) -> dict[str, Any]:
    """The figures as JSON data."""
    result, rising = certificate.search, certificate.rising
    names, depth = result.candidate.energy.names(), result.wells.depth
    return json_data(
        {
            "function": "strict" if result.candidate.weights.strict else "energy",
            "holds": certificate.holds and all(claim.holds for claim in further),
            "operating_point": {"x": point.x, "u": point.u},
            "weights": result.candidate.weights,
            "formula": formula(result.candidate),
            "N": {"everywhere": certificate.everywhere, "level": certificate.outer},
            "N_prime": {
                "level": certificate.inner if certificate.inner > 0.0 else None,
                "bounded_by": certificate.bounded_by if certificate.outer > 0.0 else None,
                "extent": extent(certificate) if certificate.inner > 0.0 else None,
            },
            "well": {"depth": depth if depth > 0.0 else None, "saddles": result.wells.saddles},
            "boxes": result.decay_level.examined,
            "counterexample": None
            if rising is None
            else {
                "state": dict(zip(names, rising.y, strict=True)),
                "V": rising.value,
                "V_dot": rising.derivative,
            },
            "eigenvalues": poles,
            "claims": [
                {
                    "name": claim.name,
                    "statement": claim.statement,
                    "checked_by": claim.how,
                    "detail": claim.detail,
                }
                for claim in (*certificate.claims, *further)
            ],
        }
    )


_GRID = 101


def well_chart(certificate: LyapunovCertificate) -> Chart:
    """U of each axis with its equilibria, levels and stops."""
    panels = [_well(certificate, a) for a in certificate.search.candidate.energy.axes]
    caption = (
        "The potential of each axis at the constant command, zero at the equilibrium. A motion "
        "that begins below a level stays between the walls it meets there."
    )
    return Chart("lyapunov_well", panels, caption, columns=len(panels))


def _well(certificate: LyapunovCertificate, axis: str) -> Panel:
    candidate, wells = certificate.search.candidate, certificate.search.wells
    energy = candidate.energy
    rest = float(candidate.centre[energy.index("alpha", axis)])
    stop = energy.model.stops[f"alpha_{axis}"]
    marks: list[Mark] = []
    if axis == "v" and wells.saddles is not None:
        low, high = wells.saddles
        ends = (max(low - 0.3, rest - 2.6), min(high + 0.5, rest + 2.6))
    else:
        reach = stop * 1.15 if math.isfinite(stop) else 3.0
        ends = (-reach, reach)
    angles = np.linspace(*ends, 301)
    marks.append(Curve(angles, _potential(candidate, axis, angles), width=2.0))
    top = float(np.nanmax(_potential(candidate, axis, angles)))
    for saddle in wells.saddles or () if axis == "v" else ():
        if ends[0] <= saddle <= ends[1]:
            height = _potential(candidate, axis, np.array([saddle]))
            marks.append(Points([saddle], height, "saddle", "saddle", "vermilion"))
    if certificate.outer > 0.0 and math.isfinite(certificate.outer):
        marks.append(Line(y=certificate.outer, label="edge of N", colour="orange", style="dashed"))
    if certificate.inner > 0.0:
        marks.append(Line(y=certificate.inner, label="edge of N′", colour="green", style="dashed"))
    if math.isfinite(stop):
        marks += [
            Line(x=end, label="stop", colour="grey")
            for end in (-stop, stop)
            if ends[0] <= end <= ends[1]
        ]
    marks.append(Points([rest], [0.0], "equilibrium", "stable", "ink"))
    return Panel(
        Axis(f"α_{axis}", "rad", ends),
        Axis(f"U_{axis}", "J", (-0.05 * top, 1.05 * top)),
        marks,
        "Pitch" if axis == "v" else "Yaw",
    )


def _potential(candidate: EnergyCandidate, axis: str, angles: FloatArray) -> FloatArray:
    y = np.tile(candidate.centre, (len(angles), 1))
    y[:, candidate.energy.index("alpha", axis)] = angles
    cross = candidate.weights
    plain = candidate.weighted(type(cross)(cross.rotor_h, cross.rotor_v, cross.yaw))
    return plain.value(y)


def plane_chart(
    certificate: LyapunovCertificate, paths: dict[str, LevelMotions], display: float
) -> Chart:
    """N and N′ in the plane of each angle and its rate, and where the decay is not proved."""
    candidate = certificate.search.candidate
    panels = [_plane(certificate, a, paths.get(a), display) for a in candidate.energy.axes]
    if candidate.energy.k == 2:
        panels.append(_limits(certificate, display))
    else:
        (a,) = candidate.energy.axes
        panels.append(_rates(certificate, a, display))
    caption = (
        "Level lines of V, with all that is not on the axes at the equilibrium. Motions cross them "
        "inwards."
    )
    return Chart("lyapunov_sets", panels, caption, columns=min(len(panels), 3), width=4.0)


def _grid(
    certificate: LyapunovCertificate, first: tuple[str, str], second: tuple[str, str], level: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Grid lines around {V <= level}, states of motion on them (m, 3k), and V (rows, columns)."""
    candidate = certificate.search.candidate
    energy, rest = candidate.energy, candidate.centre
    box = candidate.extent(level, certificate.search.wells.ends)
    lines = []
    for what, axis in (first, second):
        j = energy.index(what, axis)
        low, high = float(box.lower[j]), float(box.upper[j])
        if what == "Omega":  # as far as the set goes at the equilibrium's inertia
            i, gamma = energy.axes.index(axis), candidate.weights.yaw if axis == "h" else 1.0
            inertia = np.array(energy.inertia(rest))
            reach = 1.1 * math.sqrt(2.0 * level * np.linalg.inv(inertia)[i, i] / gamma)
            low, high = max(low, -reach), min(high, reach)
        room = 0.08 * (high - low)
        lines.append(np.linspace(low - room, high + room, _GRID))
    places = np.tile(rest, (_GRID, _GRID, 1))
    places[:, :, energy.index(*first)] = lines[0][None, :]
    places[:, :, energy.index(*second)] = lines[1][:, None]
    flat = places.reshape(-1, places.shape[2])
    return lines[0], lines[1], flat, candidate.value(flat).reshape(_GRID, _GRID)


def _plane(
    certificate: LyapunovCertificate, axis: str, plane_motions: LevelMotions | None, display: float
) -> Panel:
    candidate, wells = certificate.search.candidate, certificate.search.wells
    energy = candidate.energy
    x, y, _, value = _grid(certificate, ("alpha", axis), ("Omega", axis), display)
    i = energy.axes.index(axis)
    between = (x > wells.ends.lower[i]) & (x < wells.ends.upper[i])
    marks: list[Mark] = _sets(certificate, x, y, value, between)
    levels = [display * share for share in (0.05, 0.2, 0.45, 0.7, 1.0)]
    marks.append(Contour(x, y, value, levels, "level sets of V", "grey", width=0.8))
    if plane_motions is not None:
        angles, rates = (plane_motions.y[:, :, energy.index(w, axis)].T for w in ("alpha", "Omega"))
        for m, (angle, rate) in enumerate(zip(angles, rates, strict=True)):
            label = "motions" if m == 0 else ""
            marks.append(Curve(angle, rate, label, "blue", width=0.9, arrow=True))
    rest = float(candidate.centre[energy.index("alpha", axis)])
    marks.append(Points([rest], [0.0], "equilibrium", "stable", "ink"))
    for saddle in (wells.saddles or ()) if axis == "v" else ():
        if x[0] <= saddle <= x[-1]:
            marks.append(Points([saddle], [0.0], "saddle", "saddle", "vermilion"))
    return Panel(
        Axis(f"α_{axis}", "rad", (float(x[0]), float(x[-1]))),
        Axis(f"Ω_{axis}", "rad/s", (float(y[0]), float(y[-1]))),
        marks,
        "Pitch, rotors settled" if axis == "v" else "Yaw, rotors settled",
    )


def _sets(
    certificate: LyapunovCertificate,
    x: FloatArray,
    y: FloatArray,
    value: FloatArray,
    between: BoolArray,
) -> list[Mark]:
    marks: list[Mark] = []
    inside = np.broadcast_to(between, value.shape)
    if math.isfinite(certificate.outer) and certificate.outer > 0.0:
        marks.append(Region(x, y, (value < certificate.outer) & inside, "N", "orange", 0.3))
        marks.append(Contour(x, y, value, [certificate.outer], colour="orange", width=1.2))
    if certificate.inner > 0.0:
        marks.append(Region(x, y, (value <= certificate.inner) & inside, "N′", "green", 0.35))
        marks.append(Contour(x, y, value, [certificate.inner], colour="green", width=1.4))
    return marks


def _limits(certificate: LyapunovCertificate, display: float) -> Panel:
    """Where Q is not definite, beside N, over pitch and the rate of yaw."""
    candidate, first, second = certificate.search.candidate, ("alpha", "v"), ("Omega", "h")
    whole = certificate.outer >= certificate.search.wells.depth * (1.0 - 1e-6)
    x, y, flat, value = _grid(certificate, first, second, display if whole else 1.6 * display)
    bad = ~definite(candidate.matrices(Interval.point(flat)))[0].reshape(_GRID, _GRID)
    marks = _sets(certificate, x, y, value, np.ones(_GRID, dtype=bool))
    if bad.any():
        marks.append(Region(x, y, bad, "no decay proved", "vermilion", 0.3))
    marks.append(
        Contour(x, y, value, [display * s for s in (0.1, 0.4, 1.0)], "", "grey", width=0.8)
    )
    marks.append(_centre(candidate, first, second))
    return Panel(
        Axis(_name(first), _UNIT[first[0]]),
        Axis(_name(second), _UNIT[second[0]]),
        marks,
        "The decay is proved all over" if whole else "Where the decay ends",
    )


def _rates(certificate: LyapunovCertificate, axis: str, display: float) -> Panel:
    """V̇ over rotor speed and rate."""
    candidate = certificate.search.candidate
    first, second = ("omega", axis), ("Omega", axis)
    x, y, flat, value = _grid(certificate, first, second, display)
    rate = candidate.derivative(candidate.states(flat)).reshape(_GRID, _GRID)
    marks = _sets(certificate, x, y, value, np.ones(_GRID, dtype=bool))
    # The decay −V̇: the minus sign of a negative level is lost in the line that it stands on.
    fastest = float(-rate.min())
    factor, unit = next(
        (f, u) for f, u in ((1.0, "W"), (1e3, "mW"), (1e6, "µW")) if f * fastest >= 1.0 or f == 1e6
    )
    levels = [float(f"{factor * fastest * s:.2g}") for s in (0.6, 0.3, 0.1, 0.03, 0.01)]
    label = f"decay −V̇ [{unit}]"
    marks.append(Contour(x, y, -factor * rate, levels, label, "purple", width=1.0, numbers=True))
    if (rate > 0.0).any():
        marks.append(Region(x, y, rate > 0.0, "V̇ > 0", "vermilion", 0.3))
    marks.append(_centre(candidate, first, second))
    return Panel(
        Axis(_name(first), _UNIT[first[0]], (float(x[0]), float(x[-1]))),
        Axis(_name(second), _UNIT[second[0]], (float(y[0]), float(y[-1]))),
        marks,
        "Decay −V̇ over rotor speed and rate",
    )


def _centre(candidate: EnergyCandidate, first: tuple[str, str], second: tuple[str, str]) -> Points:
    rest, index = candidate.centre, candidate.energy.index
    return Points([rest[index(*first)]], [rest[index(*second)]], "equilibrium", "stable", "ink")


def _name(which: tuple[str, str]) -> str:
    return f"{_SPOKEN[which[0]]}_{which[1]}"


def decay_chart(sample_motions: LevelMotions, proved: bool) -> Chart:
    """V over time."""
    share = np.maximum(sample_motions.value / sample_motions.level, 1e-12)
    marks: list[Mark] = [
        Curve(sample_motions.time, share[:, m], "motions" if m == 0 else "", "blue", width=0.9)
        for m in range(share.shape[1])
    ]
    marks.append(Line(y=1.0, label="start", colour="green", style="dashed"))
    if not proved:
        marks.append(
            Note(float(sample_motions.time[-1]) * 0.05, float(share.max()), "V rises", "vermilion")
        )
    low = max(1e-9, 0.5 * float(share.min()))
    y_axis = Axis("V / V at the start", "", (low, 2.0 * max(1.0, float(share.max()))), log=True)
    panel = Panel(Axis("time", "s"), y_axis, marks, "V along motions")
    caption = "V along motions of the model from random states on one level set"
    caption += (
        " (the edge of N′): it only falls." if proved else ": it is no Lyapunov function here."
    )
    return Chart("lyapunov_decay", [panel], caption, columns=1, width=6.0)
