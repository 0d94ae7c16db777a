"""Where the potential wells end: the saddle beside a stable equilibrium, and proofs that they rise.

The well of pitch is that of a pendulum with a constant moment. With G sin(α_v + δ) the moment of
gravity, its other equilibria are

    α_s = ±π − 2δ − ᾱ_v     (mod 2π)

and the lower of the two barriers beside ᾱ_v is how deep it is. The well of yaw is a spring and has
no end.

Up to which level of V its decay is proved: branch and bound in the order of V.

A box of states is done with once Q is positive definite all over it. Always the boxes that reach
deepest are taken next; the deepest one left bounds from below the level up to which V falls

    c* = inf { V(y) : Q(y) not positive definite },

and the lowest middle of a box at which Q is found indefinite bounds it from above.

Weights of V, and the largest level set on which it is proved to fall.

Along rays from the equilibrium it is sampled where Q stops being definite; the weights whose set
{V < c} has the largest volume are taken, and the level is then proved. Sampling
only proposes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.stability.intervals.branch_and_bound import (
    BoxSearch,
    NegativityProof,
    branch_and_bound,
    halved,
    prove_negative,
)
from trms_cli.stability.intervals.interval import Interval, definite
from trms_cli.stability.lyapunov.candidate import EnergyCandidate
from trms_cli.stability.lyapunov.energy import Energy, EnergyWeights

#: rad. About the equilibrium the slope of U' is looked at, U' itself beyond; and how far before the
#: saddle the well is taken to end.
_NEAR = 0.02
_BEFORE = 1e-4


@dataclass(frozen=True)
class Wells:
    """The wells of all axes that move."""

    ends: Interval  #: (k,), rad: between them every U rises away from the equilibrium
    #: J, a lower bound of V wherever an angle is at one of its ends; infinite without a saddle
    depth: float
    saddles: tuple[float, float] | None  #: α_v below and above, rad
    proofs: tuple[NegativityProof, ...]  #: That they rise

    def hold(self, places: FloatArray) -> BoolArray:
        """Which states of motion (m, 3k) have all their angles between the ends, (m,)."""
        angles = places[:, -len(self.ends.lower) :]
        within = (angles > self.ends.lower) & (angles < self.ends.upper)
        return np.asarray(within.all(axis=1))

    @property
    def rise(self) -> bool:
        return all(proof.holds for proof in self.proofs)


def wells_of(candidate: EnergyCandidate) -> Wells:
    """The wells about a candidate's equilibrium, with proofs."""
    energy = candidate.energy
    lower, upper = np.full(energy.k, -np.inf), np.full(energy.k, np.inf)
    depth, saddles, proofs = math.inf, None, []
    for i, a in enumerate(energy.axes):
        rest = float(candidate.centre[energy.index("alpha", a)])
        if a == "v":
            tilt = math.atan2(-energy.gravity[0], -energy.gravity[1])
            saddles = (-math.pi - 2 * tilt - rest, math.pi - 2 * tilt - rest)
            lower[i], upper[i] = saddles[0] + _BEFORE, saddles[1] - _BEFORE
            proofs += _rises(candidate, a, rest, float(lower[i]), float(upper[i]))
            heights = [candidate.well_at(a, end) for end in (lower[i], upper[i])]
            depth = min(heights)
    return Wells(Interval(lower, upper), depth, saddles, tuple(proofs))


def _rises(
    candidate: EnergyCandidate, axis: str, rest: float, lower: float, upper: float
) -> list[NegativityProof]:
    """U'' > 0 near the equilibrium, and beyond it U' has the sign of α − ᾱ up to the ends."""
    energy, angle, still = candidate.energy, ca.SX.sym("angle"), ca.SX.sym("still")
    j = energy.index("alpha", axis)
    moment = energy.restoring(axis, angle) - energy.restoring(axis, still)
    above = ca.Function("above", [angle, still], [-moment])
    below = ca.Function("below", [angle, still], [moment])
    curved = ca.Function("curved", [angle], [-energy.stiffness(axis, angle)])
    near = min(_NEAR, 0.25 * (upper - rest), 0.25 * (rest - lower))
    # The equilibrium is known between bounds: the worse end of them for each side.
    high, low = candidate.rest.upper[j], candidate.rest.lower[j]
    found = [prove_negative(curved, [rest - near], [rest + near])]
    if upper - _BEFORE > rest + near:
        found.append(prove_negative(above, [rest + near], [upper], given=[high]))
    if lower + _BEFORE < rest - near:
        found.append(prove_negative(below, [lower], [rest - near], given=[low]))
    return found


