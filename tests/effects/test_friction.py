"""Friction and damping: exact slip, exact stop, no creep; the falling branch; closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.compilation import BufferedFunction
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.quadratic_damping import QuadraticDamping
from trms_cli.effects.rotor_friction import RotorFriction
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.discretisation import discretise


def coulomb(axis="yaw", torque=0.01):
    return {"friction": CoulombFriction(axis=axis, torque=torque)}


def test_a_turning_axis_decelerates_at_a_constant_rate_and_stops_for_good(rig):
    model = rig.extended(rig.turntable(inertia=0.05), coulomb())
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
    model = rig.extended(rig.newtonian(), coulomb(torque=0.005))
    x = rig.simulate(model, np.zeros((3000, 2)), w=w)
    yaw = x[:, model.state_index("alpha_h")]
    # 60 s. A smoothed sign of 0.05 rad/s would have crept by 2.4 rad.
    assert np.abs(yaw).max() < 1e-8
    # Nor does pitch against its gravity spring.
    model = rig.extended(rig.newtonian(), coulomb("pitch", 0.02))
    start = model.rest()
    row = model.state_index("alpha_v")
    start[row] += 0.05  # 0.05 rad · 0.265 N m/rad = 0.013 N m
    x = rig.simulate(model, np.zeros((3000, 2)), start=start)
    assert np.abs(x[:, row] - start[row]).max() < 1e-6


def test_coulomb_friction_breaks_away_at_the_torque(rig):
    model = rig.extended(rig.turntable(inertia=0.05), coulomb())
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

    stop, _ = rig.exactly(
        lambda t, x: f(x, [1.2, 0.3], [0, -0.01, 0, 0]),
        start,
        1000,
        event=lambda t, x: f(x, [1.2, 0.3], [0, 0, 0, 0])[yaw],
    )
    samples = int(stop / 0.02)
    expected = rig.exactly(lambda t, x: f(x, [1.2, 0.3], [0, -0.01, 0, 0]), start, samples)
    assert samples > 40
    # Of first order: the inertia moves with the pitch over a substep. Friction itself changes the
    # rate by 0.4 rad/s here.
    model, u = rig.extended(base, coulomb()), np.tile([1.2, 0.3], (samples, 1))
    for substeps, tolerance in ((4, 2e-4), (16, 5e-5)):
        x = rig.simulate(model, u, substeps=substeps, start=start)
        np.testing.assert_allclose(x, expected, atol=tolerance)


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_friction_on_the_rig_takes_energy_and_never_reverses_the_motion(steps, data):
    with_friction, without, model, rate_of = steps
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


@pytest.fixture(scope="module", params=["both", "vertical", "horizontal"])
def steps(rig, request):
    """A step with friction and one without, the model with it, and the rate of its axis."""
    base = rig.newtonian(freedom=request.param)
    axis = "pitch" if request.param == "vertical" else "yaw"
    model = rig.extended(base, coulomb(axis))
    f, row = rig.right_hand_side(base), base.state_index(base.axes[axis].angle)
    with_friction, without = (
        BufferedFunction(discretise(m, 0.005, 1).step).evaluate for m in (model, base)
    )
    return (
        with_friction,
        without,
        model,
        lambda x: f(x, np.zeros(base.n_u), np.zeros(base.n_w))[row],
    )


# -- Stribeck

INERTIA = 0.05


def stribeck(**sizes):
    given = {"axis": "yaw", "torque": 0.01, "excess": 0.5, "velocity": 0.03} | sizes
    return {"friction": StribeckFriction(**given)}


def falling(rate, torque=0.01, excess=0.5, velocity=0.03):
    return torque * (1 + excess * np.exp(-((rate / velocity) ** 2)))


def test_it_breaks_away_at_the_static_torque_and_not_before(rig):
    model = rig.extended(rig.turntable(inertia=INERTIA), stribeck())
    held = rig.simulate(model, np.tile([0, 0.015 * (1 - 1e-6)], (500, 1)))
    moved = rig.simulate(model, np.tile([0, 0.015 * (1 + 1e-3)], (500, 1)))
    assert np.abs(held[:, 2:]).max() < 1e-9
    # Once it moves the friction falls and it runs away.
    assert moved[-1, 3] > 0.1


def test_slip_equals_the_smooth_law_integrated_by_another_code(rig):
    model = rig.extended(rig.turntable(inertia=INERTIA), stribeck())
    x = rig.simulate(model, np.tile([0, 0.018], (250, 1)))
    expected = rig.exactly(lambda t, y: [y[1], (0.018 - falling(y[1])) / INERTIA], [0, 0], 250)
    np.testing.assert_allclose(x[:, 2:], expected, atol=1e-7, rtol=5e-5)


def test_it_decelerates_into_a_stop_as_the_smooth_law_does(rig):
    model = rig.extended(rig.turntable(inertia=INERTIA), stribeck())
    x = rig.simulate(model, np.zeros((200, 2)), start=[0, 0, 0, 0.3])

    _, stopped = rig.exactly(
        lambda t, y: [y[1], -falling(y[1]) / INERTIA], [0, 0.3], 250, event=lambda t, y: y[1]
    )
    assert x[-1, 3] == 0.0
    np.testing.assert_allclose(x[-1, 2], stopped[0], atol=1e-5)


def test_without_excess_it_is_coulomb_friction_bit_for_bit(rig):
    u = rig.rich_input(1500)
    runs = [
        rig.simulate(rig.extended(rig.newtonian(), effect), u)
        for effect in (coulomb(), stribeck(excess=0.0))
    ]
    np.testing.assert_array_equal(*runs)


def test_it_sticks_and_slips_under_a_slowly_pulled_spring(rig):
    """A soft spring that is pulled steadily: jumps, each from the break-away torque."""
    cable = {"cable": rig.effect("yaw_cable_stiffness", stiffness=0.05)}
    model = rig.extended(rig.turntable(inertia=INERTIA, damping=0.01), cable | stribeck())
    pull = np.column_stack([np.zeros(6000), 0.05 * 0.02 * np.arange(6000) * 0.02])
    x = rig.simulate(model, pull)
    rate = x[1:, 3]
    starts = np.flatnonzero((rate[:-1] < 1e-9) & (rate[1:] > 1e-7))
    assert len(starts) >= 3
    load = pull[starts, 1] - 0.05 * x[starts + 1, 2]
    np.testing.assert_allclose(load, 0.015, rtol=5e-3)


# -- damping


def test_quadratic_damping_of_a_free_axis(rig):
    drag = {"drag": QuadraticDamping(axis="yaw", coefficient=0.02)}
    model = rig.extended(rig.turntable(inertia=0.05), drag)
    t = np.arange(501) * 0.02
    for rate in (1.5, -1.5):
        x = rig.simulate(model, np.zeros((500, 2)), start=[0, 0, 0, rate])
        slowing = 1 + 0.02 / 0.05 * 1.5 * t
        np.testing.assert_allclose(x[:, 3], rate / slowing, rtol=1e-9)
        angle = np.sign(rate) * 0.05 / 0.02 * np.log(slowing)
        np.testing.assert_allclose(x[:, 2], angle, rtol=1e-8, atol=1e-12)


def test_quadratic_damping_of_the_pitch_equals_another_integration(rig):
    base = rig.newtonian()
    f = rig.right_hand_side(base)
    row = base.state_index("alpha_v")

    def slope(t, x):
        rate = f(x, [1.5, 0.2], [0, 0, 0, 0])[row]
        return f(x, [1.5, 0.2], [-0.02 * rate * abs(rate), 0, 0, 0])

    expected = rig.exactly(slope, base.rest(), 500)
    model = rig.extended(base, {"drag": QuadraticDamping(axis="pitch", coefficient=0.02)})
    x = rig.simulate(model, np.tile([1.5, 0.2], (500, 1)))
    np.testing.assert_allclose(x, expected, atol=1e-6)


#: Effects that only take energy, their largest sizes, and what rounding leaves at rest.
TAKING = [
    (stribeck(), {"friction.torque": 0.02, "friction.excess": 1, "friction.velocity": 0.1}, 1e-15),
    ({"drag": QuadraticDamping(axis="yaw", coefficient=0.02)}, {"drag.coefficient": 0.05}, 0.0),
]


@pytest.mark.parametrize(("effect", "largest", "rounding"), TAKING, ids=["stribeck", "quadratic"])
@given(rate=st.floats(-3, 3), shares=st.tuples(*[st.floats(0.1, 1)] * 3), absent=st.booleans())
@settings(max_examples=60, deadline=None)
def test_it_takes_energy_and_never_reverses_the_motion(
    rig, effect, largest, rounding, rate, shares, absent
):
    model = rig.extended(rig.turntable(inertia=INERTIA), effect)
    # The compiled step is the same for all sizes.
    sizes = {key: size * share for (key, size), share in zip(largest.items(), shares, strict=False)}
    sizes[next(iter(sizes))] *= not absent
    model.parameters = model.parameters.replaced(sizes)
    rates = rig.simulate(model, np.zeros((5, 2)), start=[0, 0, 0, rate])[:, 3]
    assert np.all(np.abs(rates[1:]) <= np.abs(rates[:-1]) + rounding)
    assert np.all(rates * rate >= -rounding * rate**2)


# -- of a rotor


def of_rotor(torque, rotor="tail"):
    return {"friction": RotorFriction(rotor=rotor, torque=torque)}


def held_torque(model, voltage):
    """Torque of the tail's motor at rest, N m."""
    c = {p.name: p.value for p in model.parameters}
    return c["kphi"] * c["k_uh"] * voltage / c["R"]


