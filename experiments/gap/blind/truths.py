"""What the blind rigs can have beyond the nominal model: sizes, where a diagnosis should find it.

Names and sizes are those of :class:`.rig.Rigs`. A reference size is one that is typical of
bench rigs; how it grows to a severity is measured (:mod:`.severity`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

AXES, ROTORS = ("pitch", "yaw"), ("main", "tail")

#: Effects that act at one place in nearly one way: no recording of the usual kind parts them.
GROUPS = (
    *((f"{rotor}_input_delay", f"{rotor}_actuator_lag") for rotor in ROTORS),
    *((f"{axis}_coulomb_friction", f"{axis}_stribeck_friction") for axis in AXES),
    *((f"{rotor}_dead_zone", f"{rotor}_rotor_friction") for rotor in ROTORS),
)

#: Places that enter the same equation: a force found at one stands for one at another.
SAME_EQUATION = (
    ("main_actuator", "main_motor"),
    ("tail_actuator", "tail_motor"),
    ("main_thrust", "pitch_moment"),
    ("tail_thrust", "yaw_moment"),
)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """An effect of the rigs."""

    sizes: Mapping[str, float]  #: A typical rig's, by short name, in the rig's units
    grows: tuple[str, ...]  #: Sizes that grow with the severity, all by one factor; the others stay
    locations: tuple[str, ...]  #: Where it acts; a diagnosis that names any of them is right
    acts: tuple[str, ...] = ()  #: Sizes that stay and make an effect of their own nevertheless
    either_sign: bool = False  #: Whether the growing sizes may be negative as well
    #: Other values of the sizes that stay, of which development sets know nothing
    variants: tuple[Mapping[str, float], ...] = field(default=())
    outside: bool = False  #: Not in the library: no diagnosis can name it

    def sized(self, factor: float, **others: float) -> dict[str, float]:
        """The sizes at a factor of the reference."""
        sizes = {**self.sizes, **others}
        return {
            name: value * factor if name in self.grows else value for name, value in sizes.items()
        }


def _of_axis(axis: str) -> dict[str, Truth]:
    moment, sensor = (f"{axis}_moment",), (f"{axis}_sensor",)
    return {
        f"{axis}_coulomb_friction": Truth(
            sizes={"torque": 0.005}, grows=("torque",), locations=moment
        ),
        f"{axis}_stribeck_friction": Truth(
            sizes={"torque": 0.005, "excess": 0.5, "velocity": 0.03},
            grows=("torque",),
            locations=moment,
            variants=({"excess": 0.9, "velocity": 0.08}, {"excess": 0.3, "velocity": 0.015}),
        ),
        f"{axis}_quadratic_damping": Truth(
            sizes={"coefficient": 0.01}, grows=("coefficient",), locations=moment
        ),
        f"{axis}_sensor_bias": Truth(
            sizes={"bias": 0.02}, grows=("bias",), locations=sensor, either_sign=True
        ),
        f"{axis}_sensor_delay": Truth(sizes={"delay": 0.05}, grows=("delay",), locations=sensor),
        f"{axis}_quantisation": Truth(
            sizes={"quantum": 0.0061359}, grows=("quantum",), locations=sensor
        ),
        f"{axis}_flexible_mode": Truth(
            sizes={"share": 1.0, "frequency": 3.0, "damping": 0.02},
            grows=("share",),
            locations=sensor,
            variants=({"frequency": 4.5}, {"frequency": 2.2, "damping": 0.04}),
        ),
        f"{axis}_disturbance": Truth(
            sizes={"torque": 0.005, "time": 1.0},
            grows=("torque",),
            locations=moment,
            variants=({"time": 0.4}, {"time": 2.5}),
        ),
    }


def _of_rotor(rotor: str, reference: float) -> dict[str, Truth]:
    actuator, thrust = (f"{rotor}_actuator",), (f"{rotor}_thrust",)
    lag = {"time_constant": 0.04}
    return {
        f"{rotor}_input_delay": Truth(sizes={"delay": 0.04}, grows=("delay",), locations=actuator),
        f"{rotor}_actuator_lag": Truth(sizes=lag, grows=tuple(lag), locations=actuator),
        f"{rotor}_dead_zone": Truth(sizes={"width": 0.1}, grows=("width",), locations=actuator),
        f"{rotor}_supply_derating": Truth(
            sizes={"depth": 0.1, "time_constant": 30.0},
            grows=("depth",),
            locations=actuator,
            variants=({"time_constant": 15.0}, {"time_constant": 60.0}),
        ),
        f"{rotor}_rotor_friction": Truth(
            sizes={"torque": 0.001}, grows=("torque",), locations=(f"{rotor}_motor",)
        ),
        f"{rotor}_thrust_curve": Truth(
            sizes={"exponent": 0.25, "reverse": 0.0, "reference": reference},
            grows=("exponent",),
            locations=thrust,
            either_sign=True,
            variants=({"reference": 0.8 * reference},),
        ),
        f"{rotor}_inflow": Truth(
            sizes={"coefficient": 30.0}, grows=("coefficient",), locations=thrust
        ),
        f"{rotor}_tacho_lag": Truth(sizes=lag, grows=tuple(lag), locations=(f"{rotor}_tacho",)),
    }


LIBRARY: Mapping[str, Truth] = {
    **_of_axis("pitch"),
    **_of_axis("yaw"),
    **_of_rotor("main", 200.0),
    **_of_rotor("tail", 300.0),
    "yaw_cable_stiffness": Truth(
        sizes={"stiffness": 0.006, "cubic": 0.005, "neutral": 0.1},
        grows=("stiffness", "cubic"),
        locations=("yaw_moment",),
        variants=({"cubic": 0.0, "neutral": 0.3}, {"neutral": -0.2}),
    ),
    "yaw_cable_hysteresis": Truth(
        sizes={"torque": 0.005, "width": 0.15},
        grows=("torque",),
        locations=("yaw_moment",),
        variants=({"width": 0.28}, {"width": 0.08}),
    ),
    "pitch_mass_imbalance": Truth(
        sizes={"mass": 0.01, "arm": 0.25, "height": 0.0},
        grows=("mass",),
        locations=("pitch_moment",),
        variants=({"arm": -0.2, "height": -0.1}, {"arm": 0.1, "height": -0.25}),
    ),
    "main_reaction_on_yaw": Truth(
        sizes={"drag": 1.5e-7, "inertia": 0.0},
        grows=("drag",),
        locations=("yaw_moment",),
        acts=("inertia",),
        variants=({"inertia": 1e-4},),
    ),
    "tail_reaction_on_pitch": Truth(
        sizes={"drag": 4e-8, "inertia": 0.0},
        grows=("drag",),
        locations=("pitch_moment",),
        acts=("inertia",),
        variants=({"inertia": 1.5e-5},),
    ),
    "gyroscopic_coupling": Truth(
        sizes={"inertia": 4e-5, "lean": 0.0},
        grows=("inertia",),
        locations=("pitch_moment", "yaw_moment"),
        variants=({"lean": 0.15},),
    ),
    "ground_effect": Truth(
        sizes={"gain": 0.3, "scale": 0.1, "level_height": 0.2},
        grows=("gain",),
        locations=("main_thrust",),
        variants=({"scale": 0.15}, {"level_height": 0.27}),
    ),
}


def _unknown(location: str, **sizes: float) -> Truth:
    """An effect outside the library; its first size grows."""
    return Truth(sizes=sizes, grows=tuple(sizes)[:1], locations=(location,), outside=True)


OUTSIDE: Mapping[str, Truth] = {
    "pitch_encoder_eccentricity": _unknown("pitch_sensor", amplitude=0.02),
    "yaw_encoder_eccentricity": _unknown("yaw_sensor", amplitude=0.02),
    "main_thrust_loss_with_pitch": _unknown("main_thrust", share=0.3),
    "pitch_cogging": _unknown("pitch_moment", torque=0.01),
    "yaw_cogging": _unknown("yaw_moment", torque=0.004),
    "yaw_cable_catch": _unknown("yaw_moment", stiffness=0.03, angle=0.3),
    "shared_supply_sag": _unknown("tail_actuator", depth=0.3),
    "yaw_one_sided_friction": _unknown("yaw_moment", torque=0.002),
    "pitch_one_way_damping": _unknown("pitch_moment", coefficient=0.025),
    "yaw_one_way_damping": _unknown("yaw_moment", coefficient=0.004),
    "pitch_soft_stop": _unknown("pitch_moment", stiffness=0.1),
    "pitch_detent": _unknown("pitch_moment", torque=0.01),
    "tilted_base": _unknown("pitch_moment", torque=0.01),
    "yaw_downwash_damping": _unknown("yaw_moment", coefficient=6e-5),
    "yaw_ageing_stiffness": _unknown("yaw_moment", stiffness=0.003),
    "main_thrust_hysteresis": _unknown("main_thrust", share=0.06),
    "tail_thrust_hysteresis": _unknown("tail_thrust", share=0.1),
    "tail_wake_on_main": _unknown("main_thrust", share=0.1),
    "main_drive_backlash": _unknown("main_actuator", width=0.03),
    "tail_drive_backlash": _unknown("tail_actuator", width=0.06),
    "main_early_limit": _unknown("main_actuator", cut=0.7),
    "tail_early_limit": _unknown("tail_actuator", cut=2.0),
    "pitch_encoder_backlash": _unknown("pitch_sensor", width=0.01),
    "yaw_encoder_backlash": _unknown("yaw_sensor", width=0.01),
    "pitch_encoder_hangs": _unknown("pitch_sensor", time=0.2),
    "pitch_sensor_drift": _unknown("pitch_sensor", bias=0.03),
    "pitch_reads_yaw": _unknown("pitch_sensor", share=0.05),
    "yaw_reads_pitch": _unknown("yaw_sensor", share=0.03),
    "pitch_beam_bending": _unknown("pitch_sensor", compliance=0.06),
}
#: Those that no set but the final one has.
FINAL_SET_ONLY = (
    "yaw_encoder_eccentricity",
    "yaw_cogging",
    "yaw_cable_catch",
    "shared_supply_sag",
    "pitch_detent",
    "yaw_one_way_damping",
    "main_thrust_hysteresis",
    "tail_early_limit",
    "yaw_encoder_backlash",
    "pitch_reads_yaw",
    "pitch_encoder_hangs",
    "main_drive_backlash",
)

#: Effects that can begin while a rig is watched: something is hung on, rubs, catches, warms, slips.
SUDDEN = (
    "pitch_mass_imbalance",
    "pitch_coulomb_friction",
    "yaw_coulomb_friction",
    "pitch_stribeck_friction",
    "yaw_stribeck_friction",
    "yaw_cable_stiffness",
    "yaw_cable_hysteresis",
    "pitch_sensor_bias",
    "yaw_sensor_bias",
    "main_supply_derating",
    "tail_supply_derating",
    "yaw_quadratic_damping",
    "tail_rotor_friction",
    "main_thrust_curve",
    "tail_thrust_curve",
    "main_reaction_on_yaw",
)

TRUTHS: Mapping[str, Truth] = {**LIBRARY, **OUTSIDE}

#: Effects that the poor excitation does not show: one rotor hardly changes its speed, the other
#: never turns round, the axes hardly move.
UNSEEN = (
    "main_input_delay",
    "tail_actuator_lag",
    "tail_dead_zone",
    "tail_rotor_friction",
    "main_tacho_lag",
    "gyroscopic_coupling",
    "yaw_quadratic_damping",
    "tail_inflow",
)


def group_of(effect: str) -> tuple[str, ...]:
    """The confusion group of an effect, itself alone where it is in none."""
    return next((group for group in GROUPS if effect in group), (effect,))


def same_equation(location: str) -> tuple[str, ...]:
    """The places that enter the same equation, the location among them."""
    return next((places for places in SAME_EQUATION if location in places), (location,))
