"""Tube MPC: the tube holds, tightened limits are honoured, and without errors it is linear MPC."""

from typing import Any

import numpy as np
import pytest

from trms_cli.code_generation.export import check_exportable
from trms_cli.controllers.controller import ControlSample, Status
from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.tube_mpc import LEFT, WIDE, TubeMpc
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import DoubleMass, close_loop, sample_of, setup_of, squares, state_with

MODEL = Newtonian()
MASSES = DoubleMass(limit=4.0)
ON_MASSES: dict[str, Any] = {
    "sample_time": 0.2,
    "prediction_horizon": 20,
    "move_blocks": (1,) * 10 + (2,) * 5,
    "state_weights": {"p1": 1.0, "p2": 1.0},
    "rate_weights": {},
    "move_weights": {"f1": 0.01, "f2": 0.01},
    "soft_limits": {"p1": (-2.0, 0.5)},
}
ON_RIG: dict[str, Any] = {"soft_limits": {"alpha_v": (-0.9, 0.25)}}
#: Standard deviations of the estimate: about what the UKF has when it has settled.
SD = {"alpha_v": 3e-4, "alpha_h": 3e-4, "S_v": 4e-3, "S_h": 4e-3, "omega_v": 0.5, "omega_h": 0.5}
TORQUE_SD = np.array([4e-3, 1e-3, 0.0, 0.0])


def with_errors(
    law: Any, model: Model, goal: Any, seconds: float, sd: Any, torque_sd: Any, sigma: float = 2.0
) -> tuple[Any, np.ndarray, list[Any], np.ndarray]:
    """A loop whose estimate errs by any amount within its bounds, for long to one side.

    The law's state, the rig's states (n, n_x), the commands, and how far the rig is from the
    nominal state as a share of the tube, (n, n_x).
    """
    rng = np.random.default_rng(3)
    state = law.init(setup_of(model, law.sample_time))
    step = state._step
    x = state.discrete.initial(model.rest(), np.zeros(model.n_u))
    u, states, commands, shares = np.zeros(model.n_u), [], [], []
    bound, push_bound = sigma * np.asarray(sd), sigma * np.asarray(torque_sd)
    side, push = bound, push_bound
    for k in range(round(seconds / law.sample_time)):
        if k % 15 == 0:
            side, push = (b * rng.choice([-1.0, 1.0], len(b)) for b in (bound, push_bound))
        error = side if k % 2 else bound * rng.uniform(-1.0, 1.0, len(bound))
        estimate = Estimate(
            x[: model.n_x] - error, np.asarray(sd), np.zeros(model.n_w), np.asarray(torque_sd)
        )
        command = law.step(
            state, ControlSample(0.0, np.array([goal]), estimate, u), want_prediction=False
        )
        u = command.u
        states.append(x[: model.n_x].copy())
        commands.append(command)
        x = step.evaluate(x, u, model.parameters.values, push)[0].ravel().copy()
        if isinstance(law, TubeMpc):
            shares.append((np.abs(x - state.nominal) / state.widths)[: model.n_x])
    return state, np.array(states), commands, np.array(shares)


def test_the_rig_stays_in_the_tube_and_within_a_limit_that_the_nominal_law_breaks() -> None:
    """A linear rig, where the tube is exact."""
    sd, torque_sd = [0.01, 0.02, 0.01, 0.02], [0.05, 0.05]
    case = (MASSES, [0.5, 0.0], 40.0, sd, torque_sd)
    _, states, commands, shares = with_errors(TubeMpc(**ON_MASSES), *case)
    assert all(command.status is Status.OK for command in commands)
    assert not any(LEFT in command.message or WIDE in command.message for command in commands)
    # From the first sample on, whose nominal state is the estimate.
    assert shares.max() <= 1.0
    assert shares.max() > 0.3  # it is no wider than it has to be by far
    assert states[:, 0].max() <= 0.5
    assert states[-50:, 0].max() > 0.35
    _, broken, _, _ = with_errors(LinearMpc(qp=Daqp(), **ON_MASSES), *case)
    assert broken[:, 0].max() > 0.52


