"""Quadratic damping against its closed form."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.effects.quadratic_damping import QuadraticDamping


def test_decay_of_a_free_axis(rig):
    drag = {"drag": QuadraticDamping(axis="yaw", coefficient=0.02)}
    model = rig.extended(rig.turntable(inertia=0.05), drag)
    t = np.arange(501) * 0.02
    for rate in (1.5, -1.5):
        x = rig.simulate(model, np.zeros((500, 2)), start=[0, 0, 0, rate])
        slowing = 1 + 0.02 / 0.05 * 1.5 * t
        np.testing.assert_allclose(x[:, 3], rate / slowing, rtol=1e-9)
        angle = np.sign(rate) * 0.05 / 0.02 * np.log(slowing)
        np.testing.assert_allclose(x[:, 2], angle, rtol=1e-8, atol=1e-12)


def test_pitch_of_the_rig_equals_another_integration(rig):
    base = rig.newtonian()
    f = rig.right_hand_side(base)
    row = base.state_index("alpha_v")

    def slope(t, x):
        rate = f(x, [1.5, 0.2], [0, 0, 0, 0])[row]
        return f(x, [1.5, 0.2], [-0.02 * rate * abs(rate), 0, 0, 0])

    reference = solve_ivp(
        slope, (0, 10), base.rest(), t_eval=np.arange(501) * 0.02, rtol=1e-10, atol=1e-12
    )
    model = rig.extended(base, {"drag": QuadraticDamping(axis="pitch", coefficient=0.02)})
    x = rig.simulate(model, np.tile([1.5, 0.2], (500, 1)))
    np.testing.assert_allclose(x, reference.y.T, atol=1e-6)


@given(rate=st.floats(-3, 3), coefficient=st.floats(0, 0.05))
@settings(max_examples=50, deadline=None)
def test_it_takes_energy_and_never_reverses_the_motion(rig, rate, coefficient):
    drag = {"drag": QuadraticDamping(axis="yaw", coefficient=0.02)}
    model = rig.extended(rig.turntable(), drag)
    model.parameters = model.parameters.replaced({"drag.coefficient": coefficient})
    rates = rig.simulate(model, np.zeros((5, 2)), start=[0, 0, 0, rate])[:, 3]
    assert np.all(np.abs(rates[1:]) <= np.abs(rates[:-1]))
    assert np.all(rates * rate >= 0)
