"""What the models of the TRMS have in common: signals, motors and thrusts.

How the beam moves under the thrusts is what they differ in (:mod:`trms_cli.models.newtonian`,
:mod:`trms_cli.models.lagrangian`).
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import casadi as ca

from trms_cli.models.beam_rig import INPUTS, STATES, BeamRig
from trms_cli.models.model import names
from trms_cli.models.motor import Motor
from trms_cli.models.parameters import ParameterFile, ParameterSet, parameter_file
from trms_cli.models.static_curve import InterfaceCircuit, interface_of

Freedom = Literal["both", "vertical", "horizontal"]
Currents = Literal["quasi_static", "dynamic"]

#: What the parameters of a TRMS are; a set says it where it means something else.
MEANINGS: Mapping[str, str] = {
    "m_t": "mass of the tail part of the beam",
    "m_tr": "mass of the tail motor with its rotor",
    "m_ts": "mass of the tail shield",
    "m_m": "mass of the main part of the beam",
    "m_mr": "mass of the main motor with its rotor",
    "m_ms": "mass of the main shield",
    "m_b": "mass of the counterweight's beam",
    "m_cb": "mass of the counterweight",
    "l_t": "length of the tail part of the beam",
    "l_m": "length of the main part of the beam",
    "l_b": "length of the counterweight's beam",
    "l_cb": "distance of the counterweight from the joint",
    "r_ms": "radius of the main shield",
    "r_ts": "radius of the tail shield",
    "R": "resistance of the armatures",
    "L": "inductance of the armatures",
    "kphi": "torque constant of the motors",
    "k_uh": "gain of the tail motor's interface",
    "k_uv": "gain of the main motor's interface",
    "J_tr": "inertia of the tail rotor",
    "B_tr": "viscous friction of the tail rotor",
    "k_thp": "drag of the tail rotor, turning forward",
    "k_thn": "drag of the tail rotor, turning backward",
    "J_mr": "inertia of the main rotor",
    "B_mr": "viscous friction of the main rotor",
    "k_tvp": "drag of the main rotor, turning forward",
    "k_tvn": "drag of the main rotor, turning backward",
    "k_fvp": "thrust of the main rotor, turning forward",
    "k_fvn": "thrust of the main rotor, turning backward",
    "k_fhp": "thrust of the tail rotor, turning forward",
    "k_fhn": "thrust of the tail rotor, turning backward",
    "k_g": "gyroscopic moment by the main rotor's thrust and the yaw rate",
    "k_m": "momentum that the main rotor hands to yaw",
    "k_t": "momentum that the tail rotor hands to pitch",
    "k_oh": "viscous friction of yaw",
    "k_ov": "viscous friction of pitch",
    "k_chp": "stiffness of the cable, yaw positive",
    "k_chn": "stiffness of the cable, yaw negative",
    "g": "gravity",
}
_MOVING = {"both": ("pitch", "yaw"), "vertical": ("pitch",), "horizontal": ("yaw",)}


@dataclass(frozen=True)
class BeamPoint:
    """Where the equations of the beam are evaluated; what is locked is zero."""

    c: Mapping[str, ca.SX]  #: Parameters
    moves_h: bool  #: Whether yaw is free
    moves_v: bool  #: Whether pitch is free
    S_h: ca.SX  #: rad/s
    alpha_h: ca.SX  #: rad
    S_v: ca.SX  #: rad/s
    alpha_v: ca.SX  #: rad
    omega_h: ca.SX  #: rad/s
    omega_v: ca.SX  #: rad/s
    thrust_h: ca.SX  #: N
    thrust_v: ca.SX  #: N
    yaw_moment: ca.SX  #: The disturbance of yaw, N m
    pitch_moment: ca.SX  #: The disturbance of pitch, N m


@dataclass(frozen=True)
class BeamMotion:
    """What the equations of the beam give there."""

    rate_h: ca.SX  #: dα_h/dt, rad/s
    rate_v: ca.SX  #: dα_v/dt, rad/s
    momentum_rate_h: ca.SX  #: dS_h/dt, rad/s²
    momentum_rate_v: ca.SX  #: dS_v/dt, rad/s²
    inertia_h: ca.SX  #: Of yaw, kg m²
    inertia_v: ca.SX  #: Of pitch, kg m²
    gravity: ca.SX  #: Moment of gravity on pitch, N m


class TwinRotor(BeamRig):
    """A TRMS with the beam's equations left open.

    Raises ConfigurationError for an unknown set or parameter. Raises ModelError for a curve that
    cannot be used, or a set of another kind of model.

    The arguments are explained in the models that are made of it, such as
    :class:`trms_cli.models.newtonian.Newtonian`.
    """

    OPTION: ClassVar[str]  #: of ``configs/model``, which a fitted file names
    #: Parameters of the set that this form of the equations does not have.
    UNUSED: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        *,
        freedom: Freedom = "both",
        currents: Currents = "quasi_static",
        parameter_set: str = "bench",
        parameters: Mapping[str, float] | None = None,
        main_interface: str | None = None,
        tail_interface: str | None = None,
        main_voltage_limit: float | None = None,
        tail_voltage_limit: float | None = None,
    ) -> None:
        content = parameter_file(parameter_set)
        self._frame(content, 2.5, _MOVING[freedom])
        ends = tuple(angle[-2:] for angle in self.controlled)
        states = [name for name in STATES if name.endswith(ends)]
        if currents == "quasi_static":
            states = [name for name in states if not name.startswith("i_")]
        self.name = self.OPTION
        self._circuits: dict[str, InterfaceCircuit] = {
            "v": interface_of("v", main_interface, main_voltage_limit, "model.main_"),
            "h": interface_of("h", tail_interface, tail_voltage_limit, "model.tail_"),
        }
        self.parameters = _parameter_set(content, self._circuits, self.UNUSED).replaced(
            parameters or {}
        )
        self.states = tuple(STATES[name] for name in states)
        self.inputs = tuple(INPUTS[rotor.input] for rotor in self.rotors.values())
        measured = ("alpha_v", "alpha_h", "omega_v", "omega_h")
        self.outputs = tuple(STATES[name] for name in measured if name in states)
        self.stiff = currents == "dynamic"

    @abstractmethod
    def beam(self, at: BeamPoint) -> BeamMotion:
        """The equations of the beam."""

    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        c = self.parameters_by_name(p)
        state = {name: x[i] for i, name in enumerate(self.state_names)}
        command = {name: u[i] for i, name in enumerate(names(self.inputs))}
        torque = {name: w[i] for i, name in enumerate(names(self.disturbances))}
        zero = ca.SX(0)
        omega = {axis: state.get(f"omega_{axis}", zero) for axis in "hv"}
        volt = {
            axis: self._circuits[axis].voltage(command.get(f"u_{axis}", zero), c) for axis in "hv"
        }
        motor = {axis: Motor(axis) for axis in "hv"}
        current = {
            axis: state.get(f"i_{axis}", motor[axis].steady_current(volt[axis], omega[axis], c))
            for axis in "hv"
        }
        thrust = {axis: motor[axis].thrust(omega[axis], c) for axis in "hv"}
        beam = self.beam(
            BeamPoint(
                c=c,
                moves_h="alpha_h" in state,
                moves_v="alpha_v" in state,
                S_h=state.get("S_h", zero),
                alpha_h=state.get("alpha_h", zero),
                S_v=state.get("S_v", zero),
                alpha_v=state.get("alpha_v", zero),
                omega_h=omega["h"],
                omega_v=omega["v"],
                thrust_h=thrust["h"],
                thrust_v=thrust["v"],
                yaw_moment=torque.get("yaw_moment", zero),
                pitch_moment=torque.get("pitch_moment", zero),
            )
        )
        rows = {
            "S_h": beam.momentum_rate_h,
            "alpha_h": beam.rate_h,
            "S_v": beam.momentum_rate_v,
            "alpha_v": beam.rate_v,
        }
        for axis, disturbance in (("h", "tail_motor"), ("v", "main_motor")):
            rows[f"i_{axis}"] = motor[axis].current_rate(volt[axis], current[axis], omega[axis], c)
            rows[f"omega_{axis}"] = motor[axis].acceleration(
                current[axis], omega[axis], torque.get(disturbance, zero), c
            )
        quantities = {
            "thrust_main": thrust["v"],
            "thrust_tail": thrust["h"],
            "drag_torque_main": motor["v"].drag(omega["v"], c),
            "drag_torque_tail": motor["h"].drag(omega["h"], c),
            "arm_main": c["l_m"],
            "arm_tail": c["l_t"] * ca.cos(state.get("alpha_v", zero)),
            "current_main": current["v"],
            "current_tail": current["h"],
            "inertia_pitch": beam.inertia_v,
            "inertia_yaw": beam.inertia_h,
            "gravity_moment": beam.gravity,
        }
        return ca.vertcat(*(rows[name] for name in self.state_names)), quantities


def _parameter_set(
    content: ParameterFile, circuits: Mapping[str, InterfaceCircuit], unused: tuple[str, ...]
) -> ParameterSet:
    """The parameters of a set that these equations have."""
    content.require(["kphi", "m_cb"], "bench, rahideh or tastemirov")
    file_parameters = content.parameter_set()
    circuit_names = {
        f"k_u{axis}" for axis, circuit in circuits.items() if not circuit.parameter_names
    }
    used = (p for p in file_parameters if p.name not in {*unused, *circuit_names})
    return ParameterSet(
        (replace(p, description=p.description or MEANINGS.get(p.name, "")) for p in used),
        file_parameters.name,
    )