def test_a_limit_of_the_rig_is_honoured_where_the_nominal_law_breaks_it() -> None:
    sd = [SD[name] for name in MODEL.state_names]
    case = (MODEL, [0.25, 0.5], 25.0, sd, TORQUE_SD)
    law = TubeMpc(**ON_RIG)
    state, states, commands, _ = with_errors(law, *case)
    pitch = MODEL.state_index("alpha_v")
    assert all(command.status is Status.OK for command in commands)
    assert states[:, pitch].max() <= 0.25
    assert states[-80:, pitch].mean() > 0.25 - 2.0 * state.widths[pitch]
    _, broken, _, _ = with_errors(LinearMpc(qp=Daqp(), **ON_RIG), *case)
    assert broken[:, pitch].max() > 0.2505


def test_the_tube_is_the_least_invariant_set_of_its_errors() -> None:
    """Of the worst sequence of errors: the sum that defines the width is reached."""
    state = TubeMpc(**ON_MASSES).init(setup_of(MASSES, 0.2))
    A, B, K = state.problem.A, state.problem.B, state.gain
    closed, bound = A + B @ K, np.array([0.01, 0.02, 0.01, 0.02])
    widths = state._of_states[:, :4] @ bound
    row, count = 0, 400
    powers = [np.linalg.matrix_power(closed, i) for i in range(count)]
    e = np.zeros(4)
    for i in reversed(range(count)):
        worst = -np.sign((powers[i] @ B @ K)[row]) * bound
        e = closed @ e - B @ K @ worst
    assert e[row] == pytest.approx(widths[row], rel=1e-6)
    # One period leaves it where it is: the set is invariant.
    once = np.abs(B @ K) @ bound
    assert (widths >= once - 1e-12).all()


def test_without_errors_it_is_linear_mpc() -> None:
    reference = squares(MODEL, 2.0)
    ran, equal = (
        close_loop(law, MODEL, reference, 6.0) for law in (TubeMpc(), LinearMpc(qp=Daqp()))
    )
    np.testing.assert_allclose(ran.inputs, equal.inputs, atol=1e-9)
    assert not any(command.message for command in ran.commands)


def test_a_filter_that_knows_little_yet_leaves_room_to_plan_and_it_is_said() -> None:
    law = TubeMpc(**ON_RIG)
    state: Any = law.init(setup_of(MODEL))
    lower, upper = MODEL.input_bounds()
    widths = []
    for share in (1e3, 1.0):
        sample = sample_of(MODEL, [0.2, 0.5])
        sample.estimate.sd[:] = share * np.array([SD[name] for name in MODEL.state_names])
        command = law.step(state, sample, want_prediction=False)
        widths.append(state.newton.upper - state.newton.lower)
        assert (WIDE in command.message) is (share > 1.0)
    np.testing.assert_allclose(widths[0], 0.5 * (upper - lower))
    assert (widths[1] > 0.75 * (upper - lower)).all()


def test_a_rig_that_is_thrown_out_of_the_tube_is_planned_for_anew() -> None:
    law = TubeMpc()
    state: Any = law.init(setup_of(MODEL))
    sd = np.array([SD[name] for name in MODEL.state_names])
    for alpha, left in ((0.0, False), (0.3, True)):
        sample = sample_of(MODEL, [0.0, 0.5], state_with(MODEL, alpha_v=alpha))
        sample.estimate.sd[:] = sd
        command = law.step(state, sample, want_prediction=False)
        assert (LEFT in command.message) is left
    assert command.status is Status.OK


def test_process_noise_widens_the_tube_and_unknown_names_are_refused() -> None:
    narrow, wide = (
        TubeMpc(process_noise=noise).init(setup_of(MODEL)) for noise in ({}, {"omega_v": 3.0})
    )
    estimate = sample_of(MODEL, [0.0, 0.5]).estimate
    less, more = ((s._of_states @ s._bounds(estimate)) for s in (narrow, wide))
    assert not less.any() and (more > 0.0).all()
    for options in ({"process_noise": {"lift": 1.0}}, {"feedback_weights": {"u": 1.0}}):
        with pytest.raises(ConfigurationError):
            TubeMpc(**options).init(setup_of(MODEL))  # type: ignore[arg-type]


def test_the_engine_of_linear_mpc_is_not_exported_in_its_name() -> None:
    with pytest.raises(ConfigurationError, match="has no C source"):
        check_exportable(TubeMpc())
