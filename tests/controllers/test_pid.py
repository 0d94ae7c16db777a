"""PID: tracks the default references, unwinds, starts without a bump, and tunes itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from closed_loop_case import SAMPLE_TIME, Trajectory, run, squares

from trms_cli.controllers.controller import ControlSample, ControlSetup, Status
from trms_cli.controllers.pid import Pid, PidState
from trms_cli.controllers.pid_tuning import (
    AxisPlant,
    Filters,
    Gains,
    closed_loop,
    load_costs,
    margins,
)
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.tras import Tras

BOTH = Newtonian()


def sample_of(x: np.ndarray, reference: np.ndarray, u: np.ndarray) -> ControlSample:
    zero = np.zeros(4)
    return ControlSample(0.0, reference[None, :], Estimate(x, np.zeros_like(x), zero, zero), u)


def started(controller: Pid, u: np.ndarray | None = None) -> PidState:
    return controller.init(ControlSetup(BOTH, SAMPLE_TIME, np.zeros(2) if u is None else u))


def settled(levels: list[np.ndarray], within: float) -> float:
    """Latest time at which any level is left by more than ``within`` rad, s."""
    latest = 0.0
    for error in levels:
        outside = np.flatnonzero(np.abs(error) > within)
        latest = max(latest, (outside[-1] + 1) * SAMPLE_TIME if outside.size else 0.0)
    return latest


@pytest.fixture(scope="module")
def tracked() -> Trajectory:
    return run(Pid(), BOTH, squares(BOTH), 120.0)


@pytest.mark.parametrize(("angle", "step", "time"), [("alpha_v", 0.6, 6.5), ("alpha_h", 1.0, 8.0)])
def test_squares_are_followed(tracked: Trajectory, angle: str, step: float, time: float) -> None:
    levels = tracked.levels(angle)
    assert settled(levels, 0.02 * step) < time
    assert max(error.max() for error in levels) < 0.11 * step
    # what is left two seconds before the next step
    assert max(np.abs(error[-100:]).max() for error in levels) < 0.005 * step


def test_the_start_from_standing_rotors_does_not_overshoot_far(tracked: Trajectory) -> None:
    first = slice(0, round(20.0 / SAMPLE_TIME))
    for angle, step in (("alpha_v", 0.919), ("alpha_h", 0.5)):
        error = tracked.error(angle)[first]
        assert error.max() < 0.1 * step
        assert settled([error], 0.02 * step) < 8.0


def test_sines_are_followed() -> None:
    """Far better than by standing still, which has an RMSE of 0.21 and 0.35 rad."""

    def sines(time: float) -> np.ndarray:
        phase = 2 * math.pi * 0.05 * time
        return np.array([0.3 * math.sin(phase), 0.5 * math.cos(phase)])

    trajectory = run(Pid(), BOTH, sines, 60.0)
    for angle, bound in (("alpha_v", 0.15), ("alpha_h", 0.16)):
        assert np.sqrt(np.mean(trajectory.error(angle) ** 2)) < bound


@pytest.mark.parametrize("equation", [0, 1])
def test_a_constant_torque_leaves_no_error(equation: int) -> None:
    level = np.array([0.1, 0.4])

    def torque(time: float) -> np.ndarray:
        return np.eye(4)[equation] * (0.01 if time > 30.0 else 0.0)

    trajectory = run(Pid(), BOTH, lambda time: level, 120.0, torque)
    for angle in BOTH.controlled:
        error = np.abs(trajectory.error(angle))
        assert error[-100:].max() < 2e-4
    pushed = np.abs(trajectory.error(BOTH.controlled[equation]))[round(30 / SAMPLE_TIME) :]
    assert pushed.max() > 0.01  # the torque did push


def test_another_rig_than_the_model_is_followed_too() -> None:
    rig = Newtonian(parameters={"k_fvp": 1.4e-5, "l_cb": 0.265, "k_chp": 0.02, "k_oh": 0.022})
    trajectory = run(Pid(), BOTH, squares(BOTH), 80.0, rig=rig)
    for angle, step in (("alpha_v", 0.6), ("alpha_h", 1.0)):
        assert max(np.abs(e[-100:]).max() for e in trajectory.levels(angle)) < 0.04 * step


@pytest.mark.parametrize(
    "model",
    [
        Newtonian(freedom="vertical"),
        Newtonian(freedom="horizontal"),
        Newtonian(currents="dynamic"),
        Tras(),
    ],
    ids=["vertical", "horizontal", "currents", "tras"],
)
def test_every_model_is_followed(model: Model) -> None:
    trajectory = run(Pid(), model, squares(model), 60.0)
    for angle in model.controlled:
        assert max(np.abs(e[-100:]).max() for e in trajectory.levels(angle)) < 0.03


def test_an_input_at_its_limit_does_not_wind_up() -> None:
    """A torque that the rotor cannot hold for 20 s: back as fast as after a short one."""
    level = np.array([0.2, 0.3])

    def pushed_for(length: float) -> Trajectory:
        return run(
            Pid(),
            BOTH,
            lambda time: level,
            30.0 + length + 25.0,
            lambda time: np.array([0.0, -0.11 if 30.0 < time < 30.0 + length else 0.0, 0.0, 0.0]),
        )

    short, long = pushed_for(10.0), pushed_for(30.0)
    assert np.all(long.u[round(50 / SAMPLE_TIME) : round(59 / SAMPLE_TIME), 1] == 2.5)
    after_short = np.abs(short.error("alpha_h"))[-round(5 / SAMPLE_TIME) :].max()
    after_long = np.abs(long.error("alpha_h"))[-round(5 / SAMPLE_TIME) :].max()
    assert after_long < after_short + 0.02
    assert after_long < 0.08


@pytest.mark.parametrize("feed_forward", [True, False])
def test_it_takes_over_without_a_bump(feed_forward: bool) -> None:
    controller = Pid(feed_forward=feed_forward, setpoint_weight=0.5)
    u = np.array([1.2, -0.3])
    state = started(controller, u)
    x = BOTH.rest()
    x[BOTH.state_index("alpha_v")], x[BOTH.state_index("alpha_h")] = 0.1, -0.2
    command = controller.step(state, sample_of(x, np.array([0.1, -0.2]), u), want_prediction=False)
    np.testing.assert_allclose(command.u, u, atol=1e-9)


def test_two_runs_in_one_process_are_equal(tracked: Trajectory) -> None:
    again = run(Pid(), BOTH, squares(BOTH), 10.0)
    np.testing.assert_array_equal(again.u, tracked.u[: len(again.u)])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_answered_by_holding(bad: float) -> None:
    controller = Pid()
    u = np.array([1.0, 0.2])
    state = started(controller, u)
    x, r = BOTH.rest(), np.zeros(2)
    controller.step(state, sample_of(x, r, u), want_prediction=False)
    before = [(axis.integral, axis.derivative) for axis in state.axes]
    spoiled = x.copy()
    spoiled[2] = bad
    for sample in (sample_of(spoiled, r, u), sample_of(x, np.array([bad, 0.0]), u)):
        command = controller.step(state, sample, want_prediction=False)
        assert command.status is Status.FAILED
        assert command.fallback == "hold" and "not finite" in command.message
        np.testing.assert_array_equal(command.u, u)
    assert [(axis.integral, axis.derivative) for axis in state.axes] == before
    command = controller.step(state, sample_of(x, r, u), want_prediction=False)
    assert command.status is Status.OK


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


@pytest.mark.parametrize(
    ("options", "where", "words"),
    [
        ({"operating_points": [{"alpha_h": 0.0}]}, "operating_points[0]", "uncontrollable"),
        ({"operating_points": [{"alpha_w": 0.0}]}, "operating_points[0]", "did you mean alpha_"),
        ({"operating_points": [{"alpha_v": 1.4}]}, "operating_points[0]", "cannot rest"),
        ({"operating_points": []}, "operating_points", "at least one"),
        ({"max_sensitivity": 1.01}, "pitch", "raise max_sensitivity"),
        ({"pitch": {"kp": 1.0, "kii": 2.0}}, "pitch.kii", "kii"),
        ({"pitch": {"kp": 0.1, "ki": 0.05}}, "pitch", "larger kd"),
        ({"pitch": {"kp": 0.1}}, "pitch.ki", "required"),
        ({"yaw": "manual"}, "yaw", "manual"),
        ({"smoothness": {"roll": 1.0}}, "smoothness", "pitch"),
    ],
)
def test_mistakes_are_reported_by_key(options: dict[str, object], where: str, words: str) -> None:
    node = {"_target_": "trms_cli.controllers.pid.Pid", **options}
    with pytest.raises(ConfigurationError) as caught:
        started(build(node, "controller"))
    assert caught.value.where == f"controller.{where}"
    assert words in f"{caught.value.problem} {caught.value.remedy}"
