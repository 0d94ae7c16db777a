"""LQR: the Riccati solution, and a reference out of reach; the rest is in test_following. The LQG
scenario composes, runs, follows, and rejects a constant torque.
"""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.controllers.lqr import Lqr
from trms_cli.models.linearisation import Linearisation
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState
from trms_cli.observers.kalman import Kalman

from ..simulation.looping import composed, looped
from .closed_loop_case import SAMPLE_TIME, sample_of, setup_of

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


def errors(*overrides: str) -> dict[str, np.ndarray]:
    """Of each controlled angle against the true state, rad."""
    experiment = composed("experiment=lqg", *overrides)
    assert isinstance(experiment.controller, Lqr)
    assert isinstance(experiment.observer, Kalman)
    history = looped(experiment).history
    truth, reference = (history.columns(t) for t in ("/plant/state", "/reference"))
    return {name: truth[name] - reference[name] for name in reference}


@pytest.mark.parametrize("model", ["newtonian", "newtonian_vertical", "newtonian_horizontal"])
def test_squares_are_followed_by_an_lqg(model: str) -> None:
    for error in errors(f"model={model}", "sim.duration=40").values():
        assert np.sqrt((error**2).mean()) < 0.25
        for end in (1000, 2000):  # before each change of the reference
            assert np.abs(error[end - 50 : end]).max() < 0.01


def test_a_push_leaves_no_offset_with_an_lqg() -> None:
    error = errors(
        "ref=constant",
        "ref.alpha_v.offset=0.1",
        "ref.alpha_h.offset=0.4",
        "disturbance@plant.disturbances=[yaw_push]",
        "plant.disturbances.yaw_push.torque.start=15",
        "sim.duration=40",
    )["alpha_h"]
    assert np.abs(error[750:1000]).max() > 0.02  # it was felt
    assert np.abs(error[-100:]).max() < 0.01
