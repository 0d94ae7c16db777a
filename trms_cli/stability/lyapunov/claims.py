"""What is claimed of a function, and what became of each claim.

How a claim was checked is part of it:

form        true of the expressions as they stand (derived in the documentation, by sympy in tests)
identity    derived, and the two sides evaluated on this model's own equations at many states
intervals   proved over boxes in interval arithmetic
simulated   seen along motions of the model; no proof
failed      a counterexample is shown
open        neither proved nor refuted
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.counterexample import Rising
from trms_cli.stability.lyapunov.falling import definite
from trms_cli.stability.lyapunov.function import Candidate
from trms_cli.stability.lyapunov.search import Found

FloatArray = npt.NDArray[np.float64]
How = Literal["form", "identity", "intervals", "simulated", "failed", "open"]

#: States at which an identity is evaluated, and how far apart its sides may be, as a share of the
#: largest term in it.
_STATES = 500
_TOLERANCE = 1e-8
_PARTS = 64


@dataclass(frozen=True)
class Claim:
    """One statement."""

    name: str  #: Short, for programs: ``falls``
    statement: str
    how: How
    detail: str  #: Figures of the check

    @property
    def holds(self) -> bool:
        return self.how not in ("failed", "open")


def of_equilibrium(candidate: Candidate) -> Claim:
    """That there is one, between bounds."""
    width = float(candidate.rest.width.max())
    return Claim(
        "equilibrium",
        "There is an equilibrium within the bounds, and V and V̇ are zero there",
        "intervals",
        f"change of sign of each balance; bounds no wider than {width:.1g} rad/s or rad",
    )


def of_derivation(candidate: Candidate, seed: int) -> Claim:
    """V̇ along the model's equations against −zᵀQz."""
    residual = identity_residual(candidate, seed)
    return Claim(
        "derivation",
        "V̇ = −zᵀQz along the model's own equations",
        "identity" if residual <= _TOLERANCE else "failed",
        f"largest difference at {_STATES} random states: {residual:.1g} of the largest term",
    )


def identity_residual(candidate: Candidate, seed: int, states: int = _STATES) -> float:
    """Largest difference between the two sides, as a share of the largest term of either."""
    energy, k, y = candidate.energy, candidate.energy.k, candidate.centre
    random = np.random.default_rng(seed)
    sizes = np.repeat([1.0, 60.0, 0.7], k)
    places = y + sizes * random.normal(size=(states, 3 * k))
    rates = candidate.derivative(candidate.states(places))
    weights, worst = candidate.weights.array(), 0.0
    for place, rate in zip(places, rates, strict=True):
        z = np.array(energy.deviations(place, y)).ravel()
        matrix = np.array(energy.decay(place, energy.slopes_between(place, y), weights))
        terms = np.outer(z, z) * matrix
        worst = max(worst, abs(rate + terms.sum()) / max(float(np.abs(terms).max()), 1e-12))
    return worst


def of_positive(found: Found) -> Claim:
    """V > 0 in the well but at the equilibrium."""
    candidate, boxes = found.candidate, sum(p.examined for p in found.wells.proofs)
    heavy = _inertia_is_positive(candidate, found)
    held = _hold_is_positive(candidate, found)
    parts = [f"wells rise up to the saddles ({boxes} boxes)" if boxes else "wells rise (springs)"]
    parts.append("M ≻ 0, s' > 0")
    if candidate.weights.strict:
        parts.append("K − ME ≻ 0")
    good = found.wells.rise and heavy and held
    return Claim(
        "positive",
        "V > 0 in the well, but for the equilibrium",
        "intervals" if good else "open",
        "a sum of terms none of which is negative: " + ", ".join(parts)
        if good
        else "not proved: the wells do not rise all over, or a weight is too large",
    )


def _pitches(candidate: Candidate, found: Found) -> Interval:
    """Ranges of the pitch that cover the well, (n, 3k) boxes with all else zero."""
    energy = candidate.energy
    boxes = np.zeros((_PARTS, 3 * energy.k))
    lower, upper = boxes, boxes.copy()
    if "v" in energy.axes:
        i, j = energy.axes.index("v"), energy.index("alpha", "v")
        edges = np.linspace(found.wells.ends.lower[i], found.wells.ends.upper[i], _PARTS + 1)
        lower[:, j], upper[:, j] = edges[:-1], edges[1:]
    return Interval(lower, upper)


