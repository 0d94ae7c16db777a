"""Linear Kalman filter of the model linearised at an operating point.

    z⁺ = z₀⁺ + A (z − z₀) + B (u − u₀) + G w        y = y₀ + C (z − z₀) + D (u − u₀)

the baseline that the others are measured against: right where the rig stays near the point, wrong
away from it. R. E. Kalman 1960, "A new approach to linear filtering and prediction problems".

Away from the point the estimated torques also hold what the linear model says wrongly of thrusts
and gravity. A controller that adds them to the *nonlinear* model would count that twice, and may
be driven off by it (newton_mpc was, from rest). The torques that the estimate tells are therefore
those that make the nonlinear model move, from the estimated state, as the linear one does.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.linearisation import Linearisation
from trms_cli.models.state_kinds import kinds_of_states
from trms_cli.models.steady_state import SteadyState
from trms_cli.observers.augmentation import Augmentation, augment
from trms_cli.observers.kalman_step import exact_measurement, exact_transition, kalman_step
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterState, RecursiveFilter

#: Samples within which a covariance settles that settles at all: half an hour at 50 Hz.
_MOST_SAMPLES = 100_000
_SETTLED = 1e-12
#: Kinds of states that torques push.
_PUSHED = ("momentum", "rotor", "speed")
_FAINT = 1e-9


@dataclass(frozen=True, kw_only=True)
class Kalman(RecursiveFilter):
    """Linear Kalman filter; other fields are those of
    :class:`trms_cli.observers.augmentation.FilterOptions`.
    """

    #: Controlled angles, rad, at which the rig rests and the model is linearised; 0 where none is
    #: given
    operating_point: Mapping[str, float] = field(default_factory=dict)
    #: Whether the covariance starts from ``initial_sd``, or is, from the first prediction on, that
    #: of a filter that has run for long. A steady one does not widen while samples are missing.
    gain: Literal["varying", "steady"] = "varying"

    def compose(
        self, setup: ObserverSetup, augmented: Augmentation
    ) -> tuple[ca.Function, FloatArray]:
        model = setup.model
        linearisation = Linearisation(model, setup.sample_time, SteadyState(model))
        linear = linearisation.at(self.operating_point, "observer.operating_point")
        # The linearisation's model glides: dry friction would hold an axis that rests.
        smooth = augment(replace(setup, model=linear.discrete.model), self)
        x_0, u_0 = linear.target.x, linear.target.u
        settled = smooth.discrete.initial(x_0, u_0)
        z_0 = np.concatenate([settled[: smooth.n_s], np.zeros(len(smooth.equations))])
        coefficients = _coefficients(smooth)(
            z_0, settled[smooth.n_s :], u_0, model.parameters.values
        )
        step = kalman_step("kalman_step", augmented, *_linear_stages(augmented, coefficients))
        parts = [np.array(part).ravel(order="F") for part in coefficients]
        return step, np.concatenate([*parts, model.parameters.values])

    def init(self, setup: ObserverSetup) -> FilterState:
        state = super().init(setup)
        if self.gain == "steady":
            state.settled = _settled_covariance(state)
        return state


def _coefficients(smooth: Augmentation) -> ca.Function:
    """``(z, memory, u, p) →`` coefficients of a sample and of the measurement there.

    In the order in which :func:`_linear_stages` reads them: next z less its linear part, ∂z⁺/∂(z,
    memory, u, w_known), next memory likewise, ∂memory⁺/∂(memory, u), y likewise, ∂y/∂(z, u).
    """
    z, memory, u, p, w_known = smooth.symbols(ca.MX)
    after, A, remembered = exact_transition(smooth)(z, memory, u, p, w_known)
    y, C = exact_measurement(smooth)(z, u, p)
    by_memory, by_u, by_w = (ca.jacobian(after, v) for v in (memory, u, w_known))
    memory_slope, input_slope = (ca.jacobian(remembered, v) for v in (memory, u))
    D = ca.jacobian(y, u)
    results = [
        *(after - A @ z - by_memory @ memory - by_u @ u, A, by_memory, by_u, by_w),
        *(remembered - memory_slope @ memory - input_slope @ u, memory_slope, input_slope),
        *(y - C @ z - D @ u, C, D),
    ]
    dense = ca.Function("here", [z, memory, u, p, w_known], [ca.densify(part) for part in results])
    at = [ca.MX.sym(name, *dense.size_in(i)) for i, name in enumerate(["z", "memory", "u", "p"])]
    return ca.Function("coefficients", at, dense.call([*at, ca.MX.zeros(*dense.size_in(4))]))


def _linear_stages(
    augmented: Augmentation, coefficients: list[ca.DM]
) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Transition, measurement and restated torques, with their coefficients as parameters.

    So the compiled code is the same whatever the rig's figures and the operating point are.
    """
    z, memory, u, own, w_known = augmented.symbols()
    count = sum(part.numel() for part in coefficients)
    p = ca.SX.sym("p", count + own.numel())
    ends = np.cumsum([0, *(part.numel() for part in coefficients)]).tolist()
    shift, A, M, B, G, memory_shift, memory_slope, input_slope, y_0, C, D = (
        ca.reshape(p[begin:end, 0], *part.shape)
        for part, begin, end in zip(coefficients, ends[:-1], ends[1:], strict=True)
    )
    after = shift + A @ z + M @ memory + B @ u + G @ w_known
    remembered = memory_shift + memory_slope @ memory + input_slope @ u
    at = [z, memory, u, p, w_known]
    transition = ca.Function("transition", at, [ca.densify(v) for v in (after, A, remembered)])
    y = y_0 + C @ z + D @ u
    measurement = ca.Function("measure", [z, u, p], [ca.densify(y), ca.densify(C)])
    restate = ca.Function(
        "restate", at, [_restated(augmented, after, z, memory, u, p[count:, 0], w_known)]
    )
    return transition, measurement, restate


