"""Dynamic matrix control: predictive control on step responses, with no state of the rig.

The responses ``S_i`` of the controlled angles to a step of each input, ``i`` control periods after
it, are all that it knows. They are taken at start-up by simulating the nonlinear model away from an
operating point. With ``f`` the angles that the past commands lead to and Δu the changes to come,

    y_k+j = f_j + Σ_i≤j S_i Δu_k+j−i + d_j
    minimise  Σ_j Σ_c q_c (y_c,k+j − r_c,k+j)² + Σ_b Σ_m s_m Δu_mb²

subject to the inputs' limits and rates. ``f`` moves on by one period and gains ``S Δu`` of the
command that was applied. An output that integrates (no cable, no gravity) goes on beyond the last
coefficient with the last slope.

``d`` is what was measured less what ``f`` says. Cutler and Ramaker hold it (a bias). That damps
nothing: on this rig, whose pitch swings for 80 s, what the responses have wrong swings for as long.
``disturbance=swing`` therefore gives each angle a bias and its own slowest mode, a damped
oscillation or a ramp, which a stationary Kalman filter of three states tells apart.

Sources: Cutler & Ramaker, "Dynamic matrix control", Joint Automatic Control Conference 1980;
Maciejowski, "Predictive Control with Constraints", 2002, ch. 4.1; Camacho & Bordons, "Model
Predictive Control", 2007, ch. 3; Lundström, Lee, Morari & Skogestad, "Limitations of dynamic matrix
control", Computers & Chemical Engineering 19, 1995, for the disturbance's dynamics.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import (
    Command,
    ControlSample,
    ControlSetup,
    Delay,
    PresentReference,
)
from trms_cli.controllers.fallback import NOT_FINITE, are_finite, fall_back
from trms_cli.controllers.horizon import blocks_of, check_names
from trms_cli.controllers.lqr import in_order
from trms_cli.controllers.reference_forecast import ReferenceForecast
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, Qp, QpSolver, solve_or_fail
from trms_cli.core.ranges import Positive
from trms_cli.models.linearisation import Linearisation, LinearModel
from trms_cli.models.model import Model, names
from trms_cli.models.steady_state import SteadyState

_KEY = "controller.operating_point"
_BEYOND = "the reference is beyond the stops; the stop is the target"
#: A measured angle counts up to so many times its stop: what is beyond is no angle of a rig.
_FARTHEST = 2.0
#: Least share of the strongest direction that the weakest must have to count as moved.
_LEAST_SHARE = 0.01
#: A mode whose size grows or decays less than this in a period integrates.
_INTEGRATES = 1e-6


@dataclass(frozen=True, kw_only=True)
class Dmc(PresentReference):
    """Dynamic matrix control."""

    sample_time: Positive = 0.1  #: Control period, s
    delay: Delay = "none"
    #: Controlled angles at which the responses are taken, rad
    operating_point: Mapping[str, float] = field(default_factory=lambda: {"alpha_h": 0.35})
    #: Sizes of the steps up and down whose mean is the response, V
    step_sizes: Mapping[str, Positive] = field(default_factory=dict)
    #: N, coefficients of a response, control periods; those of the swing have to have died away
    model_horizon: Annotated[int, Meta(ge=10)] = 800
    prediction_horizon: Annotated[int, Meta(ge=2)] = 40  #: P, control periods
    #: Lengths of the blocks over which an input is constant, control periods; the last one lasts
    move_blocks: tuple[int, ...] = (1,) * 6 + (2,) * 4 + (4,) * 3
    #: Periods that a smooth reference is carried on for; 0 for none
    forecast_horizon: Annotated[int, Meta(ge=0)] = 15
    output_weights: Mapping[str, Positive] = field(default_factory=dict)  #: q, 1/rad²
    move_weights: Mapping[str, Positive] = field(default_factory=dict)  #: s, move suppression, 1/V²
    input_rate_limits: Mapping[str, Positive] = field(default_factory=dict)  #: Hard, V/s
    #: What the difference from the measured angles is taken to do: stay (``bias``), or stay and
    #: move in the angle's slowest mode (``swing``)
    disturbance: Literal["bias", "swing"] = "swing"
    #: Variance of what the bias gains in a period, over that of an error of the measurement; larger
    #: ones believe the measured angles sooner
    bias_variance: Positive = 0.1
    mode_variance: Positive = 1.0  #: The same of each of the mode's states
    #: What acts when a solve fails
    fallback: Literal["shifted_plan", "hold", "stop"] = "shifted_plan"
    qp: QpSolver = field(default_factory=Daqp)

    def init(self, setup: ControlSetup) -> "DmcState":
        """Responses, dynamic matrix and filter for a model.

        Raises ConfigurationError for names that the model does not have, for an operating point
        where the rig cannot rest or the inputs move too little, and for a response shorter than the
        prediction.
        """
        if self.model_horizon <= self.prediction_horizon:
            raise ConfigurationError(
                f"{self.model_horizon} coefficients for a prediction of {self.prediction_horizon}",
                where="controller.model_horizon",
                remedy="choose it longer than controller.prediction_horizon",
            )
        return DmcState(self, setup)

    def step(self, state: "DmcState", sample: ControlSample, *, want_prediction: bool) -> Command:
        """One sample; it predicts angles only, so that there is no trajectory of the states."""
        return state.step(sample)


class DmcState:
    """Responses, and what the past commands lead to.

    ``responses``: (n_r, N, n_u); unit/V. ``free``: (n_r, N); angles now and later if no input
    changes any more. ``plan``: (n_u, n_blocks); V.
    """

    def __init__(self, config: Dmc, setup: ControlSetup) -> None:
        model = setup.model
        self.config, self.model = config, model
        linear = Linearisation(model, setup.sample_time, SteadyState(model)).at(
            config.operating_point, _KEY
        )
        sizes = in_order(config.step_sizes, names(model.inputs), 0.1, "step_sizes")
        self.responses = step_responses(linear, config.model_horizon, sizes)
        _require_effects(self.responses[:, : config.prediction_horizon], model)
        modes = slowest_modes(linear)
        bias, mode = config.bias_variance, config.mode_variance
        filters = [_filter_of(value, bias, mode) for value in modes]
        if config.disturbance == "bias":
            filters = [(np.eye(1), np.ones(1), np.ones(1)) for _ in filters]
        self._filters = filters
        self._integrates = np.array([abs(value - 1) < _INTEGRATES for value in modes])
        self._rows = [model.state_index(name) for name in model.controlled]
        self._stops = np.array([model.stops.get(name, 1e4) for name in model.controlled])
        self.lower, self.upper = model.input_bounds()
        self._set_program(config, setup.sample_time)
        self._forecast = ReferenceForecast(
            min(config.forecast_horizon, config.prediction_horizon), len(model.controlled)
        )
        self._future = [_future(F, H, config.prediction_horizon) for F, H, _ in filters]
        self.free: FloatArray | None = None
        self.disturbance = [np.zeros(len(F)) for F, _, _ in filters]
        self._last = setup.first_command.copy()
        self.plan = np.tile(setup.first_command[:, None], len(self._periods))

    def _set_program(self, config: Dmc, period: float) -> None:
        """What stays the same of the quadratic program in the inputs' levels by block."""
        model, P = self.model, config.prediction_horizon
        blocks = blocks_of(P, tuple(config.move_blocks))
        starts = np.flatnonzero(np.diff(blocks, prepend=-1))
        self._periods = np.bincount(blocks)
        n_u, n_blocks = model.n_u, len(starts)
        n = n_u * n_blocks
        dynamic = np.zeros((len(self._rows), P, n_blocks, n_u))
        for b, start in enumerate(starts):
            dynamic[:, start:, b] = self.responses[:, : P - start]
        matrix = dynamic.reshape(-1, n)  # rows angle by angle; columns block by block
        # Changes are D z − (u of now, 0, …).
        self._difference = np.eye(n) - np.eye(n, k=-n_u)
        inputs = names(model.inputs)
        q = in_order(config.output_weights, model.controlled, 1.0, "output_weights")
        s = np.tile(in_order(config.move_weights, inputs, 0.01, "move_weights"), n_blocks)
        self._slopes = matrix @ self._difference
        self._prices = np.repeat(q, P)
        self._weighted = 2.0 * self._slopes.T * self._prices
        self._hessian = self._weighted @ self._slopes
        self._hessian += 2.0 * self._difference.T * s @ self._difference
        self._now_slopes = -matrix[:, :n_u]
        self._move_price = 2.0 * s[:n_u]
        check_names(config.input_rate_limits, inputs, "input_rate_limits")
        largest = [period * config.input_rate_limits.get(name, np.inf) for name in inputs]
        bound = np.tile(largest, n_blocks)
        self._limited = np.isfinite(bound)
        self._bound = bound[self._limited]
        self._workspace: Any = config.qp.start()

    def step(self, sample: ControlSample) -> Command:
        """Move on, compare with what was measured, and plan."""
        previous = sample.previous_command
        move = previous - self._last
        self._last = previous.copy()
        if self.free is not None:
            self._advance(move)
        if not are_finite(sample.estimate.x, sample.reference):
            return self._fall_back(NOT_FINITE)
        far = _FARTHEST * self._stops
        measured = np.clip(sample.estimate.x[self._rows], -far, far)
        if self.free is None:  # nothing is known of the commands before: it rests
            self.free = np.tile(measured[:, None], self.config.model_horizon)
        reference = np.clip(sample.reference[0], -self._stops, self._stops)
        out_of_reach = bool((reference != sample.reference[0]).any())
        P = self.config.prediction_horizon
        goal = np.repeat(reference[:, None], P, axis=1)
        ahead = self._forecast.update(reference)[1:].T
        goal[:, : ahead.shape[1]] = ahead
        goal[:, ahead.shape[1] :] = ahead[:, -1:] if ahead.size else reference[:, None]
        error = self.free[:, 1 : P + 1] - goal
        for i, (_, H, gain) in enumerate(self._filters):
            d = self.disturbance[i]
            d += gain * (measured[i] - self.free[i, 0] - H @ d)
            error[i] += self._future[i] @ d
        begin = perf_counter()
        qp, constant = self._program(error.ravel(), previous)
        result, self._workspace = solve_or_fail(self.config.qp, self._workspace, qp)
        time = perf_counter() - begin
        if not result.solved:
            return self._fall_back(f"the QP was not solved: {result.message}")
        z = result.z
        self.plan = np.clip(
            z.reshape(-1, len(previous)).T, self.lower[:, None], self.upper[:, None]
        )
        return Command(
            self.plan[:, 0].copy(),
            iterations=result.iterations,
            objective=float(z @ (0.5 * self._hessian @ z + qp.gradient)) + constant,
            qp_time=time,
            message=_BEYOND if out_of_reach else "",
            out_of_reach=out_of_reach,
        )

    def _program(self, error: FloatArray, u: FloatArray) -> tuple[Qp, float]:
        """The program in z for errors without further moves, and what the objective has besides."""
        n_u, rows = len(u), self._difference[self._limited]
        at_zero = error + self._now_slopes @ u
        gradient = self._weighted @ at_zero
        gradient[:n_u] -= self._move_price * u
        now = np.zeros(len(gradient))
        now[:n_u] = u
        now = now[self._limited]
        m, n_blocks = len(rows), len(self._periods)
        lower = np.concatenate([np.tile(self.lower, n_blocks), now - self._bound])
        upper = np.concatenate([np.tile(self.upper, n_blocks), now + self._bound])
        qp = Qp(self._hessian, gradient, rows, lower, upper, np.full(m, np.inf), np.ones(m))
        return qp, float(self._prices @ at_zero**2 + 0.5 * self._move_price @ u**2)

    def _advance(self, move: FloatArray) -> None:
        """One period later, after a change of the inputs, (n_u,), V."""
        free = self.free
        assert free is not None
        # The command was changed a period ago: its first coefficient counts now.
        free[:, :-1] = free[:, 1:]
        free[:, -1] += np.where(self._integrates, free[:, -1] - free[:, -3], 0.0)
        free += self.responses @ move
        self.disturbance = [
            F @ d for (F, _, _), d in zip(self._filters, self.disturbance, strict=True)
        ]

    def _fall_back(self, reason: str) -> Command:
        """The declared command; the plan has moved on by a period where its first block ends."""
        if self._periods[0] == 1 and self.plan.shape[1] > 1:
            self.plan = np.hstack([self.plan[:, 1:], self.plan[:, -1:]])
        policy, bounds = self.config.fallback, (self.lower, self.upper)
        return fall_back("dmc", policy, reason, self.plan[:, 0], None, self._last, bounds)


