"""What a command passes: a lag, a delay of any fraction of a sample, a dead zone, derating."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.effects.actuator_lag import ActuatorLag
from trms_cli.effects.dead_zone import DeadZone
from trms_cli.effects.first_order import first_order
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.supply_derating import SupplyDerating


def lag(seconds, rotor="tail"):
    return {"lag": ActuatorLag(rotor=rotor, time_constant=seconds)}


@given(seconds=st.floats(1e-4, 0.5), substeps=st.sampled_from([1, 4]))
@settings(max_examples=40, deadline=None)
def test_a_step_arrives_as_an_exponential_with_exact_momentum(rig, seconds, substeps):
    model = rig.extended(rig.turntable(inertia=0.05), lag(0.1))
    model.parameters = model.parameters.replaced({"lag.time_constant": seconds})
    x = rig.simulate(model, np.tile([0, 1.0], (50, 1)), substeps=substeps)
    t = np.arange(51) * 0.02
    np.testing.assert_allclose(x[:, -1], 1 - np.exp(-t / seconds), atol=1e-12)
    momentum = t - seconds * (1 - np.exp(-t / seconds))
    np.testing.assert_allclose(x[:, 3], momentum / 0.05, atol=1e-10)


@pytest.mark.parametrize("rotor", ["main", "tail"])
def test_the_rig_behind_a_lag_equals_another_integration(rig, rotor):
    base = rig.newtonian()
    f = rig.right_hand_side(base)
    channel = {"main": 0, "tail": 1}[rotor]

    def slope(t, z):
        u = np.array([1.4, 0.5])
        u[channel] = z[6]
        return [*f(z[:6], u, [0, 0, 0, 0]), ([1.4, 0.5][channel] - z[6]) / 0.08]

    expected = rig.exactly(slope, [*base.rest(), 0], 200)
    x = rig.simulate(rig.extended(base, lag(0.08, rotor)), np.tile([1.4, 0.5], (200, 1)))
    np.testing.assert_allclose(x, expected, atol=2e-3, rtol=1e-5)
    np.testing.assert_allclose(x[:, 2:3], expected[:, 2:3], atol=3e-6)


def test_without_a_time_constant_it_is_the_command_and_has_finite_slopes():
    v, u, tau = (ca.SX.sym(name) for name in ("v", "u", "tau"))
    mean, after = first_order(v, u, tau, 0.005)
    values = ca.Function("f", [v, u, tau], [mean, after])
    slopes = ca.Function(
        "J", [v, u, tau], [ca.jacobian(ca.vertcat(mean, after), ca.vertcat(v, u, tau))]
    )
    for command in (0.1, 1 / 3, -2.5):
        assert [float(v) for v in values(0.7, command, 0.0)] == [command, command]
    assert np.all(np.isfinite(np.asarray(slopes(0.7, 0.1, 0.0))))
    # The mean over the window falls short by the lag itself.
    np.testing.assert_allclose(float(slopes(0.7, 0.1, 0.0)[0, 2]), (0.7 - 0.1) / 0.005)


STEP = 0.02


def delay(seconds, longest=0.1, rotor="tail"):
    return {"delay": InputDelay(rotor=rotor, delay=seconds, longest=longest)}


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_a_delay_of_whole_samples_is_a_shifted_input(rig, steps):
    u = rig.rich_input(600)
    shifted = u.copy()
    shifted[:, 1] = np.concatenate([np.zeros(steps), u[:-steps, 1]])
    model = rig.extended(rig.newtonian(), delay(steps * STEP))
    x = rig.simulate(model, u)[:, :6]
    np.testing.assert_allclose(x, rig.simulate(rig.newtonian(), shifted), atol=1e-9)


@given(seconds=st.floats(0, 0.1), seed=st.integers(0, 100), substeps=st.sampled_from([1, 3, 4]))
@settings(max_examples=60, deadline=None)
def test_a_delay_of_any_fraction_gives_the_exact_momentum(rig, seconds, seed, substeps):
    """A turntable's rate is the integral of the command that arrived so far."""
    u = np.random.default_rng(seed).normal(size=(40, 2))
    model = rig.extended(rig.turntable(inertia=0.05), delay(0.05))
    model.parameters = model.parameters.replaced({"delay.delay": seconds})
    rate = rig.simulate(model, u, substeps=substeps)[:, 3]
    t = np.arange(41) * STEP
    integral = np.interp(t - seconds, t, np.concatenate([[0], np.cumsum(u[:, 1] * STEP)]))
    np.testing.assert_allclose(rate, integral / 0.05, atol=1e-10)


