"""The cable: stiffness by frequency, hardening and free angle; hysteresis by Bouc and Wen."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp, trapezoid
from scipy.optimize import brentq

from trms_cli.effects.cable_hysteresis import CableHysteresis
from trms_cli.effects.cable_stiffness import CableStiffness


def test_a_linear_cable_swings_about_its_free_angle(rig):
    cable = {"cable": CableStiffness(axis="yaw", stiffness=0.02, neutral=0.2)}
    model = rig.extended(rig.turntable(inertia=0.05), cable)
    t = np.arange(501) * 0.02
    x = rig.simulate(model, np.zeros((500, 2)))
    frequency = np.sqrt(0.02 / 0.05)
    np.testing.assert_allclose(x[:, 2], 0.2 * (1 - np.cos(frequency * t)), atol=1e-9)
    # One that hardens equals another integration.
    cable = {"cable": CableStiffness(axis="yaw", stiffness=0.005, cubic=0.03, neutral=-0.1)}
    model = rig.extended(rig.turntable(inertia=0.05), cable)
    expected = rig.exactly(
        lambda t, y: [y[1], -(0.005 * (y[0] + 0.1) + 0.03 * (y[0] + 0.1) ** 3) / 0.05], [1, 0], 500
    )
    x = rig.simulate(model, np.zeros((500, 2)), start=[0, 0, 1.0, 0])
    np.testing.assert_allclose(x[:, 2:], expected, atol=1e-8)


def test_it_adds_to_the_stiffness_that_the_model_has(rig):
    base = rig.newtonian(freedom="horizontal")
    model = rig.extended(base, {"cable": CableStiffness(axis="yaw", stiffness=0.01)})
    p = base.parameters
    f, added = rig.right_hand_side(base), rig.right_hand_side(model)
    x = np.array([0.0, 0.0, 0.5])
    spin = base.state_index("S_h")
    ratio = added(x, [0], [0, 0])[spin] / f(x, [0], [0, 0])[spin]
    np.testing.assert_allclose(ratio, (p["k_chp"].value + 0.01) / p["k_chp"].value)


TORQUE, WIDTH = 0.008, 0.1


def forced(rig, beta=0.5, exponent=1.0, periods=12, drive=0.03, per_period=500):
    """Angle and memory of a turntable under a sinusoidal torque of 5 s period."""
    cable = {
        "cable": CableHysteresis(
            axis="yaw", torque=TORQUE, width=WIDTH, beta=beta, exponent=exponent
        )
    }
    model = rig.extended(rig.turntable(inertia=0.05, damping=0.02), cable)
    t = np.arange(periods * per_period) * 5.0 / per_period
    u = np.column_stack([np.zeros_like(t), drive * np.sin(2 * np.pi * t / 5.0)])
    x = rig.simulate(model, u, step=5.0 / per_period)
    return x[:, 2], x[:, 4]


def loop(peak):
    """Path length and area of half a symmetric loop of unit width and height (β = 1/2, n = 1)."""
    length = peak - np.log(1 - peak)
    return length, -np.log(1 - peak) - peak - peak**2 / 2


def test_the_loop_closes_and_has_the_area_of_the_closed_form(rig):
    angle, z = forced(rig)
    last, before = slice(-501, None), slice(-1001, -500)
    np.testing.assert_allclose(z[last], z[before], atol=2e-4)
    amplitude = np.ptp(angle[last]) / 2
    peak = brentq(lambda q: loop(q)[0] - 2 * amplitude / WIDTH, 1e-9, 1 - 1e-12)
    np.testing.assert_allclose(np.abs(z[last]).max(), peak, atol=1e-3)
    area = trapezoid(TORQUE * z[last], angle[last])
    np.testing.assert_allclose(area, 2 * TORQUE * WIDTH * loop(peak)[1], rtol=2e-3)


@pytest.mark.parametrize(("beta", "exponent"), [(0.5, 1.0), (1.0, 1.0), (0.7, 2.0)])
def test_it_depends_on_the_path_and_not_on_the_speed(rig, beta, exponent):
    """The memory follows from the travelled angle alone, integrated over angle by another code."""
    angle, z = forced(rig, beta, exponent, periods=2)
    value, followed = 0.0, [0.0]
    for travel in np.diff(angle):
        sense = np.sign(travel)
        solution = solve_ivp(
            lambda s, q, sense=sense: (
                (sense - abs(q) ** exponent * (beta * np.sign(q) + (1 - beta) * sense)) / WIDTH
            ),
            (0, abs(travel)),
            [value],
            rtol=1e-9,
            atol=1e-11,
        )
        value = solution.y[0, -1]
        followed.append(value)
    np.testing.assert_allclose(z, followed, atol=1e-3)


def test_at_small_strokes_it_is_a_spring(rig):
    angle, z = forced(rig, drive=1e-5, periods=1)
    np.testing.assert_allclose(z, angle / WIDTH, atol=0.02 * np.abs(z).max())


@given(
    beta=st.sampled_from([0.5, 0.75, 1.0]),
    exponent=st.sampled_from([1.0, 2.0]),
    rate=st.floats(-3, 3),
    memory=st.floats(-1, 1),
    width=st.floats(0.05, 0.3),
)
@settings(max_examples=60, deadline=None)
def test_the_memory_stays_within_its_bounds(rig, beta, exponent, rate, memory, width):
    cable = CableHysteresis(axis="yaw", torque=TORQUE, width=0.1, beta=beta, exponent=exponent)
    model = rig.extended(rig.turntable(), {"cable": cable})
    model.parameters = model.parameters.replaced({"cable.width": width})
    x = rig.simulate(model, np.zeros((50, 2)), start=[0, 0, 0, rate, memory])
    assert np.abs(x[:, 4]).max() <= 1 + 1e-6