def step_responses(linear: LinearModel, count: int, sizes: FloatArray) -> FloatArray:
    """Of the nonlinear model at an operating point, (n_r, count, n_u), unit/V.

    The first coefficient is one period after the step; half the difference between steps up and
    down by ``sizes``, (n_u,), V.

    Raises ConfigurationError if the model runs away.
    """
    discrete, target = linear.discrete, linear.target
    model = discrete.model
    step, p, w = BufferedFunction(discrete.step), model.parameters.values, np.zeros(model.n_w)
    lower, upper = model.input_bounds()

    def angles(u: FloatArray) -> FloatArray:
        x, rows = discrete.initial(target.x, target.u), []
        for _ in range(count):
            x = step.evaluate(x, u, p, w)[0].ravel().copy()
            rows.append(linear.C @ x)
        return np.array(rows).T

    responses = np.zeros((linear.C.shape[0], count, model.n_u))
    for j in range(model.n_u):
        above, below = target.u.copy(), target.u.copy()
        above[j], below[j] = min(above[j] + sizes[j], upper[j]), max(below[j] - sizes[j], lower[j])
        responses[:, :, j] = (angles(above) - angles(below)) / (above[j] - below[j])
    if not np.isfinite(responses).all():
        raise ConfigurationError(
            "the model's step responses are not finite",
            where="controller.step_sizes",
            remedy="choose smaller steps, or an operating point from which the rig does not run",
        )
    return responses