def stop_level(candidate: EnergyCandidate, ends: Interval | None = None) -> tuple[float, str]:
    """The lowest level of V at which an angle may reach a mechanical stop, J, and that stop.

    Infinite for a model without stops; zero or less where the equilibrium is at a stop or beyond
    it. The wells must rise up to there. A stop beyond their ends (k,) is not in the well, and
    bounds nothing.
    """
    lowest, name = math.inf, ""
    for i, a in enumerate(candidate.energy.axes):
        stop = candidate.energy.model.stops[f"alpha_{a}"]
        rest = float(candidate.centre[candidate.energy.index("alpha", a)])
        for end in (-stop, stop):
            if not math.isfinite(end):
                continue
            if ends is not None and not float(ends.lower[i]) <= end <= float(ends.upper[i]):
                continue
            level = candidate.well_at(a, end) if abs(rest) < stop else 0.0
            if level < lowest:
                lowest, name = level, f"alpha_{a} = {end:.4g} rad"
    return lowest, name


#: Bounds (m, n, n) over boxes (m, n_y), or (m,) bounds of V.
Bounds = Callable[[Interval], Interval]

#: The search ends when the bounds of c* are this close to each other.
_CLOSE = 0.01


@dataclass(frozen=True)
class DecayLevel:
    """How far decay reaches."""

    #: Q is proved positive definite where V < level, within the first box; infinite if all over
    level: float
    fails: float  #: V at the lowest state found where Q is not; infinite if there is none
    point: FloatArray | None  #: (n_y,) array or None; that state
    examined: int  #: Boxes bounded


def decay_level(
    matrices: Bounds,
    values: Bounds,
    box: Interval,
    most: float,
    budget: int = 20_000,
    *,
    patient: bool = True,
) -> DecayLevel:
    """Bounds of the level up to which Q is positive definite, in a box (n_y,) of states.

    States with V above ``most`` are not asked about. A search that is not ``patient`` ends at the
    first state found where Q is not definite.
    """
    size = np.where(box.width > 0.0, box.width, 1.0)
    fails, point = np.inf, None

    def visit(boxes: Interval, _: FloatArray) -> tuple[Interval, FloatArray, int]:
        nonlocal fails, point
        done, middles = definite(matrices(boxes))
        bad = ~middles & ~done
        if bad.any():
            # The middle matrix of the bounds sorts out where to look; the point itself decides.
            places = Interval.point(boxes.middle[bad])
            truly = ~definite(matrices(places))[0]
            levels = np.where(truly, values(places).upper, np.inf)
            if levels.min() < fails:
                best = int(np.argmin(levels))
                fails, point = float(levels[best]), places.lower[best]
        open_ = boxes[~done]
        if not len(open_.lower) or (not patient and fails < most):
            return open_[:0], np.zeros(0), len(done)
        halves = halved(open_, _directions(matrices, open_, size))
        deep = values(halves).lower
        # Boxes above the lowest failure say nothing more about c*.
        keep = deep < min(fails, most)
        return halves[keep], deep[keep], len(done)

    def enough(lowest: float) -> bool:
        return (not patient and fails < most) or lowest >= (1.0 - _CLOSE) * min(fails, most)

    whole = Interval(box.lower[None].copy(), box.upper[None].copy())
    first = BoxSearch(whole, np.atleast_1d(values(whole).lower), 0)
    search = branch_and_bound(first, visit, budget=budget, enough=enough)
    level = min(search.lowest, fails) if patient or fails >= most else 0.0
    return DecayLevel(level, fails, point, search.examined)


