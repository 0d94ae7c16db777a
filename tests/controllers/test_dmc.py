"""Dynamic matrix control: what its responses predict, what it leaves, what it keeps to."""

from dataclasses import replace

import numpy as np
import pytest

from trms_cli.controllers.controller import Status
from trms_cli.controllers.dmc import Dmc, slowest_modes
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, QpResult
from trms_cli.models.discretisation import discretise
from trms_cli.models.linearisation import Linearisation
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState

from .closed_loop_case import (
    DoubleMass,
    close_loop,
    constant,
    sample_of,
    setup_of,
    squares,
    state_with,
)

BOTH = Newtonian()
#: Nothing pulls the yaw back: its angle integrates the moment, through a lag. The tail rotor is at
#: rest wherever the rig is, and only larger steps than of the slope tell its effect.
FREE_YAW = Newtonian(parameters={"k_chp": 0.0, "k_chn": 0.0})
FREE_LAW = Dmc(step_sizes={"u_h": 0.5}, move_weights={"u_h": 0.5}, operating_point={"alpha_v": 0.0})


def test_of_a_linear_model_the_responses_predict_what_it_does() -> None:
    """The angles now and later, from commands alone, and no disturbance is seen."""
    model, rng = DoubleMass(), np.random.default_rng(0)
    law = Dmc(model_horizon=600, operating_point={})
    state = law.init(setup_of(model))
    # As fine as the linearisation's, whose steps the responses are taken with.
    step = BufferedFunction(discretise(model, 0.1, 5).step)
    p, w, x = model.parameters.values, np.zeros(2), np.zeros(4)
    u = np.zeros(2)
    for _ in range(40):
        law.step(state, sample_of(model, [0.0, 0.0], x, u), want_prediction=False)
        np.testing.assert_allclose(state.free[:, 0], x[[0, 2]], atol=1e-9)
        u = rng.normal(size=2)
        x = step.evaluate(x, u, p, w)[0].ravel().copy()
    assert max(np.abs(d).max() for d in state.disturbance) < 1e-9
    law.step(state, sample_of(model, [0.0, 0.0], x, u), want_prediction=False)
    for k in range(40):
        np.testing.assert_allclose(state.free[:, k], x[[0, 2]], atol=1e-9)
        x = step.evaluate(x, u, p, w)[0].ravel().copy()


@pytest.mark.parametrize(
    ("model", "law"), [(BOTH, Dmc()), (FREE_YAW, FREE_LAW)], ids=["cable", "free yaw"]
)
def test_a_torque_that_nobody_tells_leaves_no_error(model: Newtonian, law: Dmc) -> None:
    push = np.array([0.004, 0.004, 0.0, 0.0])
    ran = close_loop(law, model, constant(0.2, 0.5), 60.0, torque=lambda time: push * (time > 10))
    assert np.abs(ran.errors[ran.at(10.0) : ran.at(12.0)]).max() > 0.003
    assert np.abs(ran.errors[-30:]).max() < 5e-3


def test_the_bias_alone_damps_no_swing() -> None:
    """What the disturbance's dynamics are for."""
    swings = []
    for kind in ("bias", "swing"):
        ran = close_loop(Dmc(disturbance=kind), BOTH, squares(BOTH), 60.0)
        swings.append(max(np.abs(error[-50:]).max() for error in ran.levels("alpha_v")))
    assert swings[1] < 0.03 and swings[0] > 5 * swings[1]


def test_an_angle_that_nothing_pulls_back_goes_on_with_its_last_slope() -> None:
    linear = Linearisation(FREE_YAW, 0.1, SteadyState(FREE_YAW)).at({"alpha_h": 0.5}, "here")
    modes = dict(zip(FREE_YAW.controlled, slowest_modes(linear), strict=True))
    assert abs(modes["alpha_h"] - 1.0) < 1e-9 and abs(modes["alpha_v"].imag) > 0.1
    law = replace(FREE_LAW, model_horizon=120)
    state = law.init(setup_of(FREE_YAW))
    x = state_with(FREE_YAW, alpha_h=0.5)
    row = FREE_YAW.controlled.index("alpha_h")
    for u in (np.zeros(2), np.array([0.0, 0.1]), np.array([0.0, 0.1])):
        law.step(state, sample_of(FREE_YAW, [0.0, 0.5], x, u), want_prediction=False)
    slopes = np.diff(state.free[row, -4:])
    assert slopes[0] > 1e-4
    np.testing.assert_allclose(slopes, slopes[0], rtol=0.02)


def test_commands_keep_their_rates_and_a_far_reference_is_said() -> None:
    law = Dmc(input_rate_limits={"u_v": 2.0})
    ran = close_loop(law, BOTH, squares(BOTH), 10.0)
    moves = np.abs(np.diff(ran.inputs, axis=0, prepend=0.0)).max(axis=0)
    assert moves[0] < 0.2 + 1e-9 < moves[1]
    state = law.init(setup_of(BOTH))
    answer = law.step(state, sample_of(BOTH, [0.0, 1e9]), want_prediction=False)
    assert answer.out_of_reach and answer.status is Status.OK


@pytest.mark.parametrize("policy", ["shifted_plan", "hold"])
def test_a_failed_solve_falls_back_as_declared(policy, monkeypatch) -> None:
    law = Dmc(fallback=policy)
    state = law.init(setup_of(BOTH))
    sample = sample_of(BOTH, [0.3, 0.5], u=np.array([1.0, -1.0]))
    law.step(state, sample, want_prediction=False)
    plan = state.plan.copy()
    lost = QpResult(np.zeros(0), False, 0, "made to fail")
    monkeypatch.setattr(Daqp, "solve", lambda *_: lost)
    answer = law.step(state, sample, want_prediction=False)
    assert answer.status is Status.FAILED and answer.fallback == policy
    expected = plan[:, 1] if policy == "shifted_plan" else sample.previous_command
    np.testing.assert_array_equal(answer.u, expected)


@pytest.mark.parametrize(
    ("options", "where"),
    [
        (
            {"operating_point": {"alpha_h": 0.0}, "step_sizes": {"u_h": 0.001}},
            "controller.operating_point",
        ),
        ({"output_weights": {"alpha": 1.0}}, "controller.output_weights"),
        ({"model_horizon": 20}, "controller.model_horizon"),
        ({"input_rate_limits": {"u_x": 1.0}}, "input_rate_limits.u_x"),
    ],
)
def test_mistakes_are_reported_by_key(options: dict, where: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Dmc(**options).init(setup_of(BOTH))
    assert caught.value.where == where
