"""The loop closed by the LQR law in continuous time, with its integral and its saturation.

The sampled law (:mod:`trms_cli.controllers.lqr`) with a state that is known and a reference that
does not move reads, for short periods,

    v = ū − K (x − x̄) − K_i ξ        u = v within the limits
    ξ̇ = angles − reference + (unwind/T) (v − u)

and begins with ξ = −M (x − x̄): what starts deviate in is x alone. It is a model like any other, in
the states (x, ξ), whose command is the feed-forward ū.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.lqr import Lqr, Regulator
from trms_cli.models.model import Model, Signal
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.subject import LoopParts

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LinearLaw:
    """The law at an equilibrium."""

    regulator: Regulator
    period: float  #: Control period T, s
    point: OperatingPoint  #: x̄ and ū of the rig
    #: (n_r,) array; ξ at the start with x = x̄, rad s: not zero where the rig rests at another
    #: command than the controller's model of it does
    start: FloatArray


def linear_law(model: Model, loop: LoopParts, point: OperatingPoint) -> LinearLaw | None:
    """The law of an LQR loop; None for other controllers, or where rig and belief differ in states.

    Raises ConfigurationError if the controller cannot be designed.
    """
    controller = loop.controller
    if not isinstance(controller, Lqr) or model.state_names != loop.model.state_names:
        return None
    period = controller.sample_time or loop.sample_time
    state = controller.init(ControlSetup(loop.model, period, point.u))
    law = state.regulator
    if law.K.shape[1] != model.n_x:
        return None
    target = state.steady.solve(point.x[state.rows])
    if not target.converged:
        return None
    away = point.x - target.x
    # At rest the integral makes up for what the feed-forward lacks.
    resting = np.linalg.lstsq(law.K_i, target.u - point.u - law.K @ away, rcond=None)[0]
    return LinearLaw(law, period, point, -law.M @ away - resting)


class LinearLawLoop(Model):
    """The closed loop as a model.

    Parameters
    ----------
    base : Model
        The rig.
    law : LinearLaw
    saturated : bool
        Whether commands stay within the limits.
    """

    def __init__(self, base: Model, law: LinearLaw, *, saturated: bool = True) -> None:
        self._base, self._law, self._saturated = base, law, saturated
        self.name = f"{base.name} with lqr"
        added = (Signal(f"xi_{name}", "rad s", f"integral of {name}") for name in base.controlled)
        self.states = (*base.states, *added)
        self.inputs, self.outputs, self.disturbances = base.inputs, base.outputs, base.disturbances
        self.parameters, self.controlled = base.parameters, base.controlled
        self.input_limits, self.stops = base.input_limits, base.stops
        self.axes, self.rotors, self.stiff = base.axes, base.rotors, base.stiff

    @property
    def point(self) -> OperatingPoint:
        """The equilibrium in (x, ξ)."""
        rest = self._law.point
        return OperatingPoint(np.concatenate([rest.x, np.zeros(len(self.controlled))]), rest.u)

    @property
    def gain(self) -> FloatArray:
        """(K, K_i), (n_u, n_x + n_r)."""
        return np.hstack([self._law.regulator.K, self._law.regulator.K_i])

    def unsaturated_rows(self) -> FloatArray:
        """Rows with \\|row · y\\| < 1 where no command is at a limit, (n_u, n)."""
        lower, upper = self._base.input_bounds()
        room = np.minimum(upper - self._law.point.u, self._law.point.u - lower)
        return np.asarray(self.gain / room[:, None])

    def starts(self) -> tuple[FloatArray, FloatArray]:
        """L, o with y = L (x − x̄) + o at the start, (n, n_x) and (n,)."""
        n = self._base.n_x
        matrix = np.vstack([np.eye(n), -self._law.regulator.M])
        return matrix, np.concatenate([np.zeros(n), self._law.start])

    def rest(self) -> FloatArray:
        return np.concatenate([self._base.rest(), np.zeros(len(self.controlled))])

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n, point = self._base.n_x, self._law.point
        away = ca.vertcat(x[:n] - ca.DM(point.x), x[n:])
        wanted = u - ca.mtimes(ca.DM(self.gain), away)
        given = wanted
        if self._saturated:
            lower, upper = self._base.input_bounds()
            given = ca.fmin(ca.fmax(wanted, ca.DM(lower)), ca.DM(upper))
        rows = [self._base.state_index(name) for name in self.controlled]
        drift = ca.vertcat(*(away[row] for row in rows))
        if self._saturated:
            back = self._law.regulator.unwind / self._law.period
            drift += ca.mtimes(ca.DM(back), wanted - given)
        return ca.vertcat(self._base.dynamics(x[:n], given, p, w), drift)

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return self._base.measurement(x[: self._base.n_x], u, p)
