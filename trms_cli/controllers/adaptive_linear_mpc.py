"""Linear MPC whose model is adapted by recursive least squares.

The linear model of the operating point is where it starts. From then on each state's equation

    x_i⁺ = x_i,0 + Σ_j θ_ij φ_j        φ = (x − x_0, u − u_0, 1)

is fitted to the estimates and the commands, with exponential forgetting. Coefficients are counted
in their uncertainty, ``θ_ij = a_ij + share |a_ij| η_ij``, with η from 0 and a covariance from 1: so
they are of one size, a coefficient that the model's structure makes zero stays zero, and a state's
own past (the identity in A) is no unknown. Three precautions of the field keep it sane:

- a dead zone: a residual that noise explains changes nothing; at rest nothing is learnt;
- bounds of the covariance: it never exceeds that of the beginning (no wind-up by forgetting);
- bounds of η, and of an input's effect, below which the last model with an effect is kept.

The quadratic program is that of :mod:`trms_cli.controllers.linear_mpc` with the slopes of the fit.
Its prediction starts from a period of the nonlinear model under the last command and goes to that
model's steady state of the reference; the constant of the fit keeps the slopes from a bias and does
not enter: what is constant is the observer's disturbance.

Source: Åström & Wittenmark, "Adaptive Control", 2nd ed. 1995, ch. 2.2 (recursive least squares,
forgetting) and 11.3 (dead zones, bounded covariance, projection).
"""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.controllers.linear_mpc import GivenModelState, LinearMpc, Way
from trms_cli.controllers.newton.problem import typical_sizes
from trms_cli.core.arrays import FloatArray
from trms_cli.core.qp import Daqp, QpSolver
from trms_cli.core.ranges import NotNegative, Positive

#: Typical sizes beyond which a deviation teaches nothing: no rig is there.
_FARTHEST = 10.0


@dataclass(frozen=True, kw_only=True)
class AdaptiveLinearMpc(LinearMpc):
    """Linear MPC adapted by recursive least squares."""

    #: Standard deviation of a coefficient at the beginning, as a share of itself
    uncertainty: Annotated[float, Meta(gt=0, lt=1)] = 0.3
    #: Time after which a sample counts 1/e in the fit, s
    memory_time: Positive = 10.0
    #: Standard deviation of a residual, as a share of the state's typical size
    residual_share: Positive = 0.01
    #: Residuals below so many of these change nothing
    dead_zone: NotNegative = 1.0
    #: Most standard deviations that a coefficient leaves its first value by
    largest_change: Positive = 2.0
    qp: QpSolver = field(default_factory=Daqp)

    #: The prediction is exact at the present; the fit stands in the place of the slopes there.
    linearisation: ClassVar[Way] = "current"  # type: ignore[misc]

    def init(self, setup: ControlSetup) -> "AdaptiveState":
        """The fit, beside the linear MPC in NumPy.

        Raises ConfigurationError as :class:`~trms_cli.controllers.linear_mpc.LinearMpc` does.
        """
        return AdaptiveState(self, setup)


class AdaptiveState(GivenModelState):
    """The fit besides.

    ``change``: (n_x, n + n_u + 1); η. ``covariance``: (n_x, n + n_u + 1, n + n_u + 1); of η.
    """

    def __init__(self, config: AdaptiveLinearMpc, setup: ControlSetup) -> None:
        super().__init__(config, setup)
        self._adapt, problem = config, self.problem
        n_x = setup.model.n_x
        self._first_model = np.hstack([problem.A, problem.B])
        columns = self._first_model.shape[1]
        self._size = typical_sizes(self.discrete)
        own = self._first_model[:n_x].copy()
        own[:, :n_x] -= np.eye(n_x)
        # The constant is uncertain by a per cent of what the state does in seconds.
        self._scale = np.hstack([config.uncertainty * np.abs(own), 0.01 * self._size[:, None]])
        self.change = np.zeros((n_x, columns + 1))
        self.covariance = np.tile(np.eye(columns + 1), (n_x, 1, 1))
        self._forgetting = float(np.exp(-setup.sample_time / config.memory_time))
        target = self.steady_state.solve(
            np.array([config.operating_point.get(name, 0.0) for name in setup.model.controlled])
        )
        self._centre = self.discrete.initial(target.x, target.u)
        self._centre_input = target.u
        self._before: FloatArray | None = None

    def begin_sample(self, sample: ControlSample) -> None:
        """As linear MPC; and the last period is learnt from."""
        before = self._before
        super().begin_sample(sample)
        self._before = self._full.copy() if self.inputs_finite else None
        if before is not None and self.inputs_finite:
            self._learn(before, self._last_command, self._full)

    def _learn(self, before: FloatArray, u: FloatArray, after: FloatArray) -> None:
        """A step of recursive least squares of all equations, from one period."""
        config, n_x = self._adapt, self.model.n_x
        away = np.concatenate([before - self._centre, u - self._centre_input])
        arrived = after[:n_x] - self._centre[:n_x]
        farthest = _FARTHEST * self._size
        if (np.abs(away[:n_x]) > farthest).any() or (np.abs(arrived) > farthest).any():
            return
        noise = config.residual_share * self._size
        regressors = self._scale * np.append(away, 1.0)
        residual = arrived - self._first_model[:n_x] @ away
        residual -= (regressors * self.change).sum(axis=1)
        learnt = np.abs(residual) > config.dead_zone * noise
        if not learnt.any():
            return
        phi, P = (regressors / noise[:, None])[learnt], self.covariance[learnt]
        projected = np.einsum("imn,in->im", P, phi)
        power = self._forgetting + (phi * projected).sum(axis=1)
        gain = projected / power[:, None]
        change = self.change[learnt] + gain * (residual / noise)[learnt, None]
        self.change[learnt] = np.clip(change, -config.largest_change, config.largest_change)
        P = (P - gain[:, :, None] * projected[:, None, :]) / self._forgetting
        # Back to the first variance where forgetting has gone beyond it.
        variance = np.einsum("imm->im", P)
        shrink = np.sqrt(1.0 / np.maximum(variance, 1.0))
        P = P * shrink[:, :, None] * shrink[:, None, :]
        self.covariance[learnt] = 0.5 * (P + P.transpose(0, 2, 1))
        self._take_model()

    def _take_model(self) -> None:
        """The model of the present fit, where each input has an effect in it."""
        n_x, (n, _) = self.model.n_x, self.problem.B.shape
        model = self._first_model.copy()
        model[:n_x] += (self._scale * self.change)[:, :-1]
        A, B = model[:, :n].copy(), model[:, n:].copy()
        if (self.problem.effect(A, B) >= self.problem.least_effect).all():
            self._operating = (A, B)
