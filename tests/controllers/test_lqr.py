"""LQR: the Riccati solution, tracking, integral action, windup, and its operating point."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import SAMPLE_TIME, Trajectory, run, squares

from trms_cli.controllers.controller import ControlSample, ControlSetup, Status
from trms_cli.controllers.lqr import Lqr, LqrState
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.effects.extended_model import extended
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.estimate import Estimate
from trms_cli.models.linearisation import Linearisation
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState

BOTH = Newtonian()
DELAYED = extended(Newtonian(), {"late": InputDelay(rotor="main", delay=0.1)})


def started(controller: Lqr, model: Model = BOTH) -> LqrState:
    return controller.init(ControlSetup(model, SAMPLE_TIME, np.zeros(model.n_u)))


def sample_of(
    x: np.ndarray, r: np.ndarray, u: np.ndarray, w: np.ndarray | None = None
) -> ControlSample:
    w = np.zeros(4) if w is None else w
    return ControlSample(0.0, r[None, :], Estimate(x, np.zeros_like(x), w, np.zeros_like(w)), u)


@pytest.fixture(scope="module")
def tracked() -> Trajectory:
    return run(Lqr(), BOTH, squares(BOTH), 120.0)


@pytest.mark.parametrize(("angle", "step"), [("alpha_v", 0.6), ("alpha_h", 1.0)])
def test_squares_are_followed(tracked: Trajectory, angle: str, step: float) -> None:
    for error in tracked.levels(angle):
        outside = np.flatnonzero(np.abs(error) > 0.05 * step)
        assert outside[-1] * SAMPLE_TIME < 3.5
        assert error.max() < 0.08 * step
        assert np.abs(error[-100:]).max() < 1e-3


@pytest.mark.parametrize("equation", [0, 1])
def test_a_constant_torque_leaves_no_error(equation: int) -> None:
    level, push = np.array([0.1, 0.4]), np.eye(4)[equation] * 0.01
    trajectory = run(Lqr(), BOTH, lambda time: level, 60.0, lambda time: push * (time > 20.0))
    for angle in BOTH.controlled:
        assert np.abs(trajectory.error(angle))[-100:].max() < 1e-4
    disturbed = np.abs(trajectory.error(BOTH.controlled[equation]))
    assert disturbed[round(20 / SAMPLE_TIME) :].max() > 0.005


def test_an_estimated_torque_is_met_at_once() -> None:
    level, push = np.array([0.1, 0.4]), np.array([0.005, 0.01, 0.0, 0.0])
    controller = Lqr()
    state = started(controller)
    steady = state.steady.solve(level, push)
    command = controller.step(
        state, sample_of(steady.x, level, np.zeros(2), push), want_prediction=False
    )
    np.testing.assert_allclose(command.u, steady.u, atol=1e-6)


@pytest.mark.parametrize(
    "model",
    [
        Newtonian(freedom="vertical"),
        Newtonian(freedom="horizontal"),
        Newtonian(currents="dynamic"),
        DELAYED,
    ],
    ids=["vertical", "horizontal", "currents", "delay"],
)
def test_every_model_is_followed(model: Model) -> None:
    trajectory = run(Lqr(), model, squares(model), 60.0)
    for angle in model.controlled:
        assert max(np.abs(e[-100:]).max() for e in trajectory.levels(angle)) < 3e-3


def test_a_known_delay_is_compensated() -> None:
    """Believing in no delay swings more than knowing it: the memory is part of the state."""
    aware = run(Lqr(), DELAYED, squares(BOTH), 40.0)
    unaware = run(Lqr(), BOTH, squares(BOTH), 40.0, rig=DELAYED)
    worst = [max(e.max() for e in t.levels("alpha_v")) for t in (aware, unaware)]
    assert worst[0] < worst[1]


def test_an_input_at_its_limit_does_not_wind_up() -> None:
    level = np.array([0.2, 0.3])

    def pushed_for(length: float) -> Trajectory:
        return run(
            Lqr(),
            BOTH,
            lambda time: level,
            20.0 + length + 15.0,
            lambda time: np.array([0.0, -0.11 if 20.0 < time < 20.0 + length else 0.0, 0.0, 0.0]),
        )

    short, long = pushed_for(8.0), pushed_for(30.0)
    assert np.all(long.u[round(40 / SAMPLE_TIME) : round(49 / SAMPLE_TIME), 1] == 2.5)
    last = round(2 / SAMPLE_TIME)
    after = [np.abs(t.error("alpha_h"))[-last:].max() for t in (short, long)]
    assert after[1] < after[0] + 0.02
    assert after[1] < 0.05


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


def test_the_operating_point_needs_a_turning_tail_rotor() -> None:
    with pytest.raises(ConfigurationError, match=r"alpha_h.*uncontrollable") as caught:
        started(Lqr(operating_point={"alpha_v": 0.0, "alpha_h": 0.0}))
    assert caught.value.where == "controller.operating_point"
    assert "alpha_h=0.5" in caught.value.remedy
    linear = Linearisation(BOTH, SAMPLE_TIME, SteadyState(BOTH)).at({"alpha_h": 0.5}, "")
    gain = linear.C @ np.linalg.solve(np.eye(len(linear.A)) - linear.A, linear.B)
    assert gain[1, 1] == pytest.approx(1.70, abs=0.02)  # rad/V, from the yaw curve of the rig


def test_two_runs_in_one_process_are_equal(tracked: Trajectory) -> None:
    again = run(Lqr(), BOTH, squares(BOTH), 10.0)
    np.testing.assert_array_equal(again.u, tracked.u[: len(again.u)])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["state", "reference", "disturbance"])
def test_what_is_not_finite_is_answered_by_holding(bad: float, where: str) -> None:
    controller = Lqr()
    state = started(controller)
    u, x, r, w = np.array([1.0, 0.2]), BOTH.rest(), np.zeros(2), np.zeros(4)
    controller.step(state, sample_of(x, r, u), want_prediction=False)
    before = state.integral.copy()
    {"state": x, "reference": r, "disturbance": w}[where][1] = bad
    command = controller.step(state, sample_of(x, r, u, w), want_prediction=False)
    assert command.status is Status.FAILED and command.fallback == "hold"
    np.testing.assert_array_equal(command.u, u)
    np.testing.assert_array_equal(state.integral, before)


def test_a_reference_out_of_reach_is_said_and_does_not_wind_up() -> None:
    controller = Lqr()
    state = started(controller)
    r = np.array([1.3, 0.0])
    x = state.steady.solve(r).x
    for _ in range(500):
        command = controller.step(state, sample_of(x, r, np.zeros(2)), want_prediction=False)
    assert "out of reach" in command.message
    np.testing.assert_allclose(command.u, state.steady.solve(r).u, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "where", "words"),
    [
        ({"operating_point": {"alpha_x": 0.0}}, "operating_point", "did you mean alpha_"),
        ({"output_weights": {"alpha": 1.0}}, "output_weights", "did you mean alpha_"),
        ({"input_weights": {"u_w": 1.0}}, "input_weights", "did you mean u_"),
        ({"input_weights": {"u_v": 0.0}}, "input_weights", ">"),
    ],
)
def test_mistakes_are_reported_by_key(options: dict[str, object], where: str, words: str) -> None:
    node = {"_target_": "trms_cli.controllers.lqr.Lqr", **options}
    with pytest.raises(ConfigurationError) as caught:
        started(build(node, "controller"))
    assert caught.value.where.startswith(f"controller.{where}")
    assert words in f"{caught.value.problem} {caught.value.remedy}"
