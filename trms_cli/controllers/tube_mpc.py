"""Tube MPC: a nominal plan with tightened limits, and a feedback that keeps the rig around it.

After Mayne, Seron & Raković 2005 (Automatica 41), with the estimate's error as the disturbance
(Mayne, Raković, Findeisen & Allgöwer 2006, Automatica 42). The command is

    u = ū + K (x̂ − x̄)

with the plan's first input ū, the nominal state x̄ and the gain K of a linear-quadratic regulator.
With the estimate's error ε = x − x̂, the error d of the estimated disturbance and process noise q,
each within a box of ``sigma`` standard deviations, the distance of the rig from the nominal state
obeys, for the linear model at the operating point,

    e⁺ = (A + B K) e − B K ε + E d + q

and stays in the least set that this maps into itself, whose half-width along a row g is

    h(g) = Σ_i |g A_K^i B K| ε_max + |g A_K^i E| d_max + |g A_K^i| q_max

(Raković et al. 2005, IEEE TAC 50; summed until rounding). The standard deviations are the
observer's, at every sample, so that the tube narrows as the filter settles; those of the process
are the model's own and ``process_noise``. Soft limits of states are tightened by h of their rows,
bounds of the inputs by h of K's and ``|K| ε_max``; targets stay within the tightened limits.

The plan is that of :mod:`trms_cli.controllers.linear_mpc`, from x̄, which goes its own way by the
nonlinear model, as in Mayne & Langson 2001 (Electron. Lett. 37); the paper of 2005 has its start as
a further unknown. Where the estimate leaves the tube, which no bounded error of a right model
does, x̄ starts again from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.horizon import Horizon, check_names
from trms_cli.controllers.linear_mpc import LinearMpc, LinearMpcState, Way
from trms_cli.controllers.newton.problem import typical_sizes
from trms_cli.controllers.newton.step import NewtonStep
from trms_cli.controllers.scenario_tree import operating_point
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, QpSolver
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.discretisation import noise_of_states
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import names
from trms_cli.models.state_scales import bench_ratios

WIDE = "the tube is wider than the limits leave room for: they are tightened by less"
LEFT = "the estimate has left the tube: the nominal state starts again from it"
#: Terms of h(g) at the most, and the share of the sum below which they no longer count.
_MOST_TERMS, _ROUNDING = 20000, 1e-10
#: Usual weight of an input in the feedback's cost, by the scale of a user's model.
_FEEDBACK = 0.05
#: Weight of every state in the feedback's cost, in typical sizes, as a share of the largest.
_LEAST_WEIGHT = 1e-3


@dataclass(frozen=True, kw_only=True)
class TubeMpc(LinearMpc):
    """Tube MPC."""

    #: Standard deviations of the estimate's error and of the noise that count as their bounds
    sigma: Positive = 2.0
    #: Of states, beside the model's own noise: in T seconds a state spreads by this times √T
    process_noise: Mapping[str, NotNegative] = field(default_factory=dict)
    #: Weights of the inputs in the feedback's cost, 1/V²; those of states are the plan's
    feedback_weights: Mapping[str, Positive] = field(
        default_factory=lambda: {"u_v": 0.05, "u_h": 0.05}
    )
    #: Share of the inputs' ranges, and of those of soft limits, that a plan keeps in any case
    least_room: Annotated[float, Meta(gt=0, lt=1)] = 0.5
    qp: QpSolver = field(default_factory=Daqp)

    #: The prediction is exact at the nominal state.
    linearisation: ClassVar[Way] = "current"  # type: ignore[misc]

    def init(self, setup: ControlSetup) -> TubeState:
        """Feedback and tube, beside the linear MPC in NumPy.

        Raises ConfigurationError as :class:`~trms_cli.controllers.linear_mpc.LinearMpc` does, and
        where no feedback stabilises the linear model.
        """
        return TubeState(self, setup)


class TightenedStep(NewtonStep):
    """The program with limits that change from sample to sample."""

    def __init__(self, horizon: Horizon, qp: QpSolver, largest_moves: FloatArray) -> None:
        super().__init__(horizon, qp, largest_moves)
        self._whole = self.lower.copy(), self.upper.copy(), self._limits.copy()

    def tighten(self, inputs: FloatArray, states: FloatArray) -> None:
        """By so much to either side: the inputs (n_u,), V; the limited states (n_limited,)."""
        lower, upper, limits = self._whole
        self.lower, self.upper = lower + inputs, upper - inputs
        n = self.horizon.n_z
        self._lowest[:n] = np.tile(self.lower, self.horizon.n_blocks)
        self._highest[:n] = np.tile(self.upper, self.horizon.n_blocks)
        self._limits = limits + np.column_stack([states, -states])
        self.horizon.arguments["limits"][...] = self._limits
        np.clip(self.plan, self.lower[:, None], self.upper[:, None], out=self.plan)


class TubeState(LinearMpcState):
    """The nominal state and the tube besides.

    ``gain``: (n_u, n); K. ``widths``: (n,); h of each state for the present bounds. ``nominal``:
    (n,); x̄, memory of the input path included; None before the first sample and after a failure.
    """

    newton: TightenedStep

    def __init__(self, config: TubeMpc, setup: ControlSetup) -> None:
        super().__init__(config, setup)
        self._tube, problem, model = config, self.problem, self.model
        self.newton = TightenedStep(problem.horizon, config.qp, problem.largest_moves)
        self.newton.horizon.arguments["root"][...] = problem.root
        self.gain = self._feedback()
        self._of_states, self._of_inputs = self._shapes()
        noise = noise_of_states(model, model.parameters.values, setup.sample_time)
        check_names(config.process_noise, model.state_names, "process_noise")
        for name, intensity in config.process_noise.items():
            if name in model.state_names:
                row = model.state_index(name)
                noise[row] = np.hypot(noise[row], intensity * np.sqrt(setup.sample_time))
        self._noise = np.concatenate([noise, np.zeros(len(self._full) - model.n_x)])
        self._limited = [model.state_index(name) for name in problem.horizon.limited]
        self._controlled = [model.state_index(name) for name in model.controlled]
        self._goal_limits = problem.goal_limits
        self.nominal: FloatArray | None = None
        self.widths = np.zeros(len(self._full))
        self._actual = self._full.copy()
        self._previous = setup.first_command.copy()
        self._nominal_input = setup.first_command.copy()
        self._words: list[str] = []

    def _feedback(self) -> FloatArray:
        """K of the linear-quadratic regulator at the operating point."""
        from scipy.linalg import solve_discrete_are

        problem, model = self.problem, self.model
        A, B, weights = problem.A, problem.B, problem.horizon.weights
        sizes = np.ones(len(A))
        sizes[: model.n_x] = typical_sizes(problem.discrete)
        states = np.zeros(len(A))
        for name in problem.horizon.weighted:
            states[model.state_index(name)] = weights.states[name]
        states += _LEAST_WEIGHT * float((states * sizes**2).max()) / sizes**2
        change = A - np.eye(len(A))
        Q = np.diag(states)
        for name in problem.horizon.damped:
            row = change[model.state_index(name)] / problem.discrete.step_length
            Q += weights.rates[name] * np.outer(row, row)
        inputs = names(model.inputs)
        given = self._tube.feedback_weights
        check_names(given, inputs, "feedback_weights")
        usual = (1.0 if model.bench_sizes else _FEEDBACK) * bench_ratios(model).inputs ** -2.0
        R = np.diag([given.get(n, weight) for n, weight in zip(inputs, usual, strict=True)])
        try:
            P = solve_discrete_are(A, B, Q, R)
            gain = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
            slowest = float(np.abs(np.linalg.eigvals(A + B @ gain)).max())
        except (np.linalg.LinAlgError, ValueError):
            slowest = np.inf
        if not slowest < 1.0:
            raise ConfigurationError(
                "no feedback keeps the linear model within a tube at this operating point",
                where="controller.operating_point",
                remedy="choose one with both rotors turning",
            )
        return gain

    def _shapes(self) -> tuple[FloatArray, FloatArray]:
        """h by the bounds of ε, d and q: of the states (n, n + n_w + n) and of the inputs."""
        problem, model, K = self.problem, self.model, self.gain
        n, n_w, config = len(self._full), model.n_w, self._tube
        x, u = operating_point(problem, config.operating_point)
        p, still = model.parameters.values, np.zeros(n_w)
        # As large as torques are estimated, so that a difference is no rounding.
        steps = 1e-3 * np.eye(n_w)
        after = self._step.evaluate(x, u, p, still)[0].ravel().copy()
        E = np.array([self._step.evaluate(x, u, p, w)[0].ravel() - after for w in steps]) / 1e-3
        entry = np.hstack([problem.B @ K, E.reshape(n_w, n).T, np.eye(n)])
        closed = problem.A + problem.B @ K
        power, of_states, of_inputs = entry, np.zeros_like(entry), np.zeros((len(K), n + n_w + n))
        for _ in range(_MOST_TERMS):
            term = np.abs(power)
            of_states += term
            of_inputs += np.abs(K @ power)
            if (term <= _ROUNDING * of_states.max(axis=1, keepdims=True)).all():
                break
            power = closed @ power
        of_inputs[:, :n] += np.abs(K)
        return of_states, of_inputs

    def _bounds(self, estimate: Estimate) -> FloatArray:
        """Of ε, d and q, (n + n_w + n,)."""
        memory = np.zeros(len(self._full) - self.model.n_x)
        parts = (estimate.sd, memory, estimate.disturbance_sd, self._noise)
        return self._tube.sigma * np.nan_to_num(np.concatenate(parts), posinf=1e6)

    def begin_sample(self, sample: ControlSample) -> None:
        """The tube of now, and linear MPC from the nominal state."""
        n_x, estimate = self.model.n_x, sample.estimate
        self._words, self._previous = [], sample.previous_command
        if len(self._full) > n_x:
            self._actual[n_x:] = self._step.evaluate(
                self._actual, sample.previous_command, self.model.parameters.values, 0.0
            )[0][n_x:]
        if not np.isfinite(estimate.x).all():
            self.nominal = None
            super().begin_sample(sample)
            return
        self._actual[:n_x] = estimate.x
        bounds = self._bounds(estimate)
        self._tighten(bounds)
        if self.nominal is not None:
            off = np.abs(self._actual - self.nominal)[:n_x]
            if (off > self.widths[:n_x] + bounds[:n_x] + 1e-12).any():
                self.nominal = None
                # A tube without width is that of an estimate without error: linear MPC.
                self._words += [LEFT] if bounds.any() else []
        if self.nominal is None:
            self.nominal = self._actual.copy()
            self._nominal_input = sample.previous_command.copy()
        around = replace(estimate, x=self.nominal[:n_x])
        super().begin_sample(replace(sample, estimate=around, previous_command=self._nominal_input))
        self._full[n_x:] = self.nominal[n_x:]
        self.newton.horizon.arguments["x0"][:] = self._full
        if not self.inputs_finite:
            self.nominal = None

    def _tighten(self, bounds: FloatArray) -> None:
        """Limits for the plan, from the bounds of all errors."""
        newton, room = self.newton, 0.5 * (1.0 - self._tube.least_room)
        self.widths = self._of_states @ bounds
        lower, upper = self.model.input_bounds()
        inputs = np.minimum(self._of_inputs @ bounds, room * (upper - lower))
        limits = np.array(
            [newton.horizon.soft_limits.states[name] for name in newton.horizon.limited]
        ).reshape(-1, 2)
        states = np.minimum(self.widths[self._limited], room * (limits[:, 1] - limits[:, 0]))
        is_wide = (self._of_inputs @ bounds > inputs).any()
        if is_wide or (self.widths[self._limited] > states).any():
            self._words.append(WIDE)
        newton.tighten(inputs, states)
        if self._goal_limits is not None:
            goals = np.zeros(len(self._controlled))
            for i, row in enumerate(self._controlled):
                if row in self._limited:
                    goals[i] = states[self._limited.index(row)]
            self.problem.goal_limits = self._goal_limits + np.column_stack([goals, -goals])

    def solve(self, *, want_prediction: bool) -> Command:
        """The plan's first input, and the feedback around the nominal state."""
        command = super().solve(want_prediction=want_prediction)
        nominal = self.nominal
        if command.status is Status.FAILED or nominal is None:
            self.nominal = None
            if command.fallback == "hold":
                command.u = self._previous.copy()
            return command
        planned, largest = command.u, self.problem.largest_moves
        u = planned + self.gain @ (self._actual - nominal)
        u = np.clip(u, self._previous - largest, self._previous + largest)
        command.u = np.clip(u, *self.model.input_bounds())
        p, w = self.model.parameters.values, self._disturbance
        self.nominal = self._step.evaluate(nominal, planned, p, w)[0].ravel().copy()
        self._nominal_input = planned
        command.message = "; ".join(filter(None, [command.message, *self._words]))
        return command
