"""A cart on a rail that carries a pendulum, upright at angle zero, where it is unstable.

With cart mass ``M``, bob mass ``m`` at length ``l``, viscous frictions ``c`` and ``b``, force ``F``
on the cart and a torque on the joint, the Lagrangian equations are::

    (M + m) s̈ + m l cos θ θ̈ − m l sin θ θ̇² = F − c ṡ + d_cart
    m l cos θ s̈ + m l² θ̈ − m g l sin θ     = −b θ̇ + d_pendulum
"""

from collections.abc import Mapping

import casadi as ca

from trms_cli.models.model import Model, RigAxis, Signal
from trms_cli.models.parameters import Parameter, ParameterSet

_PARAMETERS = ParameterSet(
    [
        Parameter("M", 0.8, "kg", prior_sd=0.05, lower=0.05, description="mass of the cart"),
        Parameter("m", 0.15, "kg", prior_sd=0.05, lower=0.01, description="mass of the bob"),
        Parameter("l", 0.3, "m", prior_sd=0.03, lower=0.05, description="length to the bob"),
        Parameter("c", 2.0, "N*s/m", prior_sd=0.3, lower=0.0, description="friction of the cart"),
        Parameter(
            "b", 0.002, "N*m*s", prior_sd=0.5, lower=0.0, description="friction at the joint"
        ),
        Parameter("g", 9.81, "m/s^2", description="gravity"),
    ]
)


class CartPole(Model):
    """Cart and pendulum under a force on the cart."""

    def __init__(self, *, parameters: Mapping[str, float] | None = None) -> None:
        self.name = "cart_pole"
        self.parameters = _PARAMETERS.replaced(parameters or {})
        self.states = (
            Signal("position", "m", "position of the cart"),
            Signal("velocity", "m/s", "velocity of the cart"),
            Signal("angle", "rad", "angle of the pendulum, 0 upright"),
            Signal("angle_rate", "rad/s", "angular rate of the pendulum"),
        )
        self.inputs = (Signal("force", "N", "force on the cart"),)
        self.outputs = (self.states[0], self.states[2])
        self.disturbances = (
            Signal("cart_force", "N", "force on the cart that no command makes"),
            Signal("joint_torque", "N*m", "torque on the pendulum"),
        )
        self.controlled = ("position",)
        self.input_limits = {"force": 10.0}
        self.stops = {"position": 0.5}
        self.axes = {
            "cart": RigAxis("position", "cart_force"),
            "joint": RigAxis("angle", "joint_torque"),
        }

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        _, velocity, angle, rate = ca.vertsplit(x)
        M, m, l, c, b, g = ca.vertsplit(p)
        sine, coupling = ca.sin(angle), m * l * ca.cos(angle)
        force = u - c * velocity + w[0] + m * l * sine * rate**2
        torque = m * g * l * sine - b * rate + w[1]
        determinant = (M + m) * m * l**2 - coupling**2
        return ca.vertcat(
            velocity,
            (m * l**2 * force - coupling * torque) / determinant,
            rate,
            ((M + m) * torque - coupling * force) / determinant,
        )
