"""Coulomb friction: exact slip, exact stop, no creep."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.core.compilation import BufferedFunction
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.models.discretisation import discretise


def friction(axis="yaw", torque=0.01):
    return {"friction": CoulombFriction(axis=axis, torque=torque)}


def test_a_turning_axis_decelerates_at_a_constant_rate_and_stops_for_good(rig):
    model = rig.extended(rig.turntable(inertia=0.05), friction())
    x = rig.simulate(model, np.zeros((400, 2)), start=[0, 0, 0, 1.0])
    t = np.arange(401) * 0.02
    rate = np.maximum(1.0 - 0.01 / 0.05 * t, 0.0)  # stops after 5 s and 2.5 rad
    np.testing.assert_allclose(x[:, 3], rate, atol=1e-12)
    np.testing.assert_allclose(x[-1, 2], 2.5, atol=1e-4)
    stopped = t > 5.02
    assert np.all(x[stopped, 3] == 0.0)
    assert np.ptp(x[stopped, 2]) == 0.0


def test_an_axis_at_rest_under_a_load_below_the_torque_does_not_creep(rig):
    w = np.array([0.0, 0.004, 0.0, 0.0])
    model = rig.extended(rig.newtonian(), friction(torque=0.005))
    x = rig.simulate(model, np.zeros((3000, 2)), w=w)
    yaw = x[:, model.state_index("alpha_h")]
    # 60 s. A smoothed sign of 0.05 rad/s would have crept by 2.4 rad.
    assert np.abs(yaw).max() < 1e-8


def test_pitch_against_its_gravity_spring_does_not_creep(rig):
    model = rig.extended(rig.newtonian(), friction("pitch", 0.02))
    start = model.rest()
    row = model.state_index("alpha_v")
    start[row] += 0.05  # 0.05 rad · 0.265 N m/rad = 0.013 N m
    x = rig.simulate(model, np.zeros((3000, 2)), start=start)
    assert np.abs(x[:, row] - start[row]).max() < 1e-6


def test_it_breaks_away_at_the_torque(rig):
    model = rig.extended(rig.turntable(inertia=0.05), friction())
    held = rig.simulate(model, np.tile([0, 0.01 * (1 - 1e-9)], (100, 1)))
    moved = rig.simulate(model, np.tile([0, 0.015], (100, 1)))
    assert np.abs(held[:, 3]).max() == 0.0
    np.testing.assert_allclose(moved[-1, 3], (0.015 - 0.01) / 0.05 * 2.0, rtol=1e-9)
    np.testing.assert_allclose(moved[-1, 2], 0.5 * 0.1 * 2.0**2, rtol=1e-9)


def test_the_slip_of_the_rig_equals_an_event_located_solution(rig):
    base = rig.newtonian()
    f = rig.right_hand_side(base)
    yaw, spin = base.state_index("alpha_h"), base.state_index("S_h")
    start = base.rest()
    start[spin] = 1.0

    def turns(t, x):
        return f(x, [1.2, 0.3], [0, 0, 0, 0])[yaw]

    turns.terminal = True
    reference = solve_ivp(
        lambda t, x: f(x, [1.2, 0.3], [0, -0.01, 0, 0]),
        (0, 20),
        start,
        events=turns,
        rtol=1e-10,
        atol=1e-12,
        dense_output=True,
    )
    stop = reference.t_events[0][0]
    samples = int(stop / 0.02)
    expected = reference.sol(np.arange(samples + 1) * 0.02).T
    assert samples > 40
    # Of first order: the inertia moves with the pitch over a substep. Friction itself changes the
    # rate by 0.4 rad/s here.
    model, u = rig.extended(base, friction()), np.tile([1.2, 0.3], (samples, 1))
    for substeps, tolerance in ((4, 2e-4), (16, 5e-5)):
        x = rig.simulate(model, u, substeps=substeps, start=start)
        np.testing.assert_allclose(x, expected, atol=tolerance)


@pytest.mark.parametrize("freedom", ["both", "vertical", "horizontal"])
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_it_takes_energy_and_never_reverses_the_motion(rig, step_of, freedom, data):
    axis = {"both": "yaw", "vertical": "pitch", "horizontal": "yaw"}[freedom]
    with_friction, without, model, rate_of = step_of(freedom, axis)
    spread = st.floats(-1.5, 1.5)
    x = np.array([data.draw(spread) for _ in range(model.n_x)])
    u = np.array([data.draw(st.floats(-2.5, 2.5)) for _ in range(model.n_u)])
    torque = data.draw(st.floats(0, 0.05))
    w = np.zeros(model.n_w)
    p = model.parameters.replaced({"friction.torque": torque}).values
    free = without(x, u, p[:-1], w)[0].copy()
    rubbed = with_friction(x, u, p, w)[0].copy()
    before, after = rate_of(free), rate_of(rubbed)
    assert abs(after) <= abs(before) + 1e-12
    assert after * before >= -1e-12


@pytest.fixture(scope="module")
def step_of(rig):
    kept = {}

    def make(freedom, axis):
        if freedom not in kept:
            base = rig.newtonian(freedom=freedom)
            model = rig.extended(base, friction(axis))
            f = rig.right_hand_side(base)
            row = base.state_index(base.axes[axis].angle)
            steps = [BufferedFunction(discretise(m, 0.005, 1).step).evaluate for m in (model, base)]
            rate = lambda x: f(x, np.zeros(base.n_u), np.zeros(base.n_w))[row]  # noqa: E731
            kept[freedom] = (*steps, model, rate)
        return kept[freedom]

    return make
