"""A function, its sets N and N′, and all claims about them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.lyapunov import claims
from trms_cli.stability.lyapunov.claims import Claim
from trms_cli.stability.lyapunov.counterexample import Rising, fastest_rising, lowest_rising
from trms_cli.stability.lyapunov.energy import Energy
from trms_cli.stability.lyapunov.search import Found, searched
from trms_cli.stability.lyapunov.subject import Rig
from trms_cli.stability.lyapunov.well import stop_level
from trms_cli.stability.study import Tell

#: N′ is closed, and strictly inside N.
_INSIDE = 0.999
#: J: no deeper are states sought at which V rises.
_DEEPEST = 1.0


@dataclass(frozen=True)
class Certificate:
    """What is known of a function."""

    found: Found
    everywhere: bool  #: Whether N is the whole space
    outer: float  #: N is the part of {V < outer} about the equilibrium, J; 0: none is proved
    inner: float  #: N′ is the part of {V <= inner} about it, J; 0: there is none
    #: What ends N′: ``the saddle``, ``the stop alpha_v = 1.05 rad``, ``the decay of V``
    bounded_by: str
    rising: Rising | None  #: The state of lowest V at which V rises, of those found
    claims: tuple[Claim, ...]

    @property
    def holds(self) -> bool:
        return self.outer > 0.0 and all(claim.holds for claim in self.claims)


def wants_cross_terms(energy: Energy) -> bool:
    """Whether the plain energy cannot fall: yaw is held against the tail rotor's thrust.

    The thrust's moment on yaw turns with cos α_v and has no potential: V̇ has a term
    l_t F̄_h (cos α_v − cos ᾱ_v) Ω_h that nothing in −zᵀQz outweighs without the angles in z.
    """
    if energy.k != 2:
        return False
    command = energy.u[[s.name for s in energy.model.inputs].index("u_h")]
    return bool(abs(command) > 0.0)


def certified(
    rig: Rig, point: OperatingPoint, function: str, budget: int, seed: int, tell: Tell
) -> Certificate:
    """Choose a function, and check every claim about it.

    Parameters
    ----------
    rig : Rig
    point : OperatingPoint
        Of the model without effects.
    function : {"auto", "energy", "strict"}
    budget : int
        Boxes for the decay.
    seed : int
        Of the random states.

    Raises
    ------
    ConfigurationError
        Where dry friction and cross terms would meet.
    """
    energy = Energy(rig.model, point.u)
    strict = function == "strict" or (function == "auto" and wants_cross_terms(energy))
    if strict and rig.resisting:
        raise ConfigurationError(
            f"a strict function does not fall by friction alone, and {rig.resisting[0]} is given",
            where="study.function",
            remedy="study.function=energy, at yaw 0 for a model of two axes (study.at.alpha_v=0); "
            "or leave the effect out",
        )
    tell("weights of V")
    found = searched(energy, point.x, strict, budget)
    everywhere = claims.of_global_falling(found.candidate)
    whole = everywhere is not None and everywhere.holds and found.wells.saddles is None
    outer = found.level if not whole else math.inf
    inner, bounded_by = _inner(found, outer)
    tell("where V rises")
    rising = None
    ceiling = min(found.wells.depth, _DEEPEST)
    if found.level < ceiling and (everywhere is None or not everywhere.holds):
        seek = lowest_rising if found.level > 0.0 else fastest_rising
        rising = seek(found.candidate, found.wells, ceiling)
    tell("claims")
    made = [
        claims.of_equilibrium(found.candidate),
        claims.of_derivation(found.candidate, seed),
        claims.of_positive(found),
        *([everywhere] if everywhere is not None else []),
    ]
    proved = min(outer, found.level)
    made.append(claims.of_falling(found, proved, rising))
    if proved > 0.0 and inner > 0.0:
        made.append(claims.of_invariance(found, inner, bounded_by))
        made.append(claims.of_attraction(found, rig.dry))
    return Certificate(found, whole, outer, inner, bounded_by, rising, tuple(made))


def _inner(found: Found, outer: float) -> tuple[float, str]:
    """The level of N′, and what ends it."""
    stop, name = stop_level(found.candidate, found.wells.ends)
    proved = min(outer, found.level)
    if stop <= 0.0 or proved <= 0.0:
        return 0.0, f"the stop {name}" if stop <= 0.0 else "the decay of V"
    if stop <= proved * (1.0 + 1e-9):
        return _INSIDE * stop, f"the stop {name}"
    if proved >= found.wells.depth * (1.0 - 1e-9):
        return _INSIDE * proved, "the saddle"
    return _INSIDE * proved, "the decay of V"