@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_a_rotor_stands_until_the_motor_is_stronger(rig, currents):
    base = rig.newtonian(currents=currents)
    row = base.state_index("omega_h")
    u = np.tile([0.0, 0.06], (300, 1))
    torque = held_torque(base, 0.06)
    held = rig.simulate(rig.extended(base, of_rotor(torque * 1.01)), u)
    moved = rig.simulate(rig.extended(base, of_rotor(torque * 0.9)), u)
    assert np.abs(held[:, row]).max() < 1e-9
    assert moved[-1, row] > 0.1


@pytest.mark.parametrize("direction", [1, -1])
def test_the_steady_speed_is_that_of_the_balance_of_torques(rig, direction):
    base = rig.newtonian()
    c = {p.name: p.value for p in base.parameters}
    voltage, torque = direction * 0.8, 0.001
    drag = c["k_thp"] if direction > 0 else c["k_thn"]
    # kφ (k_u u − kφ ω)/R − B ω − k ω² − F_c = 0
    linear = c["kphi"] ** 2 / c["R"] + c["B_tr"]
    speed = np.roots([drag, linear, torque - held_torque(base, abs(voltage))]).max()
    x = rig.simulate(rig.extended(base, of_rotor(torque)), np.tile([0, voltage], (1500, 1)))
    assert x[-1, base.state_index("omega_h")] == pytest.approx(direction * speed, rel=1e-6)


