"""Where the potential wells end: the saddle beside a stable equilibrium, and proofs that they rise.

The well of pitch is that of a pendulum with a constant moment. With G sin(α_v + δ) the moment of
gravity, its other equilibria are

    α_s = ±π − 2δ − ᾱ_v     (mod 2π)

and the lower of the two barriers beside ᾱ_v is how deep it is. The well of yaw is a spring and has
no end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.lyapunov.function import Candidate
from trms_cli.stability.lyapunov.proof import Proof, prove_negative

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
    proofs: tuple[Proof, ...]  #: That they rise

    @property
    def ends_of_pitch(self) -> tuple[float, float]:
        """The last axis' ends; pitch is the last one where it moves."""
        return float(self.ends.lower[-1]), float(self.ends.upper[-1])

    @property
    def rise(self) -> bool:
        return all(proof.holds for proof in self.proofs)


def wells_of(candidate: Candidate) -> Wells:
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


def _rises(candidate: Candidate, axis: str, rest: float, lower: float, upper: float) -> list[Proof]:
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


def stop_level(candidate: Candidate, ends: Interval | None = None) -> tuple[float, str]:
    """The lowest level of V at which an angle may reach a mechanical stop, J, and that stop.

    Infinite for a model without stops; zero or less where the equilibrium is at a stop or beyond
    it. The wells must rise up to there.

    Parameters
    ----------
    candidate : Candidate
    ends : Interval, optional
        (k,), where the wells end: a stop beyond a crest is not in the well, and bounds nothing.
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
