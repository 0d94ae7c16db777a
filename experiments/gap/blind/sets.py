"""The sets of the proof: how many rigs of each kind, which lie where, driven how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from experiments.gap.blind.truths import FINAL_SET_ONLY, LIBRARY, OUTSIDE

Kind = Literal[
    "null",
    "offset",
    "single",
    "pair",
    "triple",
    "outside",
    "unexcited",
    "matched",
    "onset",
    "against",
]


@dataclass(frozen=True, kw_only=True)
class SetPlan:
    """What a set is made of."""

    cases: int  #: Unless another number is asked for
    final: bool  #: Whether forms and effects occur that development sets do not have
    outside: tuple[str, ...]  #: Effects outside the library
    centre: tuple[float, float]  #: (low, high); ranges of the excitation's
    amplitude: tuple[float, float]  #: (low, high); ranges of the excitation's
    #: (low, high); factor by which sizes scatter about those of their severity
    stretch: tuple[float, float]
    #: By how many prior standard deviations the rigs with effects lie beside the nominal on
    #: average, in a direction that the seed decides; 0: about it
    shift: float
    shares: Mapping[Kind, float]  #: Of the kinds
    #: Laws that all rigs have and the nominal model has not, with what is drawn on top: of other
    #: powers, or that no power describes
    laws: Literal["nominal", "powers", "curves"] = "nominal"
    effects: tuple[str, ...] = tuple(LIBRARY)  #: Those that single effects are drawn from
    weak: bool = True  #: Whether single effects may be weak
    alike: bool = False  #: Whether all are driven in open loop and record all four outputs


#: What a student can name from a recording: each makes a gap of twice the floor or more, and has
#: one size that says how large it is.
NAMEABLE = (
    "pitch_coulomb_friction",
    "yaw_coulomb_friction",
    "pitch_mass_imbalance",
    "yaw_cable_stiffness",
    "yaw_sensor_delay",
    "main_reaction_on_yaw",
    "gyroscopic_coupling",
    "main_input_delay",
    "tail_input_delay",
    "main_thrust_curve",
    "tail_thrust_curve",
    "tail_dead_zone",
)

_DEVELOPMENT = SetPlan(
    cases=200,
    final=False,
    outside=tuple(effect for effect in OUTSIDE if effect not in FINAL_SET_ONLY),
    centre=(1.22, 1.28),
    amplitude=(0.74, 0.82),
    stretch=(0.9, 1.1),
    shift=0.0,
    shares={
        "null": 0.09,
        "offset": 0.09,
        "single": 0.255,
        "pair": 0.12,
        "triple": 0.06,
        "outside": 0.13,
        "unexcited": 0.03,
        "matched": 0.085,
        "onset": 0.07,
        "against": 0.07,
    },
)

#: In this order, which the seeds of the cases hang on.
SETS: Mapping[str, SetPlan] = {
    "small": replace(_DEVELOPMENT, cases=24),
    "development": _DEVELOPMENT,
    "final": replace(
        _DEVELOPMENT,
        cases=300,
        final=True,
        outside=tuple(OUTSIDE),
        centre=(1.12, 1.22),
        amplitude=(0.66, 0.8),
        stretch=(0.85, 1.25),
        shift=0.3,
        shares={
            "null": 20,
            "offset": 20,
            "single": 100,
            "pair": 40,
            "triple": 20,
            "outside": 40,
            "onset": 30,
            "against": 30,
        },
    ),
    "calibration": replace(
        _DEVELOPMENT,
        cases=1000,
        centre=(1.18, 1.28),
        amplitude=(0.7, 0.82),
        stretch=(0.6, 1.4),
        shares={
            "null": 0.10,
            "offset": 0.10,
            "single": 0.32,
            "pair": 0.13,
            "triple": 0.05,
            "outside": 0.16,
            "unexcited": 0.03,
            "matched": 0.02,
            "onset": 0.05,
            "against": 0.04,
        },
    ),
    "imperfect": replace(
        _DEVELOPMENT,
        cases=120,
        laws="powers",
        shares={"null": 20, "single": 50, "pair": 20, "outside": 10, "against": 20},
    ),
    "imperfect_curves": replace(
        _DEVELOPMENT,
        cases=60,
        laws="curves",
        shares={"null": 12, "single": 32, "pair": 12, "against": 4},
    ),
    "course": replace(
        _DEVELOPMENT,
        cases=30,
        shares={"single": 0.9, "offset": 0.1},
        effects=NAMEABLE,
        weak=False,
        alike=True,
    ),
}