def _inertia_is_positive(candidate: Candidate, found: Found) -> bool:
    return bool(definite(candidate.inertias(_pitches(candidate, found)))[0].all())


def _hold_is_positive(candidate: Candidate, found: Found) -> bool:
    """K/ε − M ≻ 0, so that ½ α̃ᵀE(K − ME)α̃ >= 0."""
    if not candidate.weights.strict:
        return True
    energy, w = candidate.energy, candidate.weights
    inertia = candidate.inertias(_pitches(candidate, found))
    cross = {"h": w.cross_h, "v": w.cross_v}
    hold = np.diag([energy.c[f"k_o{a}"] / cross[a] for a in energy.axes])
    matrix = Interval.point(np.broadcast_to(hold, inertia.lower.shape)) - inertia
    return bool(definite(matrix)[0].all())


def of_global_falling(candidate: Candidate) -> Claim | None:
    """With one axis: c (4 k_o) > (lever ψ_max)², so that V̇ <= 0 at all states."""
    energy, w = candidate.energy, candidate.weights
    if energy.k != 1 or w.strict:
        return None
    (a,) = energy.axes
    bound = energy.rotors[a].bound
    if not math.isfinite(bound):
        return None
    c = energy.c
    spent = (c["l_t" if a == "h" else "l_m"] * bound) ** 2
    held = 4.0 * c[f"k_o{a}"] * (w.rotor_h if a == "h" else w.rotor_v)
    return Claim(
        "falls_everywhere",
        "V̇ <= 0 at all states: the square is complete, (l ψ_max)² < 4 k_o c",
        "form" if spent < held else "failed",
        f"{spent:.4g} < {held:.4g}, with ψ < ψ_max = max k_f J/k_t = {bound:.4g} N s²/rad",
    )


def of_falling(found: Found, level: float, rising: Rising | None) -> Claim:
    """V̇ < 0 on the set, but where z = 0."""
    where = "z = 0" if not found.candidate.weights.strict else "the equilibrium"
    statement = f"V̇ < 0 on {{V < {level:.4g} J}} in the well, but at {where}"
    if level > 0.0:
        return Claim(
            "falls",
            statement,
            "intervals",
            f"Q ≻ 0, boxes that cover it: {found.falling.examined}",
        )
    if rising is not None:
        return Claim(
            "falls",
            "V̇ <= 0 about the equilibrium",
            "failed",
            f"V̇ = {rising.derivative:.3g} W at a state with V = {rising.value:.3g} J",
        )
    if found.wells.depth <= 0.0:
        return Claim(
            "falls",
            "V̇ < 0 on a level set in the well",
            "open",
            "the barrier is lower than its bounds are wide: no level below it is known",
        )
    return Claim("falls", "V̇ <= 0 about the equilibrium", "open", "Q is not definite at rest")


def of_invariance(found: Found, inner: float, bounded_by: str) -> Claim:
    """That N′ is compact and kept."""
    box = found.candidate.extent(inner, found.wells.ends)
    finite = bool(np.all(np.isfinite(box.lower) & np.isfinite(box.upper)))
    return Claim(
        "kept",
        f"N′ = {{V <= {inner:.4g} J}} is compact and no motion leaves it",
        "intervals" if finite else "open",
        f"a level set below {bounded_by}, in a box of finite size; V does not rise on it",
    )


def of_attraction(found: Found, dry: tuple[str, ...]) -> Claim:
    """What the invariance principle concludes."""
    if dry:
        return Claim(
            "attracts",
            "Motions from N′ come to rest where dry friction holds the axis",
            "form",
            "V̇ = 0 only at Ω = 0, ω = ω̄; there an axis stays while |U'(α)| <= F_c: rests are a "
            "set about the equilibrium",
        )
    strict = found.candidate.weights.strict
    if strict:
        detail = "V̇ < 0 on N′ but at the equilibrium: Lyapunov's theorem, without LaSalle"
    else:
        detail = (
            "V̇ = 0 only at Ω = 0, ω = ω̄; to stay there takes U'(α) = 0, which in the well is the "
            "equilibrium alone: LaSalle"
        )
    return Claim(
        "attracts",
        "Every motion from N′ goes to the equilibrium",
        "intervals" if found.wells.rise else "open",
        detail,
    )
