"""feedback_linearisation: the poles that were chosen, its reference, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trms_cli.controllers.controller import Status
from trms_cli.controllers.feedback_linearisation import (
    FeedbackLinearisation,
    gains_of,
    virtual_moments,
)
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import discretise
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.steady_state import SteadyState

from .closed_loop_case import SAMPLE_TIME, close_loop, sample_of, setup_of

BOTH = Newtonian()
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
