"""feedback_linearisation: the poles that were chosen, tracking, limits, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from closed_loop_case import SAMPLE_TIME, run, squares

from trms_cli.controllers.controller import ControlSample, ControlSetup, Status
from trms_cli.controllers.feedback_linearisation import (
    FeedbackLinearisation,
    gains_of,
    virtual_moments,
)
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.tras import Tras

BOTH = Newtonian()
RATES = (3.0, 2.5, 2.0, 0.7)


def sample_of(model: Model, x: np.ndarray, r: np.ndarray, u: np.ndarray) -> ControlSample:
    w = np.zeros(model.n_w)
    return ControlSample(0.0, r[None, :], Estimate(x, np.zeros_like(x), w, w), u)


def chosen_error(
    rates: tuple[float, ...], start: float, acceleration: float, times: np.ndarray
) -> np.ndarray:
    """The error from a standstill, by the polynomial's own state space."""
    from scipy.linalg import expm

    rotor, kd, kp, ki = gains_of(rates)
    # e, ė, ë and the integral: d³e/dt³ = −λ (ë + k_d ė + k_p e + I).
    A = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [-rotor * kp, -rotor * kd, -rotor, -rotor],
            [ki, 0.0, 0.0, 0.0],
        ]
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
    state = law.init(ControlSetup(model, period, steady.u))
    state.started = True
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
        u = law.step(state, sample_of(model, x, reference, u), want_prediction=False).u
        assert np.all(u > lower) and np.all(u < upper)
        errors.append(reference - x[angles])
        x = step.evaluate(x, u, model.parameters.values, np.zeros(model.n_w))[0].copy()
    found = np.array(errors)[:, moved]
    expected = chosen_error(RATES, offset, pull, np.arange(1500) * period)
    assert np.abs(found - expected).max() < 0.03 * offset
    assert np.abs(expected).min() < 0.5 * offset  # it has moved
    assert np.abs(np.array(errors)[:, 1 - moved]).max() < 0.05 * offset


@pytest.mark.parametrize(
    "model",
    [
        BOTH,
        Lagrangian(),
        Newtonian(freedom="vertical"),
        Newtonian(freedom="horizontal"),
        Newtonian(currents="dynamic"),
        Tras(),
    ],
    ids=["newtonian", "lagrangian", "vertical", "horizontal", "currents", "tras"],
)
def test_every_rotor_rig_is_followed(model: Model) -> None:
    trajectory = run(FeedbackLinearisation(), model, squares(model), 60.0)
    for angle in model.controlled:
        for error in trajectory.levels(angle):
            assert error.max() < 0.1 * (0.6 if angle == "alpha_v" else 1.0)
            assert np.abs(error[-100:]).max() < 5e-3


@pytest.mark.parametrize("equation", [0, 1])
def test_a_constant_torque_leaves_no_error(equation: int) -> None:
    level, push = np.array([0.1, 0.4]), np.eye(4)[equation] * 0.01
    trajectory = run(
        FeedbackLinearisation(), BOTH, lambda _: level, 45.0, lambda time: push * (time > 15.0)
    )
    disturbed = np.abs(trajectory.error(BOTH.controlled[equation]))
    assert disturbed[-100:].max() < 1e-3
    assert disturbed[round(15 / SAMPLE_TIME) :].max() > 0.005


def test_an_estimated_torque_is_met_at_once() -> None:
    level, push = np.array([0.1, 0.4]), np.array([0.005, 0.01, 0.0, 0.0])
    law = FeedbackLinearisation()
    state = law.init(ControlSetup(BOTH, SAMPLE_TIME, np.zeros(2)))
    steady = SteadyState(BOTH).solve(level, push)
    sample = sample_of(BOTH, steady.x, level, steady.u)
    sample.estimate.disturbance = push
    answer = law.step(state, sample, want_prediction=False)
    np.testing.assert_allclose(answer.u, steady.u, atol=0.02)


def test_an_input_at_its_limit_does_not_wind_up() -> None:
    level = np.array([0.2, 0.3])

    def pushed_for(length: float) -> np.ndarray:
        trajectory = run(
            FeedbackLinearisation(),
            BOTH,
            lambda _: level,
            15.0 + length + 12.0,
            lambda time: np.array([0.0, -0.11 if 15.0 < time < 15.0 + length else 0.0, 0.0, 0.0]),
        )
        return np.abs(trajectory.error("alpha_h"))[-round(3 / SAMPLE_TIME) :]

    short, long = pushed_for(6.0), pushed_for(25.0)
    assert long.max() < short.max() + 0.02
    assert long.max() < 0.05


def test_a_wild_estimate_does_no_lasting_harm() -> None:
    law = FeedbackLinearisation()
    level = np.array([0.1, 0.4])
    steady = SteadyState(BOTH).solve(level)
    states = [law.init(ControlSetup(BOTH, SAMPLE_TIME, steady.u)) for _ in range(2)]
    for k in range(400):
        for i, state in enumerate(states):
            x = steady.x * (1e9 if i and k == 5 else 1.0)
            answer = law.step(state, sample_of(BOTH, x, level, steady.u), want_prediction=False)
            assert np.all(np.abs(answer.u) <= 2.5)
    # At rest on target nothing unwinds but by itself: the integral is within the rotors' means.
    assert np.abs(states[1].integral).max() < 20.0


def test_a_smooth_reference_is_followed_without_delay() -> None:
    """The lags of the reference cost time; a sine that is carried on does not pay it."""
    worst = []
    for forecast in (True, False):
        trajectory = run(
            FeedbackLinearisation(forecast=forecast),
            BOTH,
            lambda time: np.array([0.15 * np.sin(0.6 * time), 0.4 * np.sin(0.5 * time)]),
            30.0,
        )
        late = slice(round(12 / SAMPLE_TIME), None)
        worst.append([np.abs(trajectory.error(name)[late]).max() for name in BOTH.controlled])
    assert np.all(np.array(worst[0]) < 0.5 * np.array(worst[1]))


def test_a_reference_out_of_reach_is_said() -> None:
    law = FeedbackLinearisation()
    state = law.init(ControlSetup(BOTH, SAMPLE_TIME, np.zeros(2)))
    answer = law.step(
        state,
        sample_of(BOTH, BOTH.rest(), np.array([30.0, 0.0]), np.zeros(2)),
        want_prediction=False,
    )
    assert answer.out_of_reach and "out of reach" in answer.message
    assert answer.status is Status.OK


@pytest.mark.parametrize("model", [FeedbackManual(), QuanserAero()], ids=["no thrust", "coupled"])
def test_what_cannot_be_inverted_is_refused(model: Model) -> None:
    with pytest.raises(ConfigurationError, match="cannot be inverted"):
        virtual_moments(model)


def test_both_axes_and_no_others_have_poles() -> None:
    with pytest.raises(ConfigurationError, match="axis"):
        FeedbackLinearisation(poles={"roll": RATES})
    with pytest.raises(ConfigurationError, match="yaw"):
        FeedbackLinearisation(poles={"pitch": RATES})
