"""What is asked of an excitation design."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Request:
    """What an excitation is to be.

    Attributes
    ----------
    duration, sample_time : float
        s, of the excitation itself.
    lead_in : float
        s before it, in which the rig is brought to the operating point and settles.
    lowest, highest : float or None
        Band, Hz; None: from the model.
    operating_point : dict of str to float, or None
        Angles, rad, or a rotor's speed, rad/s; those not named: half-way from rest to level.
    reversals : bool
        Whether the rotors are to change their direction: then the commands are about zero.
    amplitude : dict of str to float
        Of an input, in its unit; those not named are searched.
    bounds : dict of str to float
        Largest size of an angle, rad; those not named: a share of the stops.
    share : float
        Of the stops and of the inputs' limits that may be used.
    rigs : int
        Rigs drawn from the parameters' priors with which the ranges are predicted as well.
    seed : int
    """

    duration: float = 120.0
    sample_time: float = 0.02
    lead_in: float = 20.0
    lowest: float | None = None
    highest: float | None = None
    operating_point: Mapping[str, float] | None = None
    reversals: bool = False
    amplitude: Mapping[str, float] = field(default_factory=dict)
    bounds: Mapping[str, float] = field(default_factory=dict)
    share: float = 0.8
    rigs: int = 8
    seed: int = 0
