"""The maker's model: its dry friction, its steady states; its eigenvalues are in test_local."""

import numpy as np
import pytest

from trms_cli.models.feedback_manual import FeedbackManual

from .simulate import rates, simulate


def test_rests_hanging_below_level():
    model = FeedbackManual()
    x = model.rest()
    assert dict(zip(model.state_names, x, strict=True))["alpha_v"] == pytest.approx(-0.6194)
    assert rates(model, x) == pytest.approx(np.zeros(7), abs=1e-15)


def test_a_command_raises_the_beam_to_where_its_moment_holds_it():
    # Without dry friction, which would let it stop a little short.
    p = {q.name: q.value for q in FeedbackManual().parameters}
    states = simulate(FeedbackManual(dry_friction=False), lambda t: [0.6, 0.0], 200.0, 0.02)
    tau = p["k_1"] * 0.6
    moment = p["a_1"] * tau**2 + p["b_1"] * tau
    rest = np.arcsin(moment / p["M_g"]) - p["psi_0"]
    # Yaw turns under the main rotor's reaction, which the gyroscopic term gives back to pitch.
    yaw_rate = -(p["k_c"] * tau) / p["B_1phi"]
    psi = states["alpha_v"][-1] + p["psi_0"]
    balance = moment - p["M_g"] * np.sin(psi) - p["K_gy"] * moment * yaw_rate * np.cos(psi)
    assert balance == pytest.approx(0.0, abs=1e-5)
    assert states["S_h"][-1] == pytest.approx(yaw_rate, rel=1e-5)
    assert abs(states["alpha_v"][-1] - rest) < 0.1


def test_the_reaction_leads_and_settles_as_its_transfer_function_says():
    # M_R/τ_1 = k_c (T_0 s + 1)/(T_p s + 1): k_c T_0/T_p at once, k_c in the end.
    model = FeedbackManual(dry_friction=False)
    p = {q.name: q.value for q in model.parameters}
    x = model.rest()
    x[3] = 1.0  # τ_1
    at_once = -rates(model, x)[1] * p["I_2"]
    x[6] = 1.0  # the lagged part has followed
    in_the_end = -rates(model, x)[1] * p["I_2"]
    assert at_once == pytest.approx(p["k_c"] * p["T_0"] / p["T_p"])
    assert in_the_end == pytest.approx(p["k_c"])


def test_dry_friction_holds_yaw_against_less_than_its_torque():
    p = {q.name: q.value for q in FeedbackManual().parameters}
    stuck = 0.9 * p["B_2phi"] / p["b_2"] / p["k_2"]  # moment a little below B_2φ
    held = simulate(FeedbackManual(), lambda t: [0.0, stuck], 10.0, 0.02)
    # The impulse is exact to the third order of the step: it creeps by 2 µrad/s.
    assert np.abs(held["alpha_h"]).max() < 1e-4
    free = simulate(FeedbackManual(dry_friction=False), lambda t: [0.0, stuck], 10.0, 0.02)
    assert free["alpha_h"][-1] > 0.3
    moving = simulate(FeedbackManual(), lambda t: [0.0, 3 * stuck], 60.0, 0.02)
    tau = p["k_2"] * 3 * stuck
    driven = p["a_2"] * tau**2 + p["b_2"] * tau - p["B_2phi"]
    assert moving["S_h"][-1] == pytest.approx(driven / p["B_1phi"], rel=1e-4)


def test_dry_friction_ends_a_free_swing_in_finite_time():
    states = simulate(FeedbackManual(), lambda t: [0.0, 0.0], 120.0, 0.02, start={"alpha_v": -0.5})
    assert np.all(states["S_v"][-50:] == states["S_v"][-1])
    assert abs(states["S_v"][-1]) < 1e-12