def _directions(matrices: Bounds, boxes: Interval, size: FloatArray) -> npt.NDArray[np.intp]:
    """The direction that makes most of the width of Q, box by box; the longest where none does.

    Found by collapsing one direction at a time to its middle.
    """
    count, n = boxes.lower.shape
    middle = boxes.middle
    scale = np.sqrt(
        np.maximum(np.einsum("mii->mi", matrices(Interval.point(middle)).upper), 1e-300)
    )
    weight = 1.0 / (scale[:, :, None] * scale[:, None, :])
    whole = _spread(matrices(boxes), weight)
    gain = np.zeros((count, n))
    for j in range(n):
        lower, upper = boxes.lower.copy(), boxes.upper.copy()
        lower[:, j] = upper[:, j] = middle[:, j]
        gain[:, j] = whole - _spread(matrices(Interval(lower, upper)), weight)
    relative = boxes.width / size
    gain = np.where(relative > 1e-9, gain, -np.inf)
    useless = gain.max(axis=1) <= 1e-9 * np.abs(whole)
    return np.where(useless, relative.argmax(axis=1), gain.argmax(axis=1))


def _spread(matrix: Interval, weight: FloatArray) -> FloatArray:
    width = np.nan_to_num(matrix.width, nan=1e300, posinf=1e300)
    return np.asarray((width * weight).sum(axis=(1, 2)))


#: Rays, and places on each.
_RAYS = 100
_PLACES = 12
#: Share of the sampled level that is to be proved first.
_SHARE = 0.9
#: J, looked at where a well has no end and no stop.
_DEEPEST = 1.0
#: γ that are tried where none near 1 does.
_HEAVY = (8.0, 32.0, 128.0)


@dataclass(frozen=True)
class LevelSearchResult:
    """A function and how far it reaches."""

    candidate: EnergyCandidate
    wells: Wells
    decay_level: DecayLevel
    asked: float  #: The level up to which decay was to be proved, J

    @property
    def level(self) -> float:
        """Proved: V falls on {V < level}, within the well; J."""
        return min(self.decay_level.level, self.asked)


def search_levels(energy: Energy, x: FloatArray, strict: bool, budget: int) -> LevelSearchResult:
    """The function with the largest proved set, with cross terms if it is to be strict."""
    first = EnergyCandidate(energy, x, rotor_weights(energy, 1.05))
    wells = wells_of(first)
    ceiling = wells.depth
    if ceiling <= 0.0:  # the barrier is not bounded away from zero: nothing can be proved
        return LevelSearchResult(first, wells, DecayLevel(0.0, math.inf, None, 0), 0.0)
    if not math.isfinite(ceiling):
        stop, _ = stop_level(first)
        ceiling = stop if math.isfinite(stop) and stop > 0.0 else _DEEPEST
    best, best_volume, best_level = first, -math.inf, 0.0
    for choices in (_choices(energy, strict), _choices(energy, strict, _HEAVY)):
        for weights in choices:
            candidate = first.weighted(weights)
            if not candidate.falls_at_rest():
                continue
            level = _sampled(candidate, wells, ceiling)
            volume = _volume(candidate, level)
            if volume > best_volume:
                best, best_volume, best_level = candidate, volume, level
        if best_volume > -math.inf:
            break
    if best_volume == -math.inf:
        return LevelSearchResult(best, wells, DecayLevel(0.0, 0.0, best.centre, 0), ceiling)
    asked = ceiling if best_level >= ceiling else _SHARE * best_level
    for patient in (False, False, True):
        box = best.extent(asked, wells.ends)
        found = decay_level(best.matrices, best.values, box, asked, budget, patient=patient)
        if found.fails >= asked:
            break
        if not patient:
            asked = _SHARE * found.fails
    return LevelSearchResult(best, wells, found, asked)


