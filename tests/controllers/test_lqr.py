"""LQR: the Riccati solution, and a reference out of reach; the rest is in test_following. The LQG
scenario composes, runs and follows. linear_mpc: the regulator without limits, the optimum with them
and that of newton_mpc.
"""

from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.models.discretisation import discretise
from trms_cli.models.linearisation import Linearisation
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState
from trms_cli.observers.kalman import Kalman

from ..simulation.looping import composed, looped
from .closed_loop_case import SAMPLE_TIME, DoubleMass, matrices, regulator, sample_of, setup_of

BOTH = Newtonian()


def test_the_gains_solve_the_riccati_equation() -> None:
    """Against the cost of a long finite horizon, by dynamic programming backwards."""
    controller = Lqr()
    linear = Linearisation(BOTH, SAMPLE_TIME, SteadyState(BOTH)).at({"alpha_h": 0.5}, "")
    law = controller.designed(linear)
    n, T = 6, SAMPLE_TIME
    A = np.block([[linear.A, np.zeros((n, 2))], [T * linear.C, np.eye(2)]])
    B = np.vstack([linear.B, np.zeros((2, 2))])
    rates = (linear.C @ linear.A - linear.C) / T
    Q = np.zeros((8, 8))
    Q[:n, :n] = 100 * linear.C.T @ linear.C + 30 * rates.T @ rates
    Q[n:, n:] = 20 * np.eye(2)
    P = np.zeros((8, 8))
    for _ in range(6000):
        gain = np.linalg.solve(T * np.eye(2) + B.T @ P @ B, B.T @ P @ A)
        P = T * Q + A.T @ P @ (A - B @ gain)
        P = (P + P.T) / 2
    np.testing.assert_allclose(np.hstack([law.K, law.K_i]), gain, rtol=1e-6, atol=1e-9)
    # M dx is minus the integral of least cost to go
    dx = np.arange(1.0, 7.0)
    best = -law.M @ dx
    gradient = P[n:, :n] @ dx + P[n:, n:] @ best
    np.testing.assert_allclose(gradient, 0.0, atol=1e-6 * np.abs(P).max())
    closed = np.abs(np.linalg.eigvals(A - B @ np.hstack([law.K, law.K_i])))
    assert closed.max() < 1.0
    slope = linear.C @ np.linalg.solve(np.eye(len(linear.A)) - linear.A, linear.B)
    assert slope[1, 1] == pytest.approx(1.70, abs=0.02)  # rad/V, from the yaw curve of the rig


def test_a_reference_out_of_reach_is_said_and_does_not_wind_up() -> None:
    controller = Lqr()
    state = controller.init(setup_of(BOTH, SAMPLE_TIME))
    r = np.array([1.3, 0.0])
    x = state.steady.solve(r).x
    for _ in range(500):
        command = controller.step(state, sample_of(BOTH, r, x), want_prediction=False)
    assert "out of reach" in command.message
    np.testing.assert_allclose(command.u, state.steady.solve(r).u, atol=1e-6)


@pytest.mark.parametrize("model", ["newtonian", "newtonian_vertical", "newtonian_horizontal"])
def test_squares_are_followed_by_an_lqg(model: str) -> None:
    experiment = composed("experiment=lqg", f"model={model}", "sim.duration=40")
    assert isinstance(experiment.controller, Lqr)
    assert isinstance(experiment.observer, Kalman)
    history = looped(experiment).history
    truth, reference = (history.columns(t) for t in ("/plant/state", "/reference"))
    for name in reference:
        error = truth[name] - reference[name]
        assert np.sqrt((error**2).mean()) < 0.25
        for end in (1000, 2000):  # before each change of the reference
            assert np.abs(error[end - 50 : end]).max() < 0.01


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
    A, B = matrices(discretise(model, PERIOD, 5).step, model)
    rates = np.array([0.5, 0.0, 0.0, 0.0]) / PERIOD**2
    gain, _ = regulator(A, B, [3.0, 0.1, 2.0, 0.0], rates, [0.2, 0.0], [0.05, 0.3])
    rng = np.random.default_rng(1)
    for _ in range(2):
        x, last = rng.normal(size=4), rng.normal(size=2)
        sample = sample_of(model, [0.0, 0.0], x, last)
        answer = law.step(law.init(setup_of(model)), sample, want_prediction=False)
        expected = -gain @ np.concatenate([x, last])
        np.testing.assert_allclose(answer.u, expected, rtol=2e-5, atol=1e-6)


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
    sample = sample_of(model, [0.5, 0.2], np.array([1.0, -0.5, -1.0, 0.4]), np.array([0.3, -0.2]))
    theirs = newton.step(newton.init(setup_of(model)), sample, want_prediction=True)
    for way in WAYS:
        law = LinearMpc(linearisation=way, **WEIGHTS, **limits)
        ours = law.step(law.init(setup_of(model)), sample, want_prediction=True)
        assert ours.prediction is not None and theirs.prediction is not None
        np.testing.assert_allclose(ours.u, theirs.u, atol=2e-4)
        np.testing.assert_allclose(ours.prediction.states, theirs.prediction.states, atol=2e-4)
    assert np.abs(theirs.prediction.inputs).max() > 1.99  # the limits were in the way
