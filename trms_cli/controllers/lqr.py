"""Linear quadratic regulator with integral action.

The model is linearised at an operating point (with ω_h ≠ 0: the yaw is uncontrollable where the
tail rotor stands still) and discretised. With Δx = x − x_s the distance to the steady state at the
reference, and ξ the integral of the controlled angles' errors,

    minimise  Σ_k  Δxᵀ Q Δx + ξᵀ Q_i ξ + Δuᵀ R Δu        u = u_s − K Δx − K_i ξ

The steady state (x_s, u_s) is that of the nonlinear model at the reference and at the estimated
disturbance; the integral supplies what neither knows.

When the reference moves, ξ jumps to where the cost to go is least, ξ = −P_ii⁻¹ P_ix Δx, with P of
the Riccati equation: without that, the error of every transient is integrated and paid back as
overshoot. Written with the plain integral z it is ``ξ = z + P_ii⁻¹ P_ix x_s``, so that no event
has to be detected.

Source: Anderson & Moore, "Optimal Control: Linear Quadratic Methods", 1990.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from trms_cli.controllers.controller import (
    Command,
    ControlSample,
    ControlSetup,
    Delay,
    PresentReference,
)
from trms_cli.controllers.fallback import NOT_FINITE, are_finite, hold_command
from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.discretisation import DiscreteModel
from trms_cli.models.linearisation import Linearisation, LinearModel, require_drivable
from trms_cli.models.model import names
from trms_cli.models.state_scales import bench_ratios
from trms_cli.models.steady_state import SteadyState, Target


@dataclass(frozen=True)
class Regulator:
    """The gains of one design."""

    K: FloatArray  #: (n_u, n) array; on the state, memory of the input path included
    K_i: FloatArray  #: (n_u, n_r) array; on the integral
    M: FloatArray  #: (n_r, n) array; ``P_ii⁻¹ P_ix``
    unwind: FloatArray  #: (n_r, n_u) array; integral by which a volt beyond the limit is taken back


@dataclass
class LqrState:
    """The design, and what is remembered."""

    regulator: Regulator
    linear: LinearModel  #: What it was designed for
    steady: SteadyState
    #: Memory of the input path over one period; None for a model without
    advance_memory: BufferedFunction | None
    integral: FloatArray  #: (n_r,) array; z, rad s
    memory: FloatArray  #: (n_m,) array; memory of the input path after the commands so far
    target: Target  #: The steady state that is regulated to
    target_memory: FloatArray  #: (n_m,) array; memory in that state
    rows: list[int]  #: Positions of the controlled angles in x
    lower: FloatArray  #: Of the inputs, (n_u,), V
    upper: FloatArray  #: (n_u,), V
    period: float  #: T, s
    has_started: bool = False  #: Whether there was a sample yet


@dataclass(frozen=True, kw_only=True)
class Lqr(PresentReference):
    """Linear quadratic regulator with integral action."""

    #: Controlled angles at which the model is linearised, rad
    operating_point: Mapping[str, float] = field(default_factory=lambda: {"alpha_h": 0.5})
    #: Of the controlled angles, 1/rad²; 1/(error that is worth one volt)²
    output_weights: Mapping[str, Positive] = field(default_factory=dict)
    #: Of the controlled angles' rates, 1/(rad/s)²
    rate_weights: Mapping[str, NotNegative] = field(default_factory=dict)
    #: Of the integrals of the controlled angles' errors, 1/(rad s)²
    integral_weights: Mapping[str, Positive] = field(default_factory=dict)
    input_weights: Mapping[str, Positive] = field(default_factory=dict)  #: 1/V²
    use_disturbance: bool = True  #: Whether the steady state is that at the estimated disturbance
    tracking_time: Positive = 1.0  #: How fast the integral unwinds at a limit, s
    sample_time: Positive | None = None  #: Control period, s; None takes every sample
    delay: Delay = "none"

    def init(self, setup: ControlSetup) -> LqrState:
        model = setup.model
        steady = SteadyState(model)
        key = "controller.operating_point"
        linear = Linearisation(model, setup.sample_time, steady).at(self.operating_point, key)
        require_drivable(linear, key)
        lower, upper = model.input_bounds()
        memory = linear.discrete.initial(model.rest(), setup.first_command)[model.n_x :]
        return LqrState(
            self.designed(linear),
            linear,
            steady,
            _memory_function(linear.discrete) if memory.size else None,
            np.zeros(len(model.controlled)),
            memory,
            linear.target,
            memory.copy(),
            [model.state_index(name) for name in model.controlled],
            lower,
            upper,
            setup.sample_time,
        )

    def designed(self, linear: LinearModel) -> Regulator:
        """Solve the Riccati equation of the model augmented by the integrals.

        Raises ConfigurationError for weights of names that the model does not have, or if there is
        no solution.
        """
        from scipy.linalg import solve_discrete_are

        model, T = linear.discrete.model, linear.step_length
        n, n_r, n_u = linear.A.shape[0], len(model.controlled), model.n_u
        A = np.eye(n + n_r)
        A[:n, :n], A[n:, :n] = linear.A, T * linear.C
        B = np.vstack([linear.B, np.zeros((n_r, n_u))])
        rates = (linear.C @ linear.A - linear.C) / T
        ratios = bench_ratios(model)
        errors = ratios.states[[model.state_index(name) for name in model.controlled]] ** -2.0
        usual = 100.0 * errors, 30.0 * ratios.time**2 * errors, 20.0 * ratios.time**-2 * errors
        outputs = in_order(self.output_weights, model.controlled, usual[0], "output_weights")
        smooth = in_order(self.rate_weights, model.controlled, usual[1], "rate_weights")
        integrals = in_order(self.integral_weights, model.controlled, usual[2], "integral_weights")
        Q = np.zeros((n + n_r, n + n_r))
        Q[:n, :n] = linear.C.T * outputs @ linear.C + rates.T * smooth @ rates
        Q[n:, n:] = np.diag(integrals)
        r = in_order(self.input_weights, names(model.inputs), ratios.inputs**-2.0, "input_weights")
        try:
            P = solve_discrete_are(A, B, T * Q, T * np.diag(r))
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ConfigurationError(
                f"the Riccati equation has no solution here: {error}",
                where="controller.operating_point",
                remedy="choose a point with both rotors turning, and weights closer to each other",
            ) from error
        gain = np.linalg.solve(T * np.diag(r) + B.T @ P @ B, B.T @ P @ A)
        K, K_i = gain[:, :n], gain[:, n:]
        return Regulator(
            np.ascontiguousarray(K),
            np.ascontiguousarray(K_i),
            np.linalg.solve(P[n:, n:], P[n:, :n]),
            np.linalg.pinv(K_i) * min(1.0, T / self.tracking_time),
        )

    def step(self, state: LqrState, sample: ControlSample, *, want_prediction: bool) -> Command:
        estimate, previous = sample.estimate, sample.previous_command
        reference = sample.reference[0]
        w = estimate.disturbance
        if not are_finite(estimate.x, w, reference):
            return hold_command(previous, NOT_FINITE)
        message = self._aim(state, reference, w)
        x, x_s, target = estimate.x, state.target.x, state.target
        if state.advance_memory is not None:
            if state.has_started:
                state.memory[:] = state.advance_memory.evaluate(state.memory, previous)[0]
            x = np.concatenate([x, state.memory])
            x_s = np.concatenate([x_s, state.target_memory])
        law = state.regulator
        if not state.has_started:
            state.has_started = True
            state.integral = -law.M @ x
        xi = state.integral + law.M @ x_s
        v = target.u - law.K @ (x - x_s) - law.K_i @ xi
        u = np.minimum(np.maximum(v, state.lower), state.upper)
        error = estimate.x[state.rows] - target.reference_reached
        state.integral = state.integral + state.period * error + law.unwind @ (v - u)
        return Command(u, message=message, out_of_reach=target.projected)

    def _aim(self, state: LqrState, reference: FloatArray, w: FloatArray) -> str:
        """Move the target; a word if the reference cannot be reached."""
        target = state.steady.solve(reference, w if self.use_disturbance else None, state.target)
        if not target.converged:
            return "nothing holds the rig at the estimated disturbance; the last target stays"
        state.target = target
        if state.advance_memory is not None:
            for _ in range(state.memory.size):
                state.target_memory[:] = state.advance_memory.evaluate(
                    state.target_memory, target.u
                )[0]
        return (
            "the reference is out of reach; the closest is the target" if target.projected else ""
        )


def _memory_function(discrete: DiscreteModel) -> BufferedFunction:
    """``(memory, u) → memory⁺``; it does not depend on the rest of the state."""
    model = discrete.model
    memory = ca.SX.sym("memory", discrete.n_x - model.n_x)
    u = ca.SX.sym("u", model.n_u)
    p = ca.DM(model.parameters.values)
    after = discrete.step(ca.vertcat(ca.SX.zeros(model.n_x), memory), u, p, ca.DM.zeros(model.n_w))
    return BufferedFunction(ca.Function("memory_step", [memory, u], [after[model.n_x :]]))


def in_order(
    weights: Mapping[str, float], names: tuple[str, ...], default: float | FloatArray, key: str
) -> FloatArray:
    """Weights in the order of ``names``, shape (len(names),), those not given by ``default``.

    Names of an axis that this model lacks are passed over, so that one configuration also serves
    the models of one axis.

    Raises ConfigurationError for any other name; ``key`` is where it stands in the controller's
    configuration.
    """
    everywhere = {"alpha_v", "alpha_h", "u_v", "u_h", *names}
    for name in weights:
        if name not in everywhere:
            words = f"{name!r} is not a name that a weight can have here"
            require_known(name, names, words, f"controller.{key}")
    usual = np.broadcast_to(default, len(names))
    return np.array([weights.get(name, value) for name, value in zip(names, usual, strict=True)])