def rotor_weights(energy: Energy, margin: float, yaw: float = 1.0) -> EnergyWeights:
    """c of each rotor by completing the square against friction, times a margin.

    ``c = margin Σ γ (lever ψ_max)² / 4 k_o``: with one axis and a margin above one, V̇ ≤ 0 at all
    speeds, since ψ never exceeds ψ_max = max k_f J/k_t.
    """
    gamma = {"h": yaw, "v": 1.0}
    found = {}
    for a in energy.axes:
        rotor, c = energy.rotors[a], energy.c
        bound = rotor.bound
        if not math.isfinite(bound):
            ratio = ca.Function("ratio", [rotor.omega], [rotor.ratio])
            bound = float(ratio(400.0))
        lever, other = ("l_t", "v") if a == "h" else ("l_m", "h")
        direct = gamma[a] * (c[lever] * bound) ** 2 / (4 * c[f"k_o{a}"])
        reaction = gamma[other] * c["k_t" if a == "h" else "k_m"] ** 2 / (4 * c[f"k_o{other}"])
        found[f"rotor_{a}"] = margin * (direct + (reaction if energy.k == 2 else 0.0))
    return EnergyWeights(**found, yaw=yaw)


def _choices(
    energy: Energy, strict: bool, yaws: tuple[float, ...] = (0.5, 1.0, 2.0)
) -> Iterator[EnergyWeights]:
    # Each choice is tried in turn; heavy yaw only pays where the cross moment k_g is large.
    margins = (1.05,) if energy.k == 1 and not strict else (1.5, 3.0, 6.0)
    if not energy.weighted:
        yaws = (1.0,)
    crosses = (0.05, 0.15, 0.4) if strict else (0.0,)
    fastest = {}
    for a in "hv":
        if a in energy.axes:
            inertia = ca.DM(ca.substitute(energy.mass(ca.SX(0)), energy.y, 0 * energy.y))
            i = energy.axes.index(a)
            fastest[a] = energy.c[f"k_o{a}"] / float(inertia[i, i])
    for margin, yaw, cross in itertools.product(margins, yaws, crosses):
        yield replace(
            rotor_weights(energy, margin, yaw),
            cross_h=cross * fastest.get("h", 0.0),
            cross_v=cross * fastest.get("v", 0.0),
        )


def curvature(candidate: EnergyCandidate) -> FloatArray:
    """∇²V at the equilibrium, (3k, 3k)."""
    energy = candidate.energy
    v = energy.value(energy.y, energy.rest, energy.weights)
    hessian = ca.hessian(v, energy.y)[0]
    function = ca.Function("H", [energy.y, energy.rest, energy.weights], [ca.densify(hessian)])
    return np.array(function(candidate.centre, candidate.centre, candidate.weights.array()))


def rays(candidate: EnergyCandidate, count: int, seed: int = 0) -> FloatArray:
    """Directions from the equilibrium, evenly over the level sets of V near it: (count, 3k)."""
    n = 3 * candidate.energy.k
    unit = np.random.default_rng(seed).normal(size=(count, n))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(curvature(candidate))
    return np.asarray(unit / np.sqrt(np.maximum(values, 1e-12)) @ vectors.T)


def _sampled(candidate: EnergyCandidate, wells: Wells, ceiling: float) -> float:
    """About the level up to which Q is definite, J."""
    directions = rays(candidate, _RAYS)
    # Single terms are where V is lowest for what they do to Q.
    y, n = candidate.centre, directions.shape[1]
    lowest = ceiling
    for _ in range(3):
        reach = math.sqrt(2.0 * lowest) * 1.3
        share = np.linspace(1.0 / _PLACES, 1.0, _PLACES)
        places = (y + reach * directions[:, None, :] * share[:, None]).reshape(-1, n)
        levels = candidate.value(places)
        within = wells.hold(places) & (levels < lowest)
        if not within.any():
            return lowest
        bad = ~definite(candidate.matrices(Interval.point(places[within])))[0]
        if not bad.any():
            return lowest
        lowest = float(levels[within][bad].min())
        worst = places[within][bad][np.argmin(levels[within][bad])]
        # Once more about the worst direction.
        near = (worst - y) / reach
        spread = np.random.default_rng(1).normal(size=directions.shape) * 0.25
        directions = near * (1.0 + spread)
    return lowest


def _volume(candidate: EnergyCandidate, level: float) -> float:
    """Logarithm of the volume of the ellipsoid that {V < level} is near the equilibrium."""
    sign, determinant = np.linalg.slogdet(curvature(candidate))
    if sign <= 0 or level <= 0.0:
        return -1e300
    n = 3 * candidate.energy.k
    return 0.5 * (n * math.log(level) - float(determinant))
