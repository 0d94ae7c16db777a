"""A mass on the beam that the model does not know: a shifted counterweight, a camera, a cable.

A point mass ``m`` that sits ``l`` along the beam towards the tail and ``h`` above it is at the
distance ``r(α) = l cos α + h sin α`` behind the yaw axis when the pitch is ``α``. With
``r′ = h cos α − l sin α`` (its height over the pitch axis) Lagrange's equations give::

    τ_pitch = m g r + m r r′ Ω_yaw² − m (l² + h²) dΩ_pitch/dt
    τ_yaw   = −2 m r r′ Ω_pitch Ω_yaw − m r² dΩ_yaw/dt

The accelerations are those with the mass in place: the effect asks the model beneath for its
accelerations without the mass and for the mobility of its axes, and solves the linear equations.
An axis that is locked drops out.
"""

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from msgspec import Meta

from trms_cli.core.ranges import NotNegative
from trms_cli.effects.effect import Effect, EffectContext, axis_of
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter

#: m/s², for a model that has no ``g`` among its parameters (CGPM 1901).
_STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True, kw_only=True)
class MassImbalance(Effect):
    """A point mass fixed to the beam."""

    mass: NotNegative  #: m, kg
    #: l, m: along the beam from the pitch axis, positive towards the tail (raises the nose)
    arm: Annotated[float, Meta(ge=-1, le=1)]
    #: h, m: above the beam; negative is below it, like the counterweight
    height: Annotated[float, Meta(ge=-1, le=1)] = 0.0

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            self.size("mass", "kg", (0.002, 0.02), "added mass m"),
            self.size("arm", "m", (-0.28, 0.28), "l, positive towards the tail"),
            self.size("height", "m", (-0.28, 0.05), "h, above the beam"),
        )

    def check(self, model: Model) -> None:
        axis_of(model, "pitch")

    def disturbance(self, at: EffectContext) -> ca.SX:
        mass, arm, height = (at.sizes[name] for name in ("mass", "arm", "height"))
        alpha, pitch_rate = at.angle("pitch"), at.rate("pitch")
        behind = arm * ca.cos(alpha) + height * ca.sin(alpha)
        above = height * ca.cos(alpha) - arm * ca.sin(alpha)
        parameters = at.model.parameters
        has_own = "g" in parameters
        gravity = at.p[parameters.names.index("g")] if has_own else _STANDARD_GRAVITY
        torques = [mass * gravity * behind]
        inertias = [mass * (arm**2 + height**2)]
        axes = ["pitch"]
        if "yaw" in at.model.axes:
            yaw_rate = at.rate("yaw")
            torques[0] += mass * behind * above * yaw_rate**2
            torques.append(-2 * mass * behind * above * pitch_rate * yaw_rate)
            inertias.append(mass * behind**2)
            axes.append("yaw")
        free, mobility = at.accelerations(*axes)
        inertia = ca.diag(ca.vertcat(*inertias))
        moments = ca.solve(
            ca.SX.eye(len(axes)) + inertia @ mobility, ca.vertcat(*torques) - inertia @ free
        )
        result = ca.SX.zeros(at.model.n_w)
        for k, axis in enumerate(axes):
            result += at.on(at.axis(axis).moment, moments[k])
        return result
