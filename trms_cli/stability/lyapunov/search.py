"""Weights of V, and the largest level set on which it is proved to fall.

Along rays from the equilibrium it is sampled where Q stops being definite; the weights whose set
{V < c} has the largest volume are taken, and the level is then proved (:mod:`.falling`). Sampling
only proposes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.energy import Energy, Weights
from trms_cli.stability.lyapunov.falling import Falling, definite, falling
from trms_cli.stability.lyapunov.function import Candidate
from trms_cli.stability.lyapunov.well import Wells, stop_level, wells_of

FloatArray = npt.NDArray[np.float64]

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
class Found:
    """A function and how far it reaches."""

    candidate: Candidate
    wells: Wells
    falling: Falling
    asked: float  #: The level up to which decay was to be proved, J

    @property
    def level(self) -> float:
        """Proved: V falls on {V < level}, within the well; J."""
        return min(self.falling.level, self.asked)


def searched(energy: Energy, x: FloatArray, strict: bool, budget: int) -> Found:
    """The function with the largest proved set.

    Parameters
    ----------
    energy : Energy
    x : (n_x,)
        The equilibrium.
    strict : bool
        Whether the cross terms are wanted.
    budget : int
        Boxes for the proof.
    """
    first = Candidate(energy, x, rotor_weights(energy, 1.05))
    wells = wells_of(first)
    ceiling = wells.depth
    if ceiling <= 0.0:  # the barrier is not bounded away from zero: nothing can be proved
        return Found(first, wells, Falling(0.0, math.inf, None, 0), 0.0)
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
        return Found(best, wells, Falling(0.0, 0.0, best.centre, 0), ceiling)
    asked = ceiling if best_level >= ceiling else _SHARE * best_level
    for patient in (False, False, True):
        box = best.extent(asked, wells.ends)
        found = falling(best.matrices, best.values, box, asked, budget, patient=patient)
        if found.fails >= asked:
            break
        if not patient:
            asked = _SHARE * found.fails
    return Found(best, wells, found, asked)


def rotor_weights(energy: Energy, margin: float, yaw: float = 1.0) -> Weights:
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
    return Weights(**found, yaw=yaw)


def _choices(
    energy: Energy, strict: bool, yaws: tuple[float, ...] = (0.5, 1.0, 2.0)
) -> Iterator[Weights]:
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


def curvature(candidate: Candidate) -> FloatArray:
    """∇²V at the equilibrium, (3k, 3k)."""
    energy = candidate.energy
    v = energy.value(energy.y, energy.rest, energy.weights)
    hessian = ca.hessian(v, energy.y)[0]
    function = ca.Function("H", [energy.y, energy.rest, energy.weights], [ca.densify(hessian)])
    return np.array(function(candidate.centre, candidate.centre, candidate.weights.array()))


def rays(candidate: Candidate, count: int, seed: int = 0) -> FloatArray:
    """Directions from the equilibrium, evenly over the level sets of V near it: (count, 3k)."""
    n = 3 * candidate.energy.k
    unit = np.random.default_rng(seed).normal(size=(count, n))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(curvature(candidate))
    return np.asarray(unit / np.sqrt(np.maximum(values, 1e-12)) @ vectors.T)


def _sampled(candidate: Candidate, wells: Wells, ceiling: float) -> float:
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
        angles = places[:, 2 * candidate.energy.k :]
        within = ((angles > wells.ends.lower) & (angles < wells.ends.upper)).all(axis=1)
        within &= levels < lowest
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


def _volume(candidate: Candidate, level: float) -> float:
    """Logarithm of the volume of the ellipsoid that {V < level} is near the equilibrium."""
    sign, determinant = np.linalg.slogdet(curvature(candidate))
    if sign <= 0 or level <= 0.0:
        return -1e300
    n = 3 * candidate.energy.k
    return 0.5 * (n * math.log(level) - float(determinant))
