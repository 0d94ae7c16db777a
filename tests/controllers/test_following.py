"""What the laws of the angles follow and reject: PID, LQR, feedback linearisation, linear MPC. Of
feedback linearisation the poles that were chosen, its reference, and what it refuses.
"""

from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import Status
from trms_cli.controllers.feedback_linearisation import (
    FeedbackLinearisation,
    gains_of,
    virtual_moments,
)
from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.lqr import Lqr
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.nmpc import Nmpc
from trms_cli.controllers.pid import Pid
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.tras import Tras

from .closed_loop_case import (
    SAMPLE_TIME,
    Ran,
    close_loop,
    constant,
    sample_of,
    setup_of,
    squares,
    state_with,
)

BOTH = Newtonian()
STEPS = {"alpha_v": 0.6, "alpha_h": 1.0}
MODELS: dict[str, Model] = {
    "newtonian": BOTH,
    "lagrangian": Lagrangian(),
    "vertical": Newtonian(freedom="vertical"),
    "horizontal": Newtonian(freedom="horizontal"),
    "currents": Newtonian(currents="dynamic"),
    "tras": Tras(),
    "delay": extend_model(BOTH, {"late": InputDelay(rotor="main", delay=0.1)}),
}
LATER = extend_model(BOTH, {"late": InputDelay(rotor="main", delay=0.3)})
WAYS: list[Any] = ["fixed", "target", "current"]
ALL = "newtonian lagrangian vertical horizontal currents tras"
LAWS: dict[str, Any] = {
    "pid": Pid(),
    "lqr": Lqr(),
    "feedback_linearisation": FeedbackLinearisation(),
}


def settled(levels: list[np.ndarray], within: float) -> float:
    """Latest time at which any level is left by more than ``within`` rad, s."""
    outside = [np.flatnonzero(np.abs(error) > within) for error in levels]
    return max((rows[-1] + 1) * SAMPLE_TIME if rows.size else 0.0 for rows in outside)


@pytest.mark.parametrize(
    ("law", "share", "times", "overshoot", "left"),
    [("pid", 0.02, (6.5, 8.0), 0.11, 0.003), ("lqr", 0.05, (3.5, 3.5), 0.08, 1e-3)],
)
def test_squares_are_followed(law, share, times, overshoot, left) -> None:
    """A share of the step until a time; what is left two seconds before the next step."""
    ran = close_loop(LAWS[law], BOTH, squares(BOTH), 120.0)
    for (angle, step), time in zip(STEPS.items(), times, strict=True):
        levels = ran.levels(angle)
        assert settled(levels, share * step) < time
        assert max(error.max() for error in levels) < overshoot * step
        assert max(np.abs(error[-100:]).max() for error in levels) < left
    if law == "pid":  # the start, from standing rotors
        for angle, step in (("alpha_v", 0.919), ("alpha_h", 0.5)):
            error = ran.error(angle)[: ran.at(20.0)]
            assert error.max() < 0.1 * step
            assert settled([error], 0.02 * step) < 8.0


@pytest.mark.parametrize(
    ("law", "overshoot", "left", "models"),
    [
        ("pid", np.inf, 0.03, "vertical horizontal currents tras"),
        ("lqr", np.inf, 3e-3, "vertical horizontal currents delay"),
        ("feedback_linearisation", 0.1, 5e-3, ALL),
    ],
)
def test_every_model_is_followed(law: str, overshoot: float, left: float, models: str) -> None:
    for name in models.split():
        model = MODELS[name]
        ran = close_loop(LAWS[law], model, squares(model), 60.0)
        for angle in model.controlled:
            for error in ran.levels(angle):
                assert error.max() < overshoot * STEPS[angle], name
                assert np.abs(error[-100:]).max() < left, name


@pytest.mark.parametrize("equation", [0, 1])
@pytest.mark.parametrize(
    ("law", "start", "end", "felt", "left"),
    [
        ("pid", 30.0, 120.0, 0.01, 2e-4),
        ("lqr", 20.0, 60.0, 0.005, 1e-4),
        ("feedback_linearisation", 15.0, 45.0, 0.005, 1e-3),
    ],
)
def test_a_constant_torque_leaves_no_error(law, equation, start, end, felt, left) -> None:
    push = 0.01 * np.eye(4)[equation]
    ran = close_loop(
        LAWS[law], BOTH, constant(0.1, 0.4), end, torque=lambda time: push * (time > start)
    )
    assert np.abs(ran.errors[-100:]).max() < left
    assert np.abs(ran.errors[ran.at(start) :, equation]).max() > felt


