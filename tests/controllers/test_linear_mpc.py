"""linear_mpc: the regulator without limits, the optimum with them, no offset, fall-backs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from closed_loop_case import SAMPLE_TIME, run
from linear_model import DoubleMass, matrices

from trms_cli.controllers.controller import ControlSample, ControlSetup, Status
from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.qp.osqp import Osqp
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.qp import QpResult
from trms_cli.effects.extended_model import extended
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

BOTH = Newtonian()
PERIOD = 0.1
WAYS = ["fixed", "target", "current"]
WEIGHTS: dict[str, Any] = {
    "state_weights": {"p1": 3.0, "p2": 2.0, "v1": 0.1},
    "rate_weights": {"p1": 0.5},
    "input_weights": {"f1": 0.2, "f2": 0.0},
    "move_weights": {"f1": 0.05, "f2": 0.3},
    "operating_point": {},
    "integration_steps": 5,
}


def setup_of(model: Model) -> ControlSetup:
    return ControlSetup(model, PERIOD, np.zeros(model.n_u))


def sample_of(
    x: np.ndarray, r: list[float], last: list[float], n_w: int, w: np.ndarray | None = None
) -> ControlSample:
    w = np.zeros(n_w) if w is None else w
    estimate = Estimate(x, np.zeros_like(x), w, np.zeros_like(w))
    return ControlSample(0.0, np.array([r]), estimate, np.array(last))


def dynamic_programming(model: DoubleMass, periods: int) -> np.ndarray:
    """First gain on (x, last u) of the finite problem, backwards, by textbook steps."""
    A, B = matrices(discretise(model, PERIOD, 5).step, model)
    q = np.array([3.0, 0.1, 2.0, 0.0])
    d = np.array([0.5, 0.0, 0.0, 0.0]) / PERIOD**2
    rho, s = np.array([0.2, 0.0]), np.array([0.05, 0.3])
    V = np.zeros((6, 6))
    gain = np.zeros((2, 6))
    for _ in range(periods):
        # Unknowns (x, last, u): the cost of this period and of what follows.
        ahead = np.hstack([A, np.zeros((4, 2)), B])
        moved = ahead - np.hstack([np.eye(4), np.zeros((4, 4))])
        u = np.hstack([np.zeros((2, 6)), np.eye(2)])
        change = u - np.hstack([np.zeros((2, 4)), np.eye(2), np.zeros((2, 2))])
        following = np.vstack([ahead, u])
        total = sum(
            rows.T @ np.diag(weight) @ rows
            for rows, weight in ((ahead, q), (moved, d), (u, rho), (change, s))
        )
        total = total + following.T @ V @ following
        gain = -np.linalg.solve(total[6:, 6:], total[6:, :6])
        V = total[:6, :6] + total[:6, 6:] @ gain
    return gain


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("periods", "terminal"), [(6, "riccati"), (400, "none")], ids=["cost to go", "long horizon"]
)
def test_without_active_limits_it_is_the_regulator(way: Any, periods: int, terminal: Any) -> None:
    model = DoubleMass(limit=1e6)
    law = LinearMpc(
        linearisation=way,
        prediction_horizon=periods,
        move_blocks=(1,) * periods,
        terminal=terminal,
        **WEIGHTS,
    )
    gain = dynamic_programming(model, 2000)
    rng = np.random.default_rng(1)
    for _ in range(2):
        x, last = rng.normal(size=4), rng.normal(size=2)
        answer = law.step(
            law.init(setup_of(model)),
            sample_of(x, [0.0, 0.0], last.tolist(), 2),
            want_prediction=False,
        )
        np.testing.assert_allclose(answer.u, gain @ np.concatenate([x, last]), rtol=2e-5, atol=1e-6)


def test_with_limits_it_is_the_converged_newton_mpc_of_a_linear_rig() -> None:
    """Another condensing, another iteration: the same optimum, limits of all kinds included."""
    model = DoubleMass(limit=2.0)
    limits: dict[str, Any] = {
        "input_rate_limits": {"f1": 8.0},
        "soft_limits": {"v2": (-0.3, 0.3)},
        "prediction_horizon": 20,
        "move_blocks": (1, 1, 2, 4, 4, 8),
        "terminal": "none",
    }
    weights = {key: value for key, value in WEIGHTS.items() if key != "operating_point"}
    newton = NewtonMpc(**weights, **limits, max_iterations=50, tolerance=1e-9)
    sample = sample_of(np.array([1.0, -0.5, -1.0, 0.4]), [0.5, 0.2], [0.3, -0.2], 2)
    theirs = newton.step(newton.init(setup_of(model)), sample, want_prediction=True)
    for way in WAYS:
        law = LinearMpc(linearisation=way, **WEIGHTS, **limits)
        ours = law.step(law.init(setup_of(model)), sample, want_prediction=True)
        assert ours.prediction is not None and theirs.prediction is not None
        np.testing.assert_allclose(ours.u, theirs.u, atol=2e-4)
        np.testing.assert_allclose(ours.prediction.states, theirs.prediction.states, atol=2e-4)
    assert np.abs(theirs.prediction.inputs).max() > 1.99  # the limits were in the way


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "model",
    [
        BOTH,
        Lagrangian(),
        Newtonian(freedom="vertical"),
        Newtonian(freedom="horizontal"),
        Newtonian(currents="dynamic"),
    ],
    ids=["newtonian", "lagrangian", "vertical", "horizontal", "currents"],
)
def test_a_known_torque_leaves_no_offset(way: Any, model: Model, close_loop: Any) -> None:
    level = np.array([{"alpha_v": 0.2, "alpha_h": 0.5}[name] for name in model.controlled])
    push = np.zeros(model.n_w)
    push[0] = 0.004
    ran = close_loop(
        LinearMpc(linearisation=way),
        model,
        lambda times: np.tile(level, (len(times), 1)),
        25.0,
        disturbance=push,
    )
    angles = ran.states[:, [model.state_index(name) for name in model.controlled]]
    np.testing.assert_allclose(angles[-10:], np.tile(level, (10, 1)), atol=2e-3)
    assert all(command.status is Status.OK for command in ran.commands)


@pytest.mark.parametrize("way", WAYS)
def test_a_known_delay_is_reckoned_with(way: Any) -> None:
    """Believing in no delay swings more than knowing it: the memory is part of the state."""
    late = extended(BOTH, {"late": InputDelay(rotor="main", delay=0.3)})
    law = LinearMpc(
        linearisation=way, sample_time=SAMPLE_TIME, prediction_horizon=60, move_blocks=(6,) * 10
    )
    worst = []
    for believed in (late, BOTH):
        ran = run(law, believed, lambda time: np.array([0.2, 0.5]), 12.0, rig=late)
        worst.append(np.abs(ran.error("alpha_v")[-200:]).max())
        if believed is late:
            assert np.abs(ran.error("alpha_v")[-50:]).max() < 5e-3
    assert worst[0] < 0.5 * worst[1]


def test_a_rotor_at_rest_does_not_stop_it(close_loop: Any) -> None:
    """From and to yaw 0, where a linear model sees no thrust of the tail rotor."""
    for way in WAYS:
        ran = close_loop(
            LinearMpc(linearisation=way),
            BOTH,
            lambda times: np.tile([0.0, 0.0], (len(times), 1)),
            20.0,
            x0=BOTH.rest() + np.eye(6)[BOTH.state_index("alpha_h")] * 0.6,
        )
        assert np.abs(ran.states[-20:, BOTH.state_index("alpha_h")]).max() < 0.05


def test_osqp_gives_the_same_answer() -> None:
    sample = sample_of(BOTH.rest(), [0.3, 0.5], [0.0, 0.0], 4)
    answers = []
    for law in (LinearMpc(), LinearMpc(qp=Osqp())):
        answers.append(law.step(law.init(setup_of(BOTH)), sample, want_prediction=False).u)
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-4)


@pytest.mark.parametrize("policy", ["shifted_plan", "hold", "steady_input", "stop"])
def test_a_failed_solve_falls_back_as_declared(policy: Any) -> None:
    law = LinearMpc(fallback=policy, qp=_Moody())
    state = law.init(setup_of(BOTH))
    sample = sample_of(BOTH.rest(), [0.3, 0.5], [1.0, -1.0], 4)
    law.step(state, sample, want_prediction=False)
    state._workspace["fail"] = True
    if policy == "stop":
        with pytest.raises(SimulationError, match="linear_mpc"):
            law.step(state, sample, want_prediction=False)
        return
    expected = {
        "shifted_plan": state.plan[:, 1],
        "hold": sample.previous_command,
        "steady_input": state.target.u,
    }[policy]
    answer = law.step(state, sample, want_prediction=False)
    assert answer.status is Status.FAILED and answer.fallback == policy
    np.testing.assert_allclose(answer.u, expected)
    state._workspace["fail"] = False
    assert law.step(state, sample, want_prediction=False).status is Status.OK


class _Moody:
    """A solver that fails when its workspace is told to."""

    def start(self) -> dict[str, Any]:
        from trms_cli.core.qp import Daqp

        return {"fail": False, "solver": Daqp(), "own": Daqp().start()}

    def solve(self, workspace: dict[str, Any], qp: Any) -> QpResult:
        if workspace["fail"]:
            return QpResult(np.full(len(qp.gradient), np.nan), False, 0, "forced")
        return workspace["solver"].solve(workspace["own"], qp)


def test_an_operating_point_without_slope_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="alpha_h"):
        LinearMpc(operating_point={"alpha_h": 0.0}).init(setup_of(BOTH))


def test_weights_on_nothing_controlled_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="no weight"):
        LinearMpc(state_weights={"S_h": 1.0}).init(setup_of(BOTH))