def _restated(
    augmented: Augmentation,
    after: ca.SX,
    z: ca.SX,
    memory: ca.SX,
    u: ca.SX,
    p: ca.SX,
    w_known: ca.SX,
) -> ca.SX:
    """z with the torques for which the model moves as the linear one, in what they push."""
    if not augmented.equations:
        return z
    n_s, model = augmented.n_s, augmented.model
    follows = exact_transition(augmented)(z, memory, u, p, w_known)
    pushed = [i for i, kind in enumerate(kinds_of_states(model)) if kind in _PUSHED]
    slope = follows[1][pushed, n_s:]
    missing = (after - follows[0])[pushed]
    scale = ca.DM(1.0 / augmented.sd[pushed])
    slope, missing = ca.diag(scale) @ slope, scale * missing
    normal = slope.T @ slope
    # A torque that pushes nothing here (one inside a stuck rotor) stays as it is.
    faint = _FAINT * ca.trace(normal) * ca.SX.eye(normal.shape[0])
    return ca.vertcat(z[:n_s, 0], z[n_s:, 0] + ca.solve(normal + faint, slope.T @ missing))


def _settled_covariance(state: FilterState) -> FloatArray:
    """The covariance after a sample that the next sample leaves as it is, (n, n).

    Found by running the filter's own step: of a linear filter it depends on no measurement.

    Raises ConfigurationError if it grows without end: something that is estimated leaves no trace
    in what is measured.
    """
    function = state.function
    before = [value.copy() for value in function.inputs]
    _, covariance, _, _, _, mask, advance = function.inputs[:7]
    after = function.outputs[1]
    mask[:] = advance[:] = 1.0
    function.inputs[-1][:] = np.inf
    settled = None
    for _ in range(_MOST_SAMPLES):
        function()
        scale = np.sqrt(np.outer(np.diag(after), np.diag(after)))
        if np.max(np.abs(after - covariance) / scale) < _SETTLED:
            settled = after.copy()
            break
        covariance[...] = after
    for value, old in zip(function.inputs, before, strict=True):
        value[...] = old
    if settled is None:
        raise ConfigurationError(
            "the covariance does not settle: a state or a disturbance that is estimated cannot be "
            "told from what is measured",
            where="observer.gain",
            remedy="gain=varying, or fewer observer.disturbances",
        )
    return settled