def zone(width, rotor="main"):
    return {"zone": DeadZone(rotor=rotor, width=width)}


@given(u=st.floats(-2.5, 2.5), width=st.floats(0, 1))
def test_the_map_is_continuous_and_odd_and_loses_the_width(rig, u, width):
    model = rig.extended(rig.newtonian(), zone(0.1))
    commands, parameters = ca.SX.sym("u", 2), ca.SX.sym("p", len(model.parameters))
    arriving, _ = model.input_path(ca.SX.zeros(0, 1), commands, parameters, (0.0, 1.0), 0.02)
    v = ca.Function("v", [commands, parameters], [arriving])
    p = model.parameters.replaced({"zone.width": width}).values
    got = float(v([u, 0.3], p)[0])
    assert got == -float(v([-u, 0.3], p)[0])
    assert np.isclose(got, np.sign(u) * max(abs(u) - width, 0.0), atol=1e-15)
    assert float(v([u, 0.3], p)[1]) == 0.3


def test_the_rig_feels_of_a_command_what_is_beyond_the_width(rig):
    u = np.column_stack([0.1 * np.sin(np.arange(500)), 0.5 * np.cos(np.arange(500) / 30)])
    still = u * [0.0, 1.0]
    model = rig.extended(rig.newtonian(), zone(0.1))
    np.testing.assert_array_equal(rig.simulate(model, u), rig.simulate(rig.newtonian(), still))
    x = rig.simulate(model, np.tile([1.4, 0.2], (300, 1)))
    expected = rig.simulate(rig.newtonian(), np.tile([1.3, 0.2], (300, 1)))
    np.testing.assert_allclose(x, expected, atol=1e-10)


def derating(depth=0.1, seconds=5.0, rotor="tail"):
    return {"supply": SupplyDerating(rotor=rotor, depth=depth, time_constant=seconds)}


def gains(rig, u, model):
    """Share of a constant command on yaw that reached the motor, per step."""
    x = rig.simulate(model, np.tile([0, u], (1000, 1)))
    return np.diff(x[:, 3]) * 0.05 / 0.02 / u, x[:, -1]


def test_full_load_warms_up_and_takes_the_gain_away_and_rest_cools(rig):
    gain, warmth = gains(rig, 2.5, rig.extended(rig.turntable(inertia=0.05), derating()))
    t = np.arange(1001) * 0.02
    np.testing.assert_allclose(warmth, 1 - np.exp(-t / 5.0), atol=1e-12)
    assert gain[0] > 0.999
    mean = 1 - 5.0 / 0.02 * np.diff(-np.exp(-t / 5.0))
    np.testing.assert_allclose(gain, 1 - 0.1 * mean, atol=1e-9)
    u = np.concatenate([np.full(500, -2.5), np.zeros(500)])
    model = rig.extended(rig.turntable(), derating())
    warmth = rig.simulate(model, np.column_stack([np.zeros(1000), u]))[:, -1]
    np.testing.assert_allclose(warmth[-1], (1 - np.exp(-2)) * np.exp(-2), rtol=1e-9)


@given(u=st.floats(0.1, 2.5), depth=st.floats(0, 0.3))
@settings(max_examples=25, deadline=None)
def test_a_sagging_supply_loses_gain_at_once_by_the_load(rig, u, depth):
    model = rig.extended(rig.turntable(inertia=0.05), derating())
    model.parameters = model.parameters.replaced(
        {"supply.depth": depth, "supply.time_constant": 0.0}
    )
    gain, _ = gains(rig, u, model)
    np.testing.assert_allclose(gain, 1 - depth * (u / 2.5) ** 2, atol=1e-7)
