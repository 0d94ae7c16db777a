"""linear_mpc: the regulator without limits, the optimum with them and that of newton_mpc."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.models.discretisation import discretise

from .closed_loop_case import DoubleMass, matrices, sample_of, setup_of

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
        sample = sample_of(model, [0.0, 0.0], x, last)
        answer = law.step(law.init(setup_of(model)), sample, want_prediction=False)
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
    sample = sample_of(model, [0.5, 0.2], np.array([1.0, -0.5, -1.0, 0.4]), np.array([0.3, -0.2]))
    theirs = newton.step(newton.init(setup_of(model)), sample, want_prediction=True)
    for way in WAYS:
        law = LinearMpc(linearisation=way, **WEIGHTS, **limits)
        ours = law.step(law.init(setup_of(model)), sample, want_prediction=True)
        assert ours.prediction is not None and theirs.prediction is not None
        np.testing.assert_allclose(ours.u, theirs.u, atol=2e-4)
        np.testing.assert_allclose(ours.prediction.states, theirs.prediction.states, atol=2e-4)
    assert np.abs(theirs.prediction.inputs).max() > 1.99  # the limits were in the way
