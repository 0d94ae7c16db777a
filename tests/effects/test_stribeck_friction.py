"""Stribeck friction: break-away torque, falling branch, and Coulomb as its limit."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.stribeck_friction import StribeckFriction

INERTIA = 0.05


def friction(**sizes):
    given = {"axis": "yaw", "torque": 0.01, "excess": 0.5, "velocity": 0.03} | sizes
    return {"friction": StribeckFriction(**given)}


def falling(rate, torque=0.01, excess=0.5, velocity=0.03):
    return torque * (1 + excess * np.exp(-((rate / velocity) ** 2)))


def test_it_breaks_away_at_the_static_torque_and_not_before(rig):
    model = rig.extended(rig.turntable(inertia=INERTIA), friction())
    held = rig.simulate(model, np.tile([0, 0.015 * (1 - 1e-6)], (500, 1)))
    moved = rig.simulate(model, np.tile([0, 0.015 * (1 + 1e-3)], (500, 1)))
    assert np.abs(held[:, 2:]).max() < 1e-9
    # Once it moves the friction falls and it runs away.
    assert moved[-1, 3] > 0.1


def test_slip_equals_the_smooth_law_integrated_by_another_code(rig):
    model = rig.extended(rig.turntable(inertia=INERTIA), friction())
    x = rig.simulate(model, np.tile([0, 0.018], (250, 1)))
    reference = solve_ivp(
        lambda t, y: [y[1], (0.018 - falling(y[1])) / INERTIA],
        (0, 5),
        [0, 0],
        t_eval=np.arange(251) * 0.02,
        rtol=1e-10,
        atol=1e-13,
    )
    np.testing.assert_allclose(x[:, 2:].T, reference.y, atol=1e-7, rtol=5e-5)


def test_it_decelerates_into_a_stop_as_the_smooth_law_does(rig):
    model = rig.extended(rig.turntable(inertia=INERTIA), friction())
    x = rig.simulate(model, np.zeros((200, 2)), start=[0, 0, 0, 0.3])

    def rests(t, y):
        return y[1]

    rests.terminal = True
    reference = solve_ivp(
        lambda t, y: [y[1], -falling(y[1]) / INERTIA],
        (0, 5),
        [0, 0.3],
        events=rests,
        rtol=1e-10,
        atol=1e-13,
    )
    assert x[-1, 3] == 0.0
    np.testing.assert_allclose(x[-1, 2], reference.y[0, -1], atol=1e-5)


def test_without_excess_it_is_coulomb_friction_bit_for_bit(rig):
    u = rig.rich_input(1500)
    coulomb = rig.extended(rig.newtonian(), {"f": CoulombFriction(axis="yaw", torque=0.01)})
    stribeck = rig.extended(rig.newtonian(), friction(excess=0.0))
    np.testing.assert_array_equal(rig.simulate(stribeck, u), rig.simulate(coulomb, u))


def test_it_sticks_and_slips_under_a_slowly_pulled_spring(rig):
    """A soft spring that is pulled steadily: jumps, each from the break-away torque."""
    cable = {"cable": rig.effect("yaw_cable_stiffness", stiffness=0.05)}
    model = rig.extended(rig.turntable(inertia=INERTIA, damping=0.01), cable | friction())
    pull = np.column_stack([np.zeros(6000), 0.05 * 0.02 * np.arange(6000) * 0.02])
    x = rig.simulate(model, pull)
    rate = x[1:, 3]
    starts = np.flatnonzero((rate[:-1] < 1e-9) & (rate[1:] > 1e-7))
    assert len(starts) >= 3
    load = pull[starts, 1] - 0.05 * x[starts + 1, 2]
    np.testing.assert_allclose(load, 0.015, rtol=5e-3)


@given(
    rate=st.floats(-2, 2),
    torque=st.floats(0, 0.02),
    excess=st.floats(0, 1),
    velocity=st.floats(0.01, 0.1),
)
@settings(max_examples=80, deadline=None)
def test_it_takes_energy_and_never_reverses_the_motion(rig, rate, torque, excess, velocity):
    model = rig.extended(rig.turntable(inertia=INERTIA), friction())
    # The compiled step is the same for all sizes.
    model.parameters = model.parameters.replaced(
        {"friction.torque": torque, "friction.excess": excess, "friction.velocity": velocity}
    )
    x = rig.simulate(model, np.zeros((5, 2)), start=[0, 0, 0, rate], substeps=4)
    rates = x[:, 3]
    assert np.all(np.abs(rates[1:]) <= np.abs(rates[:-1]) + 1e-15)
    # At rest, rounding leaves some 1e-19 rad/s of either sign.
    assert np.all(rates * rate >= -1e-15 * rate**2)
