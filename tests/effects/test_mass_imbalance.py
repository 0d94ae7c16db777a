"""An added mass: weight, inertia, centrifugal and Coriolis terms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.effects.mass_imbalance import MassImbalance
from trms_cli.models.newtonian import geometry

G = 9.80665


def values(model):
    c = {p.name: p.value for p in model.parameters}
    return c, geometry(c)


@given(
    mass=st.floats(0.001, 0.5),
    arm=st.floats(-0.5, 0.5),
    height=st.floats(-0.5, 0.5),
    rates=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
    pitch=st.floats(-1, 1),
)
@settings(max_examples=15, deadline=None)
def test_energy_and_yaw_momentum_are_those_of_the_body_with_the_mass(
    rig, mass, arm, height, rates, pitch
):
    inertia = 0.05
    model = rig.extended(
        rig.turntable(inertia=inertia), {"m": MassImbalance(mass=0.1, arm=0.1, height=0.1)}
    )
    model.parameters = model.parameters.replaced({"m.mass": mass, "m.arm": arm, "m.height": height})
    x = rig.simulate(model, np.zeros((100, 2)), start=[pitch, rates[0], 0, rates[1]], substeps=16)
    alpha, pitch_rate, _, yaw_rate = x[:, :4].T
    behind = arm * np.cos(alpha) + height * np.sin(alpha)
    above = height * np.cos(alpha) - arm * np.sin(alpha)
    about_yaw = inertia + mass * behind**2
    energy = (
        0.5 * (inertia + mass * (arm**2 + height**2)) * pitch_rate**2
        + 0.5 * about_yaw * yaw_rate**2
        + mass * G * above
    )
    np.testing.assert_allclose(energy, energy[0], atol=1e-6)
    np.testing.assert_allclose(about_yaw * yaw_rate, about_yaw[0] * yaw_rate[0], atol=1e-6)


@pytest.mark.parametrize(("arm", "height"), [(0.25, 0.0), (-0.2, 0.05), (0.1, -0.2)])
def test_the_resting_pitch_shifts_by_the_closed_form(rig, arm, height):
    base = rig.newtonian(freedom="vertical")
    model = rig.extended(base, {"m": MassImbalance(mass=0.015, arm=arm, height=height)})
    _, g = values(base)
    pitch = np.arctan2(g["A"] - g["B"] + 0.015 * arm, g["C"] - 0.015 * height)
    slope = rig.right_hand_side(model)([0, 0, pitch], [0], [0, 0])
    np.testing.assert_allclose(slope, 0, atol=1e-13)


def test_the_free_swing_slows_by_the_added_inertia(rig):
    base = rig.newtonian(freedom="vertical")
    model = rig.extended(base, {"m": MassImbalance(mass=0.03, arm=0.0, height=-0.25)})
    c, g = values(base)
    pitch = np.arctan2(g["A"] - g["B"], g["C"] + 0.03 * 0.25)
    stiffness = c["g"] * np.hypot(g["A"] - g["B"], g["C"] + 0.03 * 0.25)
    inertia = g["J_v"] + 0.03 * 0.25**2
    start = [0, 0, pitch + 0.01]
    x = rig.simulate(model, np.zeros((2000, 1)), step=0.01, start=start)
    swing = x[:, 2] - pitch
    k = np.flatnonzero((swing[:-1] > 0) & (swing[1:] <= 0))
    crossings = (k + swing[k] / (swing[k] - swing[k + 1])) * 0.01
    decay = c["k_ov"] / (2 * inertia)
    period = 2 * np.pi / np.sqrt(stiffness / inertia - decay**2)
    np.testing.assert_allclose(np.diff(crossings).mean(), period, rtol=1e-4)


def test_the_acceleration_of_the_rig_is_that_of_the_heavier_rig(rig):
    """Against (J + ΔJ) a = J a₀ + τ with a₀ of the rig without the mass, axis by axis."""
    base = rig.newtonian()
    mass, arm, height = 0.02, 0.2, -0.1
    model = rig.extended(base, {"m": MassImbalance(mass=mass, arm=arm, height=height)})
    c, _ = values(base)
    free, heavier = rig.accelerations(base), rig.accelerations(model)
    angles, generator = ("alpha_v", "alpha_h"), np.random.default_rng(0)
    for _ in range(10):
        x = generator.normal(size=6) * [100, 0.5, 0.5, 100, 0.5, 0.5]
        u, w = generator.normal(size=2), generator.normal(size=4) * 1e-3
        rates = rig.right_hand_side(base)(x, u, w)[[base.state_index(a) for a in angles]]
        known = rig.quantities(base, x)
        inertias = np.array([known["inertia_pitch"], known["inertia_yaw"]])
        alpha = x[base.state_index("alpha_v")]
        behind = arm * np.cos(alpha) + height * np.sin(alpha)
        above = height * np.cos(alpha) - arm * np.sin(alpha)
        torque = mass * np.array(
            [
                c["g"] * behind + behind * above * rates[1] ** 2,
                -2 * behind * above * rates[0] * rates[1],
            ]
        )
        added = mass * np.array([arm**2 + height**2, behind**2])
        expected = (inertias * free(x, u, w) + torque) / (inertias + added)
        np.testing.assert_allclose(heavier(x, u, w), expected, rtol=1e-10)


def test_friction_meets_the_heavier_rig_in_whatever_order_they_are_named(rig):
    mass = {"m": MassImbalance(mass=0.2, arm=0.0, height=0.5)}
    rub = {"f": rig.effect("pitch_coulomb_friction", torque=0.2)}
    u = np.zeros((40, 2))
    start = [0, 1.0]
    one = rig.simulate(rig.extended(rig.turntable(), mass | rub), u, start=start)
    other = rig.simulate(rig.extended(rig.turntable(), rub | mass), u, start=start)
    np.testing.assert_array_equal(one, other)
    # Near the top, after one step: (J + m h²) Δ rate = −F Δt + gravity's share of second order.
    fall = (one[1, 1] - 1.0) / 0.02
    np.testing.assert_allclose(fall, -0.2 / (0.05 + 0.2 * 0.25), rtol=0.06)
