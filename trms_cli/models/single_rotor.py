"""A motor with its propeller alone on a bench: one command, one speed.

The equations are those of :mod:`trms_cli.models.motor` behind the interface circuit. On request a
load cell measures the thrust beside the tachometer.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import casadi as ca

from trms_cli.core.errors import ModelError
from trms_cli.models.beam_rig import DISTURBANCES, INPUTS, ROTORS, STATES
from trms_cli.models.model import Model, Signal
from trms_cli.models.motor import Motor
from trms_cli.models.parameters import ParameterSet, parameter_file
from trms_cli.models.static_curve import interface_of
from trms_cli.models.twin_rotor import Currents

_AXIS_OF_ROTOR = {"main": "v", "tail": "h"}


class SingleRotor(Model):
    """One of the rig's rotors alone.

    Raises ConfigurationError for an unknown set or parameter. Raises ModelError for a curve that
    cannot be used, or a set of another kind of model.

    Parameters
    ----------
    rotor : {"main", "tail"}
    currents : {"quasi_static", "dynamic"}
        Whether the armature current is a state (a pole near −9300 1/s: stiff).
    load_cell : bool
        Whether the thrust is measured.
    parameter_set : str
        A built-in set (``bench``, ``tastemirov``) or the path of a parameter file.
    parameters : mapping
        Other values for some parameters, in SI.
    interface : str or None
        Path of the measured curve of the interface (CSV ``u[V],v[V]``) in place of its gain.
    voltage_limit : float or None
        Where the interface saturates, V.
    """

    bench_sizes = True

    def __init__(
        self,
        *,
        rotor: Literal["main", "tail"],
        currents: Currents = "quasi_static",
        load_cell: bool = False,
        parameter_set: str = "bench",
        parameters: Mapping[str, float] | None = None,
        interface: str | None = None,
        voltage_limit: float | None = None,
    ) -> None:
        content = parameter_file(parameter_set)
        axis = _AXIS_OF_ROTOR[rotor]
        self._motor = Motor(axis)
        # The keys of the configuration are `model.interface` and `model.voltage_limit`.
        self._circuit = interface_of(axis, interface, voltage_limit, "model.")
        required_names = (*self._circuit.parameter_names, *self._motor.parameter_names)
        missing = [name for name in required_names if name not in content.parameters]
        if missing:
            raise ModelError(
                f"the set {content.name!r} of model {content.model!r} has no {missing[0]!r}",
                where="model.parameter_set",
                remedy="choose bench, rahideh or tastemirov, whose motors are electrical",
            )
        file_parameters = content.parameter_set()
        self.parameters = ParameterSet(
            (file_parameters[name] for name in required_names), file_parameters.name
        ).replaced(parameters or {})
        self.name = f"propeller_{rotor}" if load_cell else f"motor_{rotor}"
        speed = STATES[f"omega_{axis}"]
        current = (STATES[f"i_{axis}"],) if currents == "dynamic" else ()
        self.states = (*current, speed)
        self.inputs = (INPUTS[f"u_{axis}"],)
        thrust = Signal(f"thrust_{axis}", "N", f"thrust of the {rotor} rotor, by a load cell")
        self.outputs = (speed, thrust) if load_cell else (speed,)
        self.disturbances = (DISTURBANCES[f"{rotor}_motor"],)
        self.controlled = (speed.name,)
        name = self.inputs[0].name
        self.input_limits = {name: content.limits.get(name, 2.5)}
        self.stops: Mapping[str, float] = {}
        self.axes = {}
        self.rotors = {rotor: replace(ROTORS[rotor], axis="")}
        self.stiff = currents == "dynamic"

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        c, omega = self.parameters_by_name(p), x[-1]
        volt = self._circuit.voltage(u[0], c)
        if self.n_x == 1:
            current = self._motor.steady_current(volt, omega, c)
            return self._motor.acceleration(current, omega, w[0], c)
        return ca.vertcat(
            self._motor.current_rate(volt, x[0], omega, c),
            self._motor.acceleration(x[0], omega, w[0], c),
        )

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        thrust = self._motor.thrust(x[-1], self.parameters_by_name(p))
        return ca.vertcat(x[-1], thrust) if len(self.outputs) > 1 else x[-1]

    def quantities(self, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
        c, rotor = self.parameters_by_name(p), next(iter(self.rotors))
        volt = self._circuit.voltage(u[0], c)
        current = x[0] if self.n_x == 2 else self._motor.steady_current(volt, x[-1], c)
        return {
            f"thrust_{rotor}": self._motor.thrust(x[-1], c),
            f"drag_torque_{rotor}": self._motor.drag(x[-1], c),
            f"current_{rotor}": current,
        }
