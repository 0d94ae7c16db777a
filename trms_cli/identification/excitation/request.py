"""What is asked of an excitation design."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Request:
    """What an excitation is to be."""

    duration: float = 120.0  #: s, of the excitation itself
    sample_time: float = 0.02  #: s, of the excitation itself
    #: s before it, in which the rig is brought to the operating point and settles
    lead_in: float = 20.0
    lowest: float | None = None  #: Band, Hz
    highest: float | None = None  #: None: from the model
    #: Angles, rad, or a rotor's speed, rad/s; those not named: half-way from rest to level
    operating_point: Mapping[str, float] | None = None
    #: Whether the rotors are to change their direction: then the commands are about zero
    reversals: bool = False
    #: Of an input, in its unit; those not named are searched
    amplitude: Mapping[str, float] = field(default_factory=dict)
    #: Largest size of an angle, rad; those not named: a share of the stops
    bounds: Mapping[str, float] = field(default_factory=dict)
    share: float = 0.8  #: Of the stops and of the inputs' limits that may be used
    #: Rigs drawn from the parameters' priors with which the ranges are predicted as well
    rigs: int = 8
    seed: int = 0
