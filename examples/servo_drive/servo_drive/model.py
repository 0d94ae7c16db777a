"""A linear servo drive: a motor's current pushes a carriage along its rail.

``M v̇ = K i − F_v v + d`` with the drive's force constant ``K`` (N/A) and the disturbance ``d``. Dry
friction of the rail is left out on purpose: it is what a diagnosis of the rig has to name.
"""

from collections.abc import Mapping

import casadi as ca

from trms_cli.models.model import Model, RigAxis, Signal
from trms_cli.models.parameters import Parameter, ParameterSet

_PARAMETERS = ParameterSet(
    [
        Parameter("M", 12.0, "kg", prior_sd=0.05, lower=1.0, description="moving mass"),
        Parameter("K", 40.0, "N/A", prior_sd=0.02, lower=1.0, description="force constant"),
        Parameter("F_v", 60.0, "N*s/m", prior_sd=0.3, lower=0.0, description="viscous friction"),
    ]
)


class ServoDrive(Model):
    """Position and velocity of the carriage, driven by the motor's current."""

    def __init__(self, *, parameters: Mapping[str, float] | None = None) -> None:
        self.name = "servo_drive"
        self.parameters = _PARAMETERS.replaced(parameters or {})
        self.states = (
            Signal("position", "m", "position of the carriage"),
            Signal("velocity", "m/s", "its velocity"),
        )
        self.inputs = (Signal("current", "A", "current of the motor"),)
        self.outputs = (self.states[0],)
        self.disturbances = (Signal("carriage_force", "N", "force on the carriage"),)
        self.controlled = ("position",)
        self.input_limits = {"current": 5.0}
        self.stops = {"position": 0.4}
        self.axes = {"carriage": RigAxis("position", "carriage_force")}

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        velocity = x[1]
        M, K, F_v = ca.vertsplit(p)
        return ca.vertcat(velocity, (K * u - F_v * velocity + w) / M)