@pytest.mark.parametrize(
    ("law", "start", "short", "long", "after", "last", "left"),
    [
        ("pid", 30.0, 10.0, 30.0, 25.0, 5.0, 0.08),
        ("lqr", 20.0, 8.0, 30.0, 15.0, 2.0, 0.05),
        ("feedback_linearisation", 15.0, 6.0, 25.0, 12.0, 3.0, 0.05),
    ],
)
def test_an_input_at_its_limit_does_not_wind_up(law, start, short, long, after, last, left) -> None:
    """A torque that the rotor cannot hold: back as fast after a long one as after a short one."""

    def pushed_for(length: float) -> tuple[Ran, float]:
        ran = close_loop(
            LAWS[law], BOTH, constant(0.2, 0.3), start + length + after,
            torque=lambda time: [0, -0.11 if start < time < start + length else 0, 0, 0],
        )  # fmt: skip
        return ran, float(np.abs(ran.error("alpha_h"))[-ran.at(last) :].max())

    (_, after_short), (ran, after_long) = pushed_for(short), pushed_for(long)
    held = ran.inputs[ran.at(start + long - 10) : ran.at(start + long - 1)]
    assert np.all(held[:, 1] == 2.5)
    assert after_long < after_short + 0.02
    assert after_long < left


@pytest.mark.parametrize(("law", "within"), [("lqr", 1e-6), ("feedback_linearisation", 0.02)])
def test_an_estimated_torque_is_met_at_once(law: str, within: float) -> None:
    level, push = np.array([0.1, 0.4]), np.array([0.005, 0.01, 0.0, 0.0])
    steady = SteadyState(BOTH).solve(level, push)
    state = LAWS[law].init(setup_of(BOTH, SAMPLE_TIME))
    before = np.zeros(2) if law == "lqr" else steady.u
    sample = sample_of(BOTH, level, steady.x, before, push)
    answer = LAWS[law].step(state, sample, want_prediction=False)
    np.testing.assert_allclose(answer.u, steady.u, atol=within)


SHORT = {"prediction_horizon": 24, "move_blocks": (1, 1, 1, 1, 2, 2, 4, 4, 8)}
KNOWN: list[Any] = [
    *(
        (LinearMpc(linearisation=way), model, (0.2, 0.5), (0.004, 0.0), 25.0, 2e-3)
        for way in WAYS
        for model in ("newtonian", "lagrangian", "vertical", "horizontal", "currents", "delay")
    ),
    (NewtonMpc(), "newtonian", (0.1, 0.2), (0.01, 0.008), 10.0, 1e-3),
    *(
        (Nmpc(**SHORT, machine_code=False, solver=solver), model, (0.2, 0.2), (0.004, 0), 9.0, 5e-3)
        for solver in ("ipopt", "fatrop")
        for model in ("vertical", "horizontal")
    ),
]


@pytest.mark.parametrize(("law", "model", "level", "push", "seconds", "left"), KNOWN)
def test_a_known_torque_leaves_no_offset(law, model, level, push, seconds, left) -> None:
    rig = MODELS[model]
    goal = [dict(zip(("alpha_v", "alpha_h"), level, strict=True))[name] for name in rig.controlled]
    w = np.zeros(rig.n_w)
    w[:2] = push
    ran = close_loop(law, rig, constant(*goal), seconds, torque=lambda t: w * (t > 1), known=True)
    np.testing.assert_allclose(ran.errors[-1], 0.0, atol=left)
    assert all(command.status is not Status.FAILED for command in ran.commands)


@pytest.mark.parametrize("way", WAYS)
def test_a_linear_mpc_reckons_with_a_known_delay_and_a_rotor_at_rest(way: Any) -> None:
    """Believing in no delay swings more than knowing it: the memory is part of the state."""
    law = LinearMpc(
        linearisation=way, sample_time=SAMPLE_TIME, prediction_horizon=60, move_blocks=(6,) * 10
    )
    aware, unaware = (
        np.abs(close_loop(law, model, constant(0.2, 0.5), 12.0, rig=LATER).error("alpha_v"))
        for model in (LATER, BOTH)
    )
    assert aware[-50:].max() < 5e-3
    assert aware[-200:].max() < 0.5 * unaware[-200:].max()
    # From and to yaw 0, where a linear model sees no thrust of the tail rotor.
    start = state_with(BOTH, alpha_h=0.6)
    ran = close_loop(LinearMpc(linearisation=way), BOTH, constant(0.0, 0.0), 20.0, x0=start)
    assert np.abs(ran.error("alpha_h")[-20:]).max() < 0.05


def test_an_lqr_reckons_with_a_known_delay() -> None:
    late = MODELS["delay"]
    aware, unaware = (
        close_loop(Lqr(), model, squares(BOTH), 40.0, rig=late) for model in (late, BOTH)
    )
    worst = [max(e.max() for e in ran.levels("alpha_v")) for ran in (aware, unaware)]
    assert worst[0] < worst[1]


