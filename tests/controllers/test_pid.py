"""PID: how well it follows, that it starts without a bump, and how it tunes itself."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trms_cli.controllers.pid import Pid, PidState
from trms_cli.controllers.pid_tuning import (
    AxisPlant,
    Filters,
    Gains,
    closed_loop,
    load_costs,
    margins,
)
from trms_cli.core.plugins import build
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import SAMPLE_TIME, close_loop, sample_of, setup_of, squares, state_with

BOTH = Newtonian()


def started(controller: Pid, u: np.ndarray | None = None) -> PidState:
    return controller.init(setup_of(BOTH, SAMPLE_TIME, u))


def test_sines_are_followed() -> None:
    """Far better than by standing still, which has an RMSE of 0.21 and 0.35 rad."""

    def sines(times: np.ndarray) -> np.ndarray:
        phase = 2 * math.pi * 0.05 * times
        return np.column_stack([0.3 * np.sin(phase), 0.5 * np.cos(phase)])

    trajectory = close_loop(Pid(), BOTH, sines, 60.0)
    for angle, bound in (("alpha_v", 0.15), ("alpha_h", 0.16)):
        assert np.sqrt(np.mean(trajectory.error(angle) ** 2)) < bound


def test_another_rig_than_the_model_is_followed_too() -> None:
    rig = Newtonian(parameters={"k_fvp": 1.4e-5, "l_cb": 0.265, "k_chp": 0.02, "k_oh": 0.022})
    trajectory = close_loop(Pid(), BOTH, squares(BOTH), 80.0, rig=rig)
    for angle, step in (("alpha_v", 0.6), ("alpha_h", 1.0)):
        assert max(np.abs(e[-100:]).max() for e in trajectory.levels(angle)) < 0.04 * step


@pytest.mark.parametrize("feed_forward", [True, False])
def test_it_takes_over_without_a_bump(feed_forward: bool) -> None:
    controller = Pid(feed_forward=feed_forward, setpoint_weight=0.5)
    u = np.array([1.2, -0.3])
    state = started(controller, u)
    sample = sample_of(BOTH, [0.1, -0.2], state_with(BOTH, alpha_v=0.1, alpha_h=-0.2), u)
    command = controller.step(state, sample, want_prediction=False)
    np.testing.assert_allclose(command.u, u, atol=1e-9)


def plant() -> AxisPlant:
    """A lightly damped second-order axis behind a lag, sampled."""
    T = 0.02
    A = np.eye(3) + T * np.array([[-1.5, 0, 0], [2.0, -0.1, -3.0], [0, 1, 0]])
    return AxisPlant(A, T * np.array([1.5, 0, 0]), np.array([0.0, 0, 1]), T)


FILTERS = Filters(0.05, 0.5, 0.1)


def test_the_closed_loop_is_the_law_that_runs() -> None:
    """The transition matrix of tuning against the law stepped by itself on the linear plant."""
    axis, gains = plant(), Gains(0.4, 0.3, 0.6)
    A, row = (part[0] for part in closed_loop(axis, np.array([[0.4, 0.3, 0.6]]), FILTERS))
    T, keep, slow = axis.step, 0.05 / (0.05 + axis.step), 0.1 / (0.1 + axis.step)
    x, integral, derivative, last, lagged = np.array([0.1, 0.2, -0.3]), 0.5, 0.0, -0.3, 0.2
    state = np.array([*x, integral, derivative, last, lagged])
    for _ in range(50):
        y = axis.c @ x
        derivative = keep * derivative - gains.kd * (1 - keep) / T * (y - last)
        last = y
        v = -gains.kp * y + integral + derivative
        lagged = slow * lagged + (1 - slow) * v
        u = lagged + 5.0 * (v - lagged)
        assert row @ state == pytest.approx(u, abs=1e-12)
        integral += gains.ki * T * (0 - y)
        x = axis.A @ x + axis.b * u
        state = A @ state
        np.testing.assert_allclose(state, [*x, integral, derivative, last, lagged], atol=1e-12)


def test_the_cost_of_a_load_is_the_sum_along_its_response() -> None:
    axis, gains = plant(), np.array([[0.1, 0.1, 0.1]])
    A, u = (part[0] for part in closed_loop(axis, gains, FILTERS))
    n, T = 3, axis.step
    state, total = np.eye(n + 4)[n] + np.eye(n + 4)[n + 3], 0.0
    for _ in range(20_000):
        rate = (axis.c @ (axis.A - np.eye(n)) @ state[:n]) / T
        total += T * ((axis.c @ state[:n]) ** 2 + 4.0 * rate**2 + 0.05**2 * (u @ state) ** 2)
        state = A @ state
    assert load_costs(axis, gains, FILTERS, 2.0, 0.05)[0] == pytest.approx(total, rel=1e-6)
    assert load_costs(axis, np.array([[0.0, 50.0, 0.0]]), FILTERS, 2.0, 0.05)[0] == math.inf


def test_tuned_loops_keep_their_margins() -> None:
    controller = Pid(max_sensitivity=1.8)
    for loop in started(controller).margins.values():
        assert loop.peak_sensitivity < 1.8 * 1.02
        # what the peak implies
        assert loop.gain_margin > 1.8 / 0.8 * 0.97
        assert loop.phase_margin > 2 * math.asin(1 / (2 * 1.8)) * 0.97
        assert 0.5 < loop.crossover < 5.0


def test_margins_are_where_the_loop_becomes_unstable() -> None:
    axis, gains = plant(), Gains(0.4, 0.3, 0.6)
    margin = margins(axis, gains, Filters(0.05)).gain_margin

    def radius(factor: float) -> float:
        row = factor * np.array([[gains.kp, gains.ki, gains.kd]])
        return float(np.abs(np.linalg.eigvals(closed_loop(axis, row, Filters(0.05))[0][0])).max())

    assert radius(0.98 * margin) < 1.0 < radius(1.02 * margin)


def test_given_gains_are_taken_and_the_others_tuned() -> None:
    node = {
        "_target_": "trms_cli.controllers.pid.Pid",
        "pitch": {"kp": 0.1, "ki": 0.2, "kd": 0.3},
        "sample_time": 0.04,
    }
    controller = build(node, "controller")
    assert controller.sample_time == 0.04
    pitch, yaw = started(controller).axes
    assert pitch.gains == Gains(0.1, 0.2, 0.3)
    assert yaw.gains.ki > 0


def test_gains_of_both_axes_are_taken_as_they_are() -> None:
    """Even where they are of no use: kd is 0 unless given, and pitch hardly damps itself."""
    pitch, yaw = started(Pid(pitch=Gains(0.1, 0.05), yaw=Gains(0.05, 0.02))).axes
    assert (pitch.gains, yaw.gains) == (Gains(0.1, 0.05, 0.0), Gains(0.05, 0.02, 0.0))
