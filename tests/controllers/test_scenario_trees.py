"""Linear MPC over trees of scenarios: of parameters (multistage), of torques (min–max)."""

from typing import Any

import numpy as np
import pytest

from trms_cli.code_generation.export import check_exportable
from trms_cli.controllers.controller import Status
from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.min_max_mpc import MinMaxMpc
from trms_cli.controllers.scenario_tree import Outlook
from trms_cli.controllers.scenario_tree_mpc import ScenarioTreeMpc
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import DoubleMass, Ran, close_loop, constant, sample_of, setup_of, state_with

MODEL = Newtonian()
HEAVY = Newtonian(parameters={name: 2 * MODEL.parameters[name].value for name in ("J_mr", "J_tr")})
SHORT: dict[str, Any] = {"prediction_horizon": 40, "move_blocks": (1, 1, 1, 1, 2, 2, 4, 4, 8, 16)}
LIMITED: dict[str, Any] = {**SHORT, "soft_limits": {"alpha_v": (-0.6, 0.25)}}
AT_THE_LIMIT = constant(0.25, 0.3)
LAWS: list[Any] = [
    ScenarioTreeMpc(**SHORT),
    ScenarioTreeMpc(robust_horizon=2, **SHORT),
    MinMaxMpc(**SHORT),
]


def nominal(**keys: Any) -> LinearMpc:
    return LinearMpc(qp=Daqp(), **keys)


def beyond(ran: Ran) -> float:
    """How far pitch was above its limit, rad."""
    assert all(command.status is Status.OK for command in ran.commands)
    return float(ran.angles[:, 0].max() - 0.25)


@pytest.mark.parametrize("law", LAWS, ids=["tree", "deep tree", "min-max"])
def test_a_known_torque_leaves_no_offset(law: Any) -> None:
    push = np.array([0.004, 0.0, 0.0, 0.0])
    ran = close_loop(
        law, MODEL, constant(0.2, 0.5), 14.0, torque=lambda t: push * (t > 1), known=True
    )
    np.testing.assert_allclose(ran.errors[-1], 0.0, atol=4e-3)


def test_without_uncertainty_it_is_linear_mpc() -> None:
    limits = {**LIMITED, "input_rate_limits": {"u_v": 6.0}}
    tree = ScenarioTreeMpc(spread=1e-6, robust_horizon=2, **limits)
    no_torque = MinMaxMpc(torques={"pitch_moment": 1e-9}, **SHORT)
    for law, keys, near in ((tree, limits, 1e-4), (no_torque, SHORT, 2e-3)):
        ran, equal = (close_loop(each, MODEL, AT_THE_LIMIT, 3.0) for each in (law, nominal(**keys)))
        np.testing.assert_allclose(ran.inputs, equal.inputs, atol=near)


def test_a_limit_is_honoured_by_heavier_rotors_where_the_nominal_law_breaks_it() -> None:
    limits = {"soft_limits": LIMITED["soft_limits"]}
    assert beyond(close_loop(ScenarioTreeMpc(**limits), MODEL, AT_THE_LIMIT, 8.0, rig=HEAVY)) <= 0.0
    assert beyond(close_loop(nominal(**limits), MODEL, AT_THE_LIMIT, 8.0, rig=HEAVY)) > 1e-4


@pytest.mark.parametrize("size", [0.005, 0.02])
def test_a_limit_is_honoured_under_torques_where_the_nominal_law_breaks_it(size: float) -> None:
    """Unknown to the estimate, within the torques that are counted with."""

    def push(time: float) -> np.ndarray:
        return np.array([size * (time % 4.0 < 2.0), 0.0, 0.0, 0.0])

    law = MinMaxMpc(torques={"pitch_moment": size}, **LIMITED)
    assert beyond(close_loop(law, MODEL, AT_THE_LIMIT, 8.0, torque=push)) <= 1e-5
    broken = beyond(close_loop(nominal(**LIMITED), MODEL, AT_THE_LIMIT, 8.0, torque=push))
    assert broken > 0.05 * size


@pytest.mark.parametrize("law", LAWS, ids=["tree", "deep tree", "min-max"])
def test_inputs_are_equal_while_the_past_is(law: Any) -> None:
    tree = law.init(setup_of(MODEL)).tree
    n_u = MODEL.n_u
    for i, one in enumerate(tree.scenarios):
        for k, other in enumerate(tree.scenarios):
            for block in range(tree.horizon.n_blocks):
                at = slice(block * n_u, (block + 1) * n_u)
                is_one = bool((tree.columns[i][at] == tree.columns[k][at]).all())
                assert is_one == (one[:block] == other[:block])