@pytest.mark.parametrize("rotor", ["main", "tail"])
def test_it_stops_for_good_after_a_finite_time(rig, rotor):
    base = rig.newtonian()
    row = base.state_index({"main": "omega_v", "tail": "omega_h"}[rotor])
    start = base.rest()
    start[row] = 60.0
    x = rig.simulate(rig.extended(base, of_rotor(0.002, rotor)), np.zeros((1000, 2)), start=start)[
        :, row
    ]
    assert np.all(np.diff(x) < 1e-12)
    stopped = int(np.argmax(x < 1e-9))
    assert 0 < stopped * 0.02 < 5.2  # without drag: J ω/F_c = 5.2 s for the main rotor
    assert np.abs(x[stopped + 1 :]).max() < 1e-12


def test_stiff_and_quasi_static_currents_agree(rig):
    u = rig.rich_input(300)
    names = ("omega_h", "alpha_h", "omega_v", "alpha_v")
    runs = []
    for currents in ("quasi_static", "dynamic"):
        base = rig.newtonian(currents=currents)
        model = rig.extended(base, of_rotor(0.001) | {"main": of_rotor(0.001, "main")["friction"]})
        x = rig.simulate(model, u, substeps=8)
        runs.append(x[:, [model.state_index(name) for name in names]])
    scale = np.abs(runs[0]).max(axis=0)
    assert (np.abs(runs[0] - runs[1]) / scale).max() < 5e-3


def test_a_zero_crossing_command_tells_it_from_a_dead_zone(rig):
    """A dead zone lets the rotor coast; friction goes on braking it."""
    base = rig.newtonian()
    row = base.state_index("omega_h")
    u = np.zeros((200, 2))
    u[:100, 1] = 0.8
    torque = 0.0012
    width = torque / held_torque(base, 1.0)
    rubbed = rig.simulate(rig.extended(base, of_rotor(torque)), u)[:, row]
    dead = rig.simulate(rig.extended(base, {"d": rig.effect("tail_dead_zone", width=width)}), u)[
        :, row
    ]
    assert rubbed[100] == pytest.approx(dead[100], rel=1e-3)  # equal while the command stands
    assert rubbed[150] < 0.9 * dead[150]
