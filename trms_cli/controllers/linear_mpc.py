"""Linear model predictive control around the steady states of the nonlinear model.

The quadratic program of ``newton_mpc`` with a model that is the same in all periods: horizon,
blocks, objective and limits are its, the compiled engine
(:mod:`trms_cli.controllers.newton.engine`) is too, and the fall-back in NumPy without a compiler
or with another solver (:mod:`trms_cli.controllers.newton.state`). Of a linear model one iteration
is the solution. Beyond the horizon the cost to go of the unconstrained problem counts (Rawlings,
Mayne & Diehl, "Model Predictive Control", 2017, ch. 1.3 and 2.5), so that without active limits the
law is the linear-quadratic regulator.

Where the linear model is taken:

- ``fixed``: at one operating point.
- ``target``: at the steady state of the present reference.
- ``current``: at the present estimate and the last command, again at each sample.

The deviations are from the nonlinear model's steady state under the observer's disturbance: with an
observer that estimates them there is no offset, wherever the matrices come from (Pannocchia &
Rawlings 2003, AIChE J. 49). A rotor at rest has a thrust without slope (ω|ω|): a linear model in
which an input has lost most of its effect is not used, that of the operating point stands in.

The prediction is ``x⁺ = A x + B u + δ``, x with the memory of the input path, where δ makes the
model right at the point that it was taken at: the estimate, or the steady state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, get_args

import casadi as ca
import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.controllers.fallback import Policy
from trms_cli.controllers.horizon import (
    Horizon,
    HorizonSettings,
    NotNegative,
    SoftLimits,
    Weights,
)
from trms_cli.controllers.newton.engine import NewtonEngine
from trms_cli.controllers.newton.problem import NewtonProblem
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.controllers.qp.riccati import Riccati
from trms_cli.core.arrays import FloatArray
from trms_cli.core.c_source import SettingField
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import QpSolver
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.linearisation import Linearisation, require_drivable
from trms_cli.models.steady_state import Target

_KEY = "controller.operating_point"
#: Least part of its effect at the operating point that an input must have in a linear model.
_LEAST_EFFECT = 0.3
#: A target whose inputs moved less keeps its linear model, V.
_SAME_TARGET = 0.01
Way = Literal["fixed", "target", "current"]


#: A period, of what comes later, where a mode is neither stable nor unstable.
_DISCOUNT = 1e-6


@dataclass(frozen=True, kw_only=True)
class LinearMpc(HorizonSettings):
    """Linear MPC."""

    #: Where the linear model is taken
    linearisation: Way = "current"
    #: Controlled angles of ``fixed``, rad; also of the cost beyond the horizon
    operating_point: Mapping[str, float] = field(default_factory=lambda: {"alpha_h": 0.5})
    rate_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 0.73, "alpha_h": 0.36}
    )
    move_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"u_v": 0.01, "u_h": 0.02}
    )
    #: Whether what is beyond the horizon counts, by the cost to go of the Riccati equation
    terminal: Literal["riccati", "none"] = "riccati"
    #: What acts when a solve fails: the last plan shifted in time, the last command, the
    #: steady-state input of the reference, or the end of the run
    fallback: Policy = "shifted_plan"
    #: What solves the quadratic programs: ``riccati`` is the compiled engine's own; any other runs
    #: in NumPy
    qp: QpSolver = field(default_factory=Riccati)

    # Of a linear model any first iterate is the solution; there is no terminal region.
    max_iterations: ClassVar[int] = 1
    tolerance: ClassVar[float] = np.inf
    terminal_weight: ClassVar[float] = 0.0
    terminal_decay: ClassVar[float] = 0.0

    def problem(self, setup: ControlSetup) -> LinearProblem:
        """What it poses for a model.

        Raises ConfigurationError for names and limits that the model does not have, and for an
        operating point that no input holds.
        """
        return LinearProblem(self, setup)

    def init(self, setup: ControlSetup) -> LinearMpcState | NewtonEngine:
        """The compiled engine; in NumPy without a compiler, and with another solver than its own.

        Raises ConfigurationError as :meth:`problem` does.
        """
        if type(self.qp) is Riccati:
            engine = NewtonEngine.of(self.problem(setup), setup, self.preview(setup))
            if engine is not None:
                return engine
        return LinearMpcState(self, setup)

    def step(
        self,
        state: LinearMpcState | NewtonEngine,
        sample: ControlSample,
        *,
        want_prediction: bool,
    ) -> Command:
        """One sample: target, linear model, quadratic program, command."""
        return state.step(sample, want_prediction=want_prediction)


class LinearProblem(NewtonProblem):
    """The problem of a configuration for a model.

    ``A``, ``B``: (n, n), (n, n_u); the model of the operating point, memory of the input path
    included. ``operating_input``: (n_u,); V. ``root``: (n + n_u, n + n_u); upper triangular L of
    the cost to go, zero without. ``least_effect``: (n_u,); see :meth:`effect`.
    """

    name = "linear_mpc"

    def __init__(self, config: LinearMpc, setup: ControlSetup) -> None:
        model = setup.model
        config = config.for_model(model)
        positive = {name: q for name, q in config.state_weights.items() if q > 0}
        if not any(name in positive for name in model.controlled):
            raise ConfigurationError(
                f"no weight on any of {', '.join(model.controlled)}",
                where="controller.state_weights",
                remedy=f"controller.state_weights.{model.controlled[0]}=1.0",
            )
        self.set_limits(config, setup, positive)
        linear = Linearisation(model, setup.sample_time, self.steady_state).at(
            config.operating_point, _KEY
        )
        require_drivable(linear, _KEY)
        self.A, self.B, self.operating_input = linear.A, linear.B, linear.target.u
        # Its model lacks the impulses of dry friction, which has no slopes where it holds an axis.
        self.discrete = discretise(
            linear.discrete.model, setup.sample_time, config.integration_steps
        )
        self.horizon = Horizon(
            linear_steps(self.discrete),
            self._blocks,
            Weights(positive, config.rate_weights, config.input_weights, config.move_weights),
            SoftLimits(config.soft_limits, config.soft_linear, config.soft_quadratic),
            None,
            np.ones(model.n_x),
            linear=True,
        )
        n = sum(self.B.shape)
        self.root = self._cost_to_go() if config.terminal == "riccati" else np.zeros((n, n))
        self.least_effect = _LEAST_EFFECT * self.effect(self.A, self.B)
        self.further_settings = (
            SettingField(
                "operating_model",
                "[MPC_N_FULL * MPC_N_V]",
                np.hstack([self.A, self.B]).ravel(),
                "next state by state and input, row by row, at the operating point",
            ),
            SettingField("operating_input", "[MPC_N_U]", self.operating_input, "V, there"),
            SettingField(
                "least_effect",
                "[MPC_N_U]",
                self.least_effect,
                "1/V, on the weighted states, of an input in a model that is used",
            ),
            SettingField(
                "end_root",
                "[MPC_N_V * MPC_N_V]",
                self.root.ravel(),
                "of the cost beyond the horizon; upper triangle, row by row",
            ),
        )
        way = np.array([get_args(Way).index(config.linearisation)])
        self.further_switches = (
            SettingField("linearisation", "", way, "fixed, target, current", is_whole=True),
        )

    def effect(self, A: FloatArray, B: FloatArray) -> FloatArray:
        """How far each input held over the horizon moves the weighted states, (n_u,)."""
        moved = np.zeros_like(B)
        for _ in range(self.horizon.n_periods):
            moved = A @ moved + B
        rows = [self.model.state_index(name) for name in self.horizon.weighted]
        root = np.sqrt([self.horizon.weights.states[name] for name in self.horizon.weighted])
        return np.asarray((root[:, None] * np.abs(moved[rows])).sum(axis=0))

    def _cost_to_go(self) -> FloatArray:
        """Root L of the cost to go ‖L (Δx, v_last)‖² of the unconstrained problem.

        The Riccati equation of the state with the last input beside it, whose stage cost is that
        of a period: the state that it leads to, the rate on the way, the input and its change.

        Raises ConfigurationError if there is no solution.
        """
        A, B, horizon = self.A, self.B, self.horizon
        n, n_u = B.shape
        states, rates = np.zeros(n), np.zeros(n)
        for weights, kept, given in (
            (states, horizon.weighted, horizon.weights.states),
            (rates, horizon.damped, horizon.weights.rates),
        ):
            for name in kept:
                weights[self.model.state_index(name)] = given[name]
        moves, inputs = horizon.arguments["s"], horizon.arguments["rho"]
        F, G = np.zeros((n + n_u, n + n_u)), np.vstack([B, np.eye(n_u)])
        F[:n, :n] = A
        ahead = np.hstack([A, np.zeros((n, n_u)), B])
        difference = ahead - np.eye(n, n + 2 * n_u)
        input_now = np.eye(n_u, n + 2 * n_u, n + n_u)
        change = input_now - np.eye(n_u, n + 2 * n_u, n)
        cost = (
            ahead.T * states @ ahead
            + difference.T * (rates / self.discrete.step_length**2) @ difference
            + change.T * moves @ change
            + input_now.T * inputs @ input_now
        )
        m = n + n_u
        try:
            P = _riccati(F, G, cost[:m, :m], cost[m:, m:], cost[:m, m:])
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ConfigurationError(
                f"the cost beyond the horizon has no Riccati solution here: {error}",
                where=_KEY,
                remedy="choose a point with both rotors turning, a weight on inputs or moves, "
                "or terminal=none",
            ) from error
        values, vectors = np.linalg.eigh((P + P.T) / 2)
        _, root = np.linalg.qr(np.sqrt(values.clip(min=0.0))[:, None] * vectors.T)
        return root


def _riccati(
    F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray
) -> FloatArray:
    """Solution of the discrete Riccati equation, (n, n).

    A mode that neither moves by itself nor by an input (a cable's memory) lies on the unit circle:
    whether there is a solution then hangs on rounding. What comes later is discounted by a
    millionth a period there.

    Raises LinAlgError or ValueError if there is none.
    """
    from scipy.linalg import solve_discrete_are

    try:
        P = solve_discrete_are(F, G, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError):
        P = solve_discrete_are((1 - _DISCOUNT) * F, (1 - _DISCOUNT) * G, Q, R, s=S)
    return np.asarray(P)


class LinearMpcState(NewtonMpcState):
    """What changes during a run in NumPy: besides the plan, the linear model."""

    problem: LinearProblem

    def __init__(self, config: LinearMpc, setup: ControlSetup) -> None:
        super().__init__(config, setup)
        self._way: Way = config.linearisation
        self._slopes = BufferedFunction(self.discrete.slopes())
        self._operating = self._of_target = (self.problem.A, self.problem.B)
        self._linearised_for = self.problem.operating_input
        self._target: Target | None = None
        self._at_target = self._full.copy()
        self.newton.horizon.arguments["root"][...] = self.problem.root

    def prepare_model(self) -> None:
        """The linear model of this sample; see ``linear.c``."""
        target, arguments = self.target, self.newton.horizon.arguments
        assert target is not None
        if target is not self._target:
            self._target, self._at_target = target, self.discrete.initial(target.x, target.u)
            arguments["centre"][:] = np.concatenate([self._at_target, target.u])
        x, u, after = self._at_target, target.u, self._at_target  # a steady state
        A, B = self._operating
        if self._way == "target":
            if np.abs(target.u - self._linearised_for).max() > _SAME_TARGET:
                self._of_target = self._slopes_at(x, u)[1] or self._operating
                self._linearised_for = target.u
            A, B = self._of_target
        elif self._way == "current":
            here, model = self._slopes_at(self._full, self._last_command)
            if model is not None:
                (A, B), after, x, u = model, here, self._full, self._last_command
        drift = after - A @ x - B @ u
        arguments["p"][:] = np.concatenate([A.ravel(), B.ravel(), drift])

    def _slopes_at(
        self, x: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray] | None]:
        """The state after x and u, and A and B there; None for what must not be used."""
        after, A, B = (
            value.copy()
            for value in self._slopes.evaluate(
                x, u, self.model.parameters.values, self._disturbance
            )
        )
        B = B.reshape(len(x), -1)  # a single input's comes as a vector
        usable = np.isfinite(A).all() and np.isfinite(B).all()
        usable = usable and (self.problem.effect(A, B) >= self.problem.least_effect).all()
        return after, ((A, B) if usable else None)


class GivenModelState(LinearMpcState):
    """Likewise, with a model that a law derived from this one makes in the place of the slopes.

    It stands in ``_operating`` and may change at each sample; the prediction from the present is
    the nonlinear model's all the same.
    """

    def _slopes_at(
        self, x: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
        p, w = self.model.parameters.values, self._disturbance
        return self._step.evaluate(x, u, p, w)[0].ravel().copy(), self._operating


def linear_steps(discrete: DiscreteModel) -> DiscreteModel:
    """The same states with ``x⁺ = A x + B u + δ``; p is A and B, row by row, then δ."""
    n, n_u = discrete.n_x, discrete.model.n_u
    x, u, w = ca.SX.sym("x", n), ca.SX.sym("u", n_u), ca.SX.sym("w", discrete.model.n_w)
    p = ca.SX.sym("p", n * (n + n_u + 1))
    A = ca.reshape(p[: n * n], n, n).T
    B = ca.reshape(p[n * n : n * (n + n_u)], n_u, n).T
    after = A @ x + B @ u + p[n * (n + n_u) :]
    step = ca.Function("step", [x, u, p, w], [after], ["x", "u", "p", "w"], ["x_next"])
    return replace(discrete, step=step, parts=(step,), runge_kutta_steps=0)