def test_the_condensed_cost_is_that_of_the_horizon() -> None:
    law = ScenarioTreeMpc(**SHORT)
    state: Any = law.init(setup_of(MODEL))
    x = state_with(MODEL, alpha_v=-0.1, alpha_h=0.1)
    law.step(state, sample_of(MODEL, [0.2, 0.5], x), want_prediction=False)
    newton, target = state.newton, state.target
    outlook = Outlook(state._full, newton.reference, target.x, target.u, state._last_command)
    scenario = state.tree.scenario(0, state.branches(), outlook)
    plan = np.random.default_rng(1).uniform(-1.0, 1.0, newton.plan.shape)
    newton.merit(plan)
    trajectory, _, objective, *_ = newton.horizon.evaluate.outputs
    z = plan.ravel(order="F")
    cost = np.square(scenario.root @ z + scenario.rest).sum()
    assert cost == pytest.approx(float(objective[0]), rel=1e-9)
    states = scenario.trajectory[:, :, :-1] @ z + scenario.trajectory[:, :, -1]
    np.testing.assert_allclose(states.T, trajectory, rtol=1e-9, atol=1e-9)


def test_the_worst_cost_is_no_higher_than_that_of_any_other_plan() -> None:
    law = MinMaxMpc(torques={"pitch_moment": 0.02}, **SHORT)
    state: Any = law.init(setup_of(MODEL))
    command = law.step(state, sample_of(MODEL, [0.2, 0.5]), want_prediction=False)
    newton, target = state.newton, state.target
    outlook = Outlook(state._full, newton.reference, target.x, target.u, state._last_command)
    branches = state.branches()
    scenarios = [state.tree.scenario(i, branches, outlook) for i in range(len(branches))]
    z = state.optimise(scenarios).z

    def worst(z: np.ndarray) -> float:
        return max(float(np.square(s.root @ z[s.columns] + s.rest).sum()) for s in scenarios)

    assert command.objective == pytest.approx(worst(z), rel=1e-6)
    rng, (low, high) = np.random.default_rng(2), state.bounds()
    for size in (1e-3, 1e-2, 0.1):
        for _ in range(100):
            other = np.clip(z + size * rng.standard_normal(len(z)), low, high)
            # The mean of all costs counts besides, by a thousandth.
            assert worst(other) > worst(z) * (1.0 - 1e-3)


def test_the_sets_are_the_models_own_and_as_far_off_as_is_asked_along_a_direction() -> None:
    state = ScenarioTreeMpc(spread=1.5, directions=2, **SHORT).init(setup_of(MODEL))
    own = MODEL.parameters.values
    sd = np.array([(p.prior_sd or 0.0) * abs(p.value) for p in MODEL.parameters])
    assert state.sets.shape == (5, len(own))
    np.testing.assert_array_equal(state.sets[0], own)
    off = (state.sets[1:] - own)[:, sd > 0] / sd[sd > 0]
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 1.5, rtol=1e-6)
    np.testing.assert_allclose(off[0], -off[1], atol=1e-9)
    assert abs(off[0] @ off[2]) < 1e-6


@pytest.mark.parametrize(
    ("law", "model", "where"),
    [
        (ScenarioTreeMpc(robust_horizon=3, directions=4, **SHORT), MODEL, "controller.robust_h"),
        (ScenarioTreeMpc(move_blocks=(2,) * 10), MODEL, "controller.move_blocks"),
        (ScenarioTreeMpc(state_weights={"p1": 1.0}), DoubleMass(), "controller"),
        (MinMaxMpc(torques={"lift": 0.1}), MODEL, "controller.torques.lift"),
        (MinMaxMpc(torques={"yaw_moment": 0.0}), MODEL, "controller.torques"),
    ],
)
def test_what_cannot_be_is_refused(law: Any, model: Any, where: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        law.init(setup_of(model))
    assert caught.value.where.startswith(where)


@pytest.mark.parametrize("law", [ScenarioTreeMpc(), MinMaxMpc()], ids=["tree", "min-max"])
def test_the_engine_of_linear_mpc_is_not_exported_in_their_name(law: Any) -> None:
    with pytest.raises(ConfigurationError, match="has no C source"):
        check_exportable(law)
