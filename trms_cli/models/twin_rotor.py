"""What every model of the TRMS has in common: signals, axes, motors and thrusts.

How the beam moves under the thrusts is what the models differ in
(:mod:`trms_cli.models.newtonian`, :mod:`trms_cli.models.lagrangian`). ``_h`` is yaw and the tail
rotor, ``_v`` pitch and the main rotor.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.interface_circuit import InterfaceCircuit, interface_of
from trms_cli.models.model import FloatArray, Model, RigAxis, Signal, names
from trms_cli.models.motor import Motor
from trms_cli.models.parameters import ParameterFile, ParameterSet, parameter_file

Freedom = Literal["both", "vertical", "horizontal"]
Currents = Literal["quasi_static", "dynamic"]

STATES = {
    "i_h": Signal("i_h", "A", "armature current of the tail motor"),
    "omega_h": Signal("omega_h", "rad/s", "speed of the tail rotor"),
    "S_h": Signal("S_h", "rad/s", "yaw angular momentum over inertia"),
    "alpha_h": Signal("alpha_h", "rad", "yaw angle"),
    "i_v": Signal("i_v", "A", "armature current of the main motor"),
    "omega_v": Signal("omega_v", "rad/s", "speed of the main rotor"),
    "S_v": Signal("S_v", "rad/s", "pitch angular momentum over inertia"),
    "alpha_v": Signal("alpha_v", "rad", "pitch angle, 0 with the beam level"),
}
INPUTS = {
    "u_v": Signal("u_v", "V", "command of the main rotor"),
    "u_h": Signal("u_h", "V", "command of the tail rotor"),
}
DISTURBANCES = {
    "pitch_moment": Signal("pitch_moment", "N*m", "torque on pitch"),
    "yaw_moment": Signal("yaw_moment", "N*m", "torque on yaw"),
    "main_motor": Signal("main_motor", "N*m", "torque on the main rotor"),
    "tail_motor": Signal("tail_motor", "N*m", "torque on the tail rotor"),
}
_OF_AXIS = {
    "horizontal": (("i_h", "omega_h", "S_h", "alpha_h"), ("yaw_moment", "tail_motor")),
    "vertical": (("i_v", "omega_v", "S_v", "alpha_v"), ("pitch_moment", "main_motor")),
}


@dataclass(frozen=True)
class BeamPoint:
    """Where the equations of the beam are evaluated; what is locked is zero."""

    c: Mapping[str, ca.SX]  #: Parameters
    moves_h: bool  #: Whether yaw and pitch are free
    moves_v: bool  #: Whether yaw and pitch are free
    S_h: ca.SX  #: rad/s, rad
    alpha_h: ca.SX  #: rad/s, rad
    S_v: ca.SX  #: rad/s, rad
    alpha_v: ca.SX  #: rad/s, rad
    omega_h: ca.SX  #: rad/s, rad
    omega_v: ca.SX  #: rad/s, rad
    thrust_h: ca.SX  #: N
    thrust_v: ca.SX  #: N
    yaw_moment: ca.SX  #: Disturbances, N m
    pitch_moment: ca.SX  #: Disturbances, N m


@dataclass(frozen=True)
class BeamMotion:
    """What the equations of the beam give there."""

    rate_h: ca.SX  #: dα/dt, rad/s
    rate_v: ca.SX  #: dα/dt, rad/s
    momentum_rate_h: ca.SX  #: dS/dt, rad/s²
    momentum_rate_v: ca.SX  #: dS/dt, rad/s²
    inertia_h: ca.SX  #: kg m²
    inertia_v: ca.SX  #: kg m²
    gravity: ca.SX  #: Moment of gravity on pitch, N m


class TwinRotor(Model):
    """A TRMS with the beam's equations left open.

    Parameters
    ----------
    freedom : {"both", "vertical", "horizontal"}
        Axes that move.
    currents : {"quasi_static", "dynamic"}
        Whether the armature currents are states (poles near −9300 1/s: stiff).
    parameter_set : str
        A built-in set or the path of a parameter file.
    parameters : mapping
        Other values for some parameters, in SI.
    main_interface, tail_interface : str or None
        Path of a measured curve in place of the gain; see
        :mod:`trms_cli.models.interface_circuit`.
    main_voltage_limit, tail_voltage_limit : float or None
        Where the interface saturates, V.

    Raises
    ------
    ConfigurationError
        For an unknown set or parameter.
    ModelError
        For a curve that cannot be used, or a set of another kind of model.
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
        moves = [axis for axis in _OF_AXIS if freedom in ("both", axis)]
        states = [name for axis in moves for name in _OF_AXIS[axis][0]]
        if currents == "quasi_static":
            states = [name for name in states if not name.startswith("i_")]
        disturbances = [name for axis in moves for name in _OF_AXIS[axis][1]]
        limits = {"u_v": 2.5, "u_h": 2.5, "alpha_v": np.inf, "alpha_h": np.inf} | content.limits

        def of_axes(vertical: Any, horizontal: Any) -> tuple[Any, ...]:
            return (vertical,) * ("vertical" in moves) + (horizontal,) * ("horizontal" in moves)

        self.name = self.OPTION
        self._circuits: dict[str, InterfaceCircuit] = {
            "v": interface_of("v", main_interface, main_voltage_limit, "model.main_"),
            "h": interface_of("h", tail_interface, tail_voltage_limit, "model.tail_"),
        }
        self.parameters = _used(content, self._circuits, self.UNUSED).replaced(parameters or {})
        self.states = tuple(STATES[name] for name in states)
        self.inputs = of_axes(INPUTS["u_v"], INPUTS["u_h"])
        measured = ("alpha_v", "alpha_h", "omega_v", "omega_h")
        self.outputs = tuple(STATES[name] for name in measured if name in states)
        self.disturbances = tuple(DISTURBANCES[n] for n in DISTURBANCES if n in disturbances)
        self.controlled = of_axes("alpha_v", "alpha_h")
        self.input_limits = {name: limits[name] for name in of_axes("u_v", "u_h")}
        self.stops = {name: limits[name] for name in of_axes("alpha_v", "alpha_h")}
        self.axes = dict(
            of_axes(
                ("pitch", RigAxis("alpha_v", "pitch_moment")),
                ("yaw", RigAxis("alpha_h", "yaw_moment")),
            )
        )
        self.rotors = dict(of_axes(("main", "u_v"), ("tail", "u_h")))
        self.stiff = currents == "dynamic"

    @abstractmethod
    def beam(self, at: BeamPoint) -> BeamMotion:
        """The equations of the beam."""

    @abstractmethod
    def pitch_at_rest(self) -> float:
        """Angle at which free pitch rests without thrust, rad."""

    def rest(self) -> FloatArray:
        x = np.zeros(self.n_x)
        if "alpha_v" in self.state_names:
            x[self.state_index("alpha_v")] = self.pitch_at_rest()
        return x

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return self._equations(x, u, p, w)[0]

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return ca.vertcat(*(x[self.state_index(name)] for name in names(self.outputs)))

    def quantities(self, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
        return self._equations(x, u, p, ca.SX.zeros(self.n_w))[1]

    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        """All rows for the axes that move, and the quantities met on the way."""
        c = {name: p[i] for i, name in enumerate(self.parameters.names)}
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


def _used(
    content: ParameterFile, circuits: Mapping[str, InterfaceCircuit], unused: tuple[str, ...]
) -> ParameterSet:
    """The parameters of a set that these equations have."""
    known = content.parameter_set()
    given = {f"k_u{axis}" for axis, circuit in circuits.items() if not circuit.parameter_names}
    if "kphi" not in known or "m_cb" not in known:
        raise ModelError(
            f"the set {content.name!r} belongs to model {content.model!r}, whose equations are "
            "others",
            where="model.parameter_set",
            remedy=f"choose bench, rahideh or tastemirov, or model={content.model}",
        )
    return ParameterSet((p for p in known if p.name not in {*unused, *given}), known.name)