def _require_effects(responses: FloatArray, model: Model) -> None:
    """Refuse responses, (n_r, P, n_u), with which some combination of angles cannot be moved."""
    directions, strength, _ = np.linalg.svd(responses.sum(axis=1))
    if len(strength) < len(directions) or strength[-1] < _LEAST_SHARE * strength[0]:
        weakest = model.controlled[int(np.argmax(np.abs(directions[:, -1])))]
        raise ConfigurationError(
            f"steps of the inputs hardly move {weakest} at this operating point "
            "(a rotor that stands still has a thrust without slope)",
            where=_KEY,
            remedy=f"choose one with the rotor turning, as {_KEY}.{weakest}=0.35, "
            "or a larger step of controller.step_sizes",
        )


def slowest_modes(linear: LinearModel) -> list[complex]:
    """Of each controlled angle the eigenvalue that decays last among those it mainly takes part in.

    An angle takes part in a mode as far as right times left eigenvector say (participation factors:
    Pérez-Arriaga, Verghese & Schweppe 1982).
    """
    values, right = np.linalg.eig(linear.A)
    share = np.abs(right * np.linalg.pinv(right).T)
    modes = []
    for row in linear.C:
        of_angle = share[int(np.argmax(row))]
        mainly = np.flatnonzero(of_angle > 0.5 * of_angle.max())
        modes.append(complex(values[mainly[np.argmax(np.abs(values[mainly]))]]))
    return modes


def _filter_of(
    mode: complex, bias_variance: float, mode_variance: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Transition F, output H and stationary Kalman gain of a bias with a mode beside it."""
    from scipy.linalg import solve_discrete_are

    size, angle = min(abs(mode), 1.0), math.atan2(abs(mode.imag), mode.real)
    if angle == 0.0 and size > 1.0 - _INTEGRATES:
        F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([1.0, 0.0])
        Q = np.diag([mode_variance, bias_variance])
    else:
        F, H = np.eye(3), np.array([1.0, 1.0, 0.0])
        F[1:, 1:] = size * np.array(
            [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
        )
        Q = np.diag([bias_variance, mode_variance, mode_variance])
    P = solve_discrete_are(F.T, H[:, None], Q, np.eye(1))
    return F, H, P @ H / (H @ P @ H + 1.0)


def _future(F: FloatArray, H: FloatArray, count: int) -> FloatArray:
    """Rows that give the disturbance 1 … ``count`` periods on, (count, n)."""
    rows, row = [], H
    for _ in range(count):
        row = row @ F
        rows.append(row)
    return np.array(rows)
