"""Cable stiffness: frequency, hardening, free angle."""

import numpy as np
from scipy.integrate import solve_ivp

from trms_cli.effects.cable_stiffness import CableStiffness


def test_a_linear_cable_swings_about_its_free_angle(rig):
    cable = {"cable": CableStiffness(axis="yaw", stiffness=0.02, neutral=0.2)}
    model = rig.extended(rig.turntable(inertia=0.05), cable)
    t = np.arange(501) * 0.02
    x = rig.simulate(model, np.zeros((500, 2)))
    frequency = np.sqrt(0.02 / 0.05)
    np.testing.assert_allclose(x[:, 2], 0.2 * (1 - np.cos(frequency * t)), atol=1e-9)


def test_a_hardening_cable_equals_another_integration(rig):
    cable = {"cable": CableStiffness(axis="yaw", stiffness=0.005, cubic=0.03, neutral=-0.1)}
    model = rig.extended(rig.turntable(inertia=0.05), cable)
    reference = solve_ivp(
        lambda t, y: [y[1], -(0.005 * (y[0] + 0.1) + 0.03 * (y[0] + 0.1) ** 3) / 0.05],
        (0, 10),
        [1.0, 0.0],
        t_eval=np.arange(501) * 0.02,
        rtol=1e-11,
        atol=1e-12,
    )
    x = rig.simulate(model, np.zeros((500, 2)), start=[0, 0, 1.0, 0])
    np.testing.assert_allclose(x[:, 2:].T, reference.y, atol=1e-8)


def test_it_adds_to_the_stiffness_that_the_model_has(rig):
    base = rig.newtonian(freedom="horizontal")
    model = rig.extended(base, {"cable": CableStiffness(axis="yaw", stiffness=0.01)})
    p = base.parameters
    f, added = rig.right_hand_side(base), rig.right_hand_side(model)
    x = np.array([0.0, 0.0, 0.5])
    spin = base.state_index("S_h")
    ratio = added(x, [0], [0, 0])[spin] / f(x, [0], [0, 0])[spin]
    np.testing.assert_allclose(ratio, (p["k_chp"].value + 0.01) / p["k_chp"].value)
