"""A certificate in words, tables and data."""

from __future__ import annotations

import math
from typing import Any

from trms_cli.core.arrays import ComplexArray
from trms_cli.core.findings import Column, Judged, Judgement, Table, json_data, rounded, table
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.candidate import EnergyCandidate
from trms_cli.stability.lyapunov.certificate import EnergyRig, LyapunovCertificate, StabilityClaim

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
        inertia = float(candidate.inertias(_at_rest(candidate)).upper[0, 0, 0])
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


def _at_rest(candidate: EnergyCandidate) -> Interval:
    return Interval.point(candidate.centre[None])


def lead(
    certificate: LyapunovCertificate,
    rig: EnergyRig,
    point: OperatingPoint,
    growth: float,
    further: tuple[StabilityClaim, ...] = (),
) -> tuple[str, ...]:
    """The answer; what is not shown comes first, and nothing is said that rests on it."""
    found, words = certificate.search, point.words(rig.model)
    kind = "strict function" if found.candidate.weights.strict else "energy"
    if certificate.outer <= 0.0:
        if certificate.rising is None:
            sentences = [
                f"At {words} it is not proved that the {kind} is a Lyapunov function on any set."
            ]
        else:
            sentences = [
                f"At {words} the {kind} is no Lyapunov function: about the equilibrium V rises."
            ]
            sentences.append(
                f"At a state with V = {certificate.rising.value:.3g} J, V̇ = "
                f"{certificate.rising.derivative:.3g} W."
            )
        if growth > 0.0:
            sentences.append(
                f"No other function can be one either: the linearisation is unstable (growth "
                f"{growth:.3g} 1/s)."
            )
        else:
            sentences.append(
                f"The linearisation is stable (decay {-growth:.3g} 1/s), so that other functions "
                "exist: study=region_of_attraction finds them by computation."
            )
        return tuple(sentences)
    sentences = []
    unshown = [claim for claim in (*certificate.claims, *further) if not claim.holds]
    if unshown:
        which = "; ".join(f"“{claim.statement}” ({claim.how})" for claim in unshown)
        return (
            f"At {words} it is not shown that the {kind} is a Lyapunov function on the sets below. "
            f"What does not hold, or is left open: {which}.",
            f"The levels that were found, {_level(certificate)}, count only if that is settled.",
        )
    if certificate.everywhere:
        sentences.append(
            f"At {words} the equilibrium is globally asymptotically stable: the {kind} falls at "
            "all states of the equations, and N is the whole space."
        )
    else:
        sentences.append(
            f"At {words} the {kind} is a Lyapunov function on N, the part of {{V < "
            f"{certificate.outer:.4g} J}} about the equilibrium; what ends N is "
            f"{_end_of_outer(certificate)}."
        )
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
    found = certificate.search
    if certificate.outer >= found.wells.depth * (1.0 - 1e-6):
        assert found.wells.saddles is not None
        low, high = (found.candidate.well_at("v", end) for end in found.wells.ends_of_pitch)
        which = found.wells.saddles[0 if low < high else 1]
        return f"the saddle at alpha_v = {which:.4g} rad"
    return "the decay of V, proved up to there"


def claims_table(certificate: LyapunovCertificate, further: tuple[StabilityClaim, ...]) -> Table:
    """Every claim and how it was checked."""
    return table(
        (*certificate.claims, *further),
        [
            Column("claim", "statement"),
            Column("checked by", lambda claim: Judged(claim.how, _JUDGED.get(claim.how, "good"))),
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


def rising_table(certificate: LyapunovCertificate) -> Table | None:
    """The counterexample."""
    rising = certificate.rising
    if rising is None:
        return None
    names = certificate.search.candidate.energy.names()
    rows = [
        *((_head(name), rounded(value, 6)) for name, value in zip(names, rising.y, strict=True)),
        ("V [J]", rounded(rising.value)),
        ("V̇ [W]", rounded(rising.derivative)),
    ]
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
    found, rising = certificate.search, certificate.rising
    names, depth = found.candidate.energy.names(), found.wells.depth
    return json_data(
        {
            "function": "strict" if found.candidate.weights.strict else "energy",
            "holds": certificate.holds and all(claim.holds for claim in further),
            "operating_point": {"x": point.x, "u": point.u},
            "weights": found.candidate.weights,
            "formula": formula(found.candidate),
            "N": {"everywhere": certificate.everywhere, "level": certificate.outer},
            "N_prime": {
                "level": certificate.inner if certificate.inner > 0.0 else None,
                "bounded_by": certificate.bounded_by if certificate.outer > 0.0 else None,
                "extent": extent(certificate) if certificate.inner > 0.0 else None,
            },
            "well": {"depth": depth if depth > 0.0 else None, "saddles": found.wells.saddles},
            "boxes": found.decay_level.examined,
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