RATES = (3.0, 2.5, 2.0, 0.7)


def chosen_error(
    rates: tuple[float, ...], start: float, acceleration: float, times: np.ndarray
) -> np.ndarray:
    """The error from a standstill, by the polynomial's own state space."""
    from scipy.linalg import expm

    rotor, kd, kp, ki = gains_of(rates)
    # e, ė, ë and the integral: d³e/dt³ = −λ (ë + k_d ė + k_p e + I).
    A = np.array(
        [[0, 1, 0, 0], [0, 0, 1, 0], [-rotor * kp, -rotor * kd, -rotor, -rotor], [ki, 0, 0, 0]]
    )
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(A).real), np.sort(-np.array(rates)), 1e-3)
    return np.array([(expm(A * t) @ [start, 0.0, acceleration, 0.0])[0] for t in times])


@pytest.mark.parametrize("axis", ["pitch", "yaw"])
@pytest.mark.parametrize("kind", [Newtonian, Lagrangian])
def test_the_error_decays_as_chosen(kind: Any, axis: str) -> None:
    """Rotors of little inertia, a fine period, no limit reached: nothing but the poles is left."""
    light = {name: BOTH.parameters[name].value / 20 for name in ("J_mr", "J_tr", "k_m", "k_t")}
    model = kind(parameters=light)
    period, offset = 0.002, 0.01
    law = FeedbackLinearisation(poles={"pitch": RATES, "yaw": RATES})
    reference = np.array([0.1, 0.7])
    steady = SteadyState(model).solve(reference)
    state = law.init(setup_of(model, period, steady.u))
    state.has_started = True
    angles = [model.state_index(name) for name in ("alpha_v", "alpha_h")]
    state.guide[:, 0] = [reference[part.reference] for part in state.parts.axes]
    moved = 0 if axis == "pitch" else 1
    x, u = steady.x.copy(), steady.u.copy()
    x[angles[moved]] -= offset
    # Off its angle the axis is out of balance.
    pull = -state.parts.motion.evaluate(x, u, np.zeros(model.n_w))[1][moved]
    step = BufferedFunction(discretise(model, period).step)
    errors = []
    lower, upper = model.input_bounds()
    for _ in range(1500):
        u = law.step(state, sample_of(model, reference, x, u), want_prediction=False).u
        assert np.all(u > lower) and np.all(u < upper)
        errors.append(reference - x[angles])
        x = step.evaluate(x, u, model.parameters.values, np.zeros(model.n_w))[0].copy()
    found = np.array(errors)[:, moved]
    expected = chosen_error(RATES, offset, pull, np.arange(1500) * period)
    assert np.abs(found - expected).max() < 0.03 * offset
    assert np.abs(expected).min() < 0.5 * offset  # it has moved
    assert np.abs(np.array(errors)[:, 1 - moved]).max() < 0.05 * offset


def test_a_wild_estimate_does_no_lasting_harm_and_a_reference_out_of_reach_is_said() -> None:
    law, level = FeedbackLinearisation(), np.array([0.1, 0.4])
    steady = SteadyState(BOTH).solve(level)
    state = law.init(setup_of(BOTH, SAMPLE_TIME, steady.u))
    for k in range(400):
        x = steady.x * (1e9 if k == 5 else 1.0)
        law.step(state, sample_of(BOTH, level, x, steady.u), want_prediction=False)
    # At rest on target nothing unwinds but by itself: the integral is within the rotors' means.
    assert np.abs(state.integral).max() < 20.0
    state = law.init(setup_of(BOTH, SAMPLE_TIME))
    answer = law.step(state, sample_of(BOTH, [30.0, 0.0]), want_prediction=False)
    assert answer.out_of_reach and "out of reach" in answer.message
    assert answer.status is Status.OK


def test_a_smooth_reference_is_followed_without_delay() -> None:
    """The lags of the reference cost time; a sine that is carried on does not pay it."""
    worst = []
    for forecast in (True, False):
        ran = close_loop(
            FeedbackLinearisation(forecast=forecast),
            BOTH,
            lambda t: np.column_stack([0.15 * np.sin(0.6 * t), 0.4 * np.sin(0.5 * t)]),
            30.0,
        )
        worst.append(np.abs(ran.errors[ran.at(12.0) :]).max(axis=0))
    assert np.all(worst[0] < 0.5 * worst[1])


@pytest.mark.parametrize("model", [FeedbackManual(), QuanserAero()], ids=["no thrust", "coupled"])
def test_what_cannot_be_inverted_is_refused(model: Model) -> None:
    with pytest.raises(ConfigurationError, match="cannot be inverted"):
        virtual_moments(model)
