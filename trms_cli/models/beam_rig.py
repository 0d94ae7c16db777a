"""What every model of a beam that pitches and yaws under two rotors has in common.

``_h`` is yaw and the tail rotor, ``_v`` pitch and the main rotor.
"""

from abc import abstractmethod
from collections.abc import Sequence

import casadi as ca
import numpy as np

from trms_cli.models.model import FloatArray, Model, RigAxis, RigRotor, Signal, names
from trms_cli.models.parameters import ParameterFile

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
#: Middle and half of the range of each variable of a rig of this kind: rad, rad/s, V.
USUAL_SPANS = {
    "pitch_angle": (0.0, 0.6),
    "yaw_angle": (0.0, 1.5),
    "pitch_rate": (0.0, 1.0),
    "yaw_rate": (0.0, 1.0),
    "main_speed": (0.0, 200.0),
    "tail_speed": (0.0, 300.0),
    "main_command": (0.0, 2.5),
    "tail_command": (0.0, 2.5),
}
AXES = {"pitch": RigAxis("alpha_v", "pitch_moment"), "yaw": RigAxis("alpha_h", "yaw_moment")}
#: The rotors of a beam, by name.
ROTORS = {
    "main": RigRotor("u_v", "omega_v", "main_motor", "pitch"),
    "tail": RigRotor("u_h", "omega_h", "tail_motor", "yaw"),
}


class BeamRig(Model):
    """A model whose equations are all in :meth:`_equations`."""

    bench_sizes = True

    def _frame(
        self, content: ParameterFile, input_limit: float, moving: Sequence[str] = ("pitch", "yaw")
    ) -> None:
        """Axes that move, their rotors and torques, what is controlled, limits and stops."""
        self.axes = {name: AXES[name] for name in moving}
        self.rotors = {name: r for name, r in ROTORS.items() if r.axis in moving}
        self.controlled = tuple(axis.angle for axis in self.axes.values())
        inputs = tuple(rotor.input for rotor in self.rotors.values())
        limits = dict.fromkeys(inputs, input_limit)
        limits |= dict.fromkeys(self.controlled, np.inf) | content.limits
        self.input_limits = {name: limits[name] for name in inputs}
        self.stops = {name: limits[name] for name in self.controlled}
        moments = (axis.moment for axis in self.axes.values())
        motors = (rotor.torque for rotor in self.rotors.values())
        self.disturbances = tuple(DISTURBANCES[name] for name in (*moments, *motors))

    def pitch_at_rest(self) -> float:
        """Angle at which free pitch rests without thrust, rad."""
        return 0.0

    def rest(self) -> FloatArray:
        x = np.zeros(self.n_x)
        if "alpha_v" in self.state_names:
            x[self.state_index("alpha_v")] = self.pitch_at_rest()
        return x

    @abstractmethod
    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        """The derivative of the states, and the quantities met on the way."""

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        return self._equations(x, u, p, w)[0]

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return ca.vertcat(*(x[self.state_index(name)] for name in names(self.outputs)))

    def quantities(self, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
        return self._equations(x, u, p, ca.SX.zeros(self.n_w))[1]
