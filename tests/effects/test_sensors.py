"""What the sensors do: bias, delay, rounding, filters, flexibility, and all of them in a row."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.signal import TransferFunction, lfilter, lsim

from trms_cli.core.errors import ModelError
from trms_cli.effects.flexible_mode import FlexibleMode
from trms_cli.effects.quantisation import Quantisation
from trms_cli.effects.sensor_bias import SensorBias
from trms_cli.effects.sensor_delay import SensorDelay
from trms_cli.effects.tacho_lag import TachoLag
from trms_cli.models.discretisation import discretise
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.narx_file import narx
from trms_cli.simulation.rollout import Rollout

STEP = 0.02
YAW = 1  # its place among the outputs of the Newtonian model and the turntable


def run(rig, base, effects, u, substeps=4, start=None):
    """Times, states and readings of a model with effects, from a settled start."""
    model = rig.extended(base, effects)
    discrete = discretise(model, STEP, substeps, sensors=True)
    first = base.rest() if start is None else np.asarray(start, dtype=float)
    settled = discrete.initial(first, u[0])
    x = rig.simulate(model, u, STEP, substeps, start=settled)
    return STEP * np.arange(len(x)), x, rig.readings(model, x, u, STEP)


def finely(rig, base, u, fine, name, start=None):
    """A state over time by steps that are so many times shorter."""
    x = rig.simulate(base, np.repeat(u, fine, axis=0), STEP / fine, 1, start=start)
    return x[:, base.state_index(name)]


def test_a_bias_is_added_to_one_angle(rig):
    u = rig.rich_input(50)
    _, x, y = run(rig, rig.newtonian(), {"b": SensorBias(axis="yaw", bias=0.03)}, u)
    _, plain, true = run(rig, rig.newtonian(), {}, u)
    np.testing.assert_array_equal(x, plain)
    np.testing.assert_allclose(y - true, np.tile([0, 0.03, 0, 0], (51, 1)), atol=1e-15)


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_a_delay_of_whole_samples_is_a_shift(rig, steps):
    u = rig.rich_input(200)
    delay = {"d": SensorDelay(axis="yaw", delay=steps * STEP)}
    _, x, y = run(rig, rig.newtonian(), delay, u)
    yaw = x[:, rig.newtonian().state_index("alpha_h")]
    np.testing.assert_allclose(y[steps:, YAW], yaw[:-steps], atol=1e-14)
    np.testing.assert_allclose(y[:steps, YAW], yaw[0], atol=1e-14)  # it was at rest before


@given(delay=st.floats(0, 0.1), substeps=st.sampled_from([1, 4]))
@settings(max_examples=20, deadline=None)
def test_a_delay_of_any_fraction_shows_the_angle_of_that_time(rig, delay, substeps):
    t = STEP * np.arange(150)
    u = np.column_stack([np.zeros(150), 0.1 * np.sin(2 * t)])
    effects = {"d": SensorDelay(axis="yaw", delay=delay)}
    fine = 32
    base = rig.turntable(damping=0.02)
    start = [0, 0, 0.3, 0.5]
    _, _, y = run(rig, base, effects, u, substeps, start)
    model = finely(rig, base, u, fine, "alpha_h", start)
    at = np.arange(len(model)) * STEP / fine
    later = slice(8, None)
    expected = np.interp(STEP * np.arange(151)[later] - delay, at, model)
    np.testing.assert_allclose(y[later, YAW], expected, atol=2e-6)


def test_the_derivative_in_the_delay_is_the_rate_of_that_time(rig):
    u = rig.rich_input(60)
    base = rig.newtonian()
    model = rig.extended(base, {"d": SensorDelay(axis="yaw", delay=0.033)})
    rollout = Rollout(model, STEP, free=("d.delay",))
    start = rollout.initial(base.rest(), u[0])[None, :]
    slopes = rollout.sensitivities(u, [0], [60], start)
    rate = np.gradient(finely(rig, base, u, 40, "alpha_h"), STEP / 40)
    at = np.arange(20, 60) * 40 - 66
    np.testing.assert_allclose(slopes.dy[20:60, YAW, -1], -rate[at], atol=2e-3 * abs(rate).max())


@given(angle=st.floats(-3, 3), quantum=st.floats(1e-4, 0.1))
@settings(max_examples=60, deadline=None)
def test_a_rounded_angle_is_the_nearest_count(rig, reading_of, angle, quantum):
    value, in_angle, in_quantum = reading_of(angle, quantum)
    assert value == pytest.approx(quantum * np.floor(angle / quantum + 0.5), abs=1e-14)
    assert abs(value - angle) <= quantum / 2 + 1e-14
    assert in_angle == 1.0
    assert in_quantum == 0.0


@pytest.fixture(scope="module")
def reading_of(rig):
    model = rig.extended(rig.turntable(), {"q": Quantisation(axis="yaw", quantum=0.01)})
    x, u, p, _ = model.symbols()
    y = model.measurement(x, u, p)[YAW]
    slopes = [ca.jacobian(y, x)[2], ca.jacobian(y, p)[-1]]
    function = ca.Function("y", [x, u, p], [y, *slopes])
    values = model.parameters.values

    def evaluate(angle, quantum):
        p = np.concatenate([values[:-1], [quantum]])
        return tuple(float(v) for v in function([0, 0, angle, 0], [0, 0], p))

    return evaluate


@pytest.mark.parametrize("time_constant", [0.0, 0.004, 0.05, 0.3])
@pytest.mark.parametrize("substeps", [1, 4])
def test_a_tacho_s_filter_is_the_solution_of_its_equation(rig, time_constant, substeps):
    u = rig.rich_input(150)
    base = rig.newtonian()
    lag = {"t": TachoLag(rotor="main", time_constant=time_constant)}
    _, x, y = run(rig, base, lag, u, substeps)
    fine = 200
    speed = finely(rig, base, u, fine, "omega_v")
    if time_constant:
        kept = np.exp(-STEP / fine / time_constant)
        middle = (speed[:-1] + speed[1:]) / 2
        shown, _ = lfilter([1 - kept], [1, -kept], middle, zi=[kept * speed[0]])
        shown = np.append(speed[0], shown)
    else:
        shown = speed
        np.testing.assert_array_equal(y[:, 2], x[:, base.state_index("omega_v")])
    np.testing.assert_allclose(y[:, 2], shown[::fine], atol=0.02 if substeps == 1 else 2e-3)


@pytest.mark.parametrize("frequency", [2.0, 12.0, 40.0])
def test_a_mode_is_the_transfer_function_in_series(rig, frequency):
    zeta, natural = 0.03, 2 * np.pi * frequency
    t = STEP * np.arange(400)
    u = np.column_stack([np.zeros(400), 0.05 * np.sin(5 * t) + 0.02 * np.sin(11 * t)])
    mode = {"m": FlexibleMode(axis="yaw", share=1.0, frequency=frequency, damping=zeta)}
    base = rig.turntable(damping=0.02)
    _, _, y = run(rig, base, mode, u, substeps=8)
    fine = 64
    angle = finely(rig, base, u, fine, "alpha_h")
    system = TransferFunction([2 * zeta * natural, natural**2], [1, 2 * zeta * natural, natural**2])
    _, expected, _ = lsim(system, angle, np.arange(len(angle)) * STEP / fine)
    flexed = np.abs(expected - angle).max()
    # The angle is taken as linear over a substep: an error of (ω₀ h)²/12 of the deflection.
    error = 0.004 + (natural * STEP / 8) ** 2 / 10
    np.testing.assert_allclose(y[:, YAW], expected[::fine], atol=error * flexed)


@given(frequency=st.floats(0.5, 200), damping=st.floats(0.0, 0.5))
@settings(max_examples=10, deadline=None)
def test_a_mode_of_any_frequency_is_stable_and_rings_as_it_should(rig, frequency, damping):
    """Deflected by hand and let go: e^(−ζ ω₀ t) cos, whatever the step."""
    mode = {"m": FlexibleMode(axis="yaw", share=1.0, frequency=frequency, damping=damping)}
    model = rig.extended(rig.turntable(), mode)
    x = rig.simulate(model, np.zeros((60, 2)), start=[0, 0, 0, 0, 0.01, 0.0])
    t = STEP * np.arange(61)
    natural = 2 * np.pi * frequency
    damped = natural * np.sqrt(1 - damping**2)
    expected = (
        0.01
        * np.exp(-damping * natural * t)
        * (np.cos(damped * t) + damping * natural / damped * np.sin(damped * t))
    )
    np.testing.assert_allclose(x[:, 4], expected, atol=1e-9)


def test_a_delay_and_a_mode_commute(rig):
    """Both are linear and do not change in time; also within a sample."""
    u = rig.rich_input(150)
    delay = SensorDelay(axis="yaw", delay=0.033)
    mode = FlexibleMode(axis="yaw", share=1.0, frequency=3.0, damping=0.02)
    one = run(rig, rig.newtonian(), {"d": delay, "m": mode}, u, 4)[2][:, YAW]
    other = run(rig, rig.newtonian(), {"m": mode, "d": delay}, u, 4)[2][:, YAW]
    alone = run(rig, rig.newtonian(), {"m": mode}, u, 4)[2][:, YAW]
    assert np.abs(one - alone).max() > 5e-3
    np.testing.assert_allclose(one, other, atol=3e-5)


def test_a_settled_sensor_shows_what_it_measures(rig):
    u = np.tile([1.0, 0.3], (3, 1))
    effects = {
        name: rig.effect(name)
        for name in ("pitch_sensor_delay", "yaw_flexible_mode", "main_tacho_lag")
    }
    start = rig.newtonian().rest()
    start[[0, 2, 3]] = 50.0, 0.4, 120.0
    _, x, y = run(rig, rig.newtonian(), effects, u, start=start)
    order = [rig.newtonian().state_index(n) for n in ("alpha_v", "alpha_h", "omega_v", "omega_h")]
    np.testing.assert_allclose(y[0], x[0, order], atol=1e-12)


def test_the_controllers_model_has_no_states_for_the_sensors(rig):
    """A plan needs none of them: what is measured is the observer's matter."""
    model = rig.extended(rig.newtonian(), {"d": SensorDelay(axis="yaw", delay=0.05)})
    assert discretise(model, STEP).n_x == 6
    assert discretise(model, STEP, sensors=True).n_x == 6 + 6
    assert model.memory(STEP) == ()
    # A rotor driven by its measured speed keeps the sensors of the angles.
    driven = DrivenModel(model, ("omega_v", "omega_h"))
    discrete = discretise(driven, STEP, 2, sensors=True)
    assert discrete.n_sensors == 6
    x = discrete.initial(driven.rest(), np.zeros(4))
    after = discrete.step(x, [1.0, 0.5, 150.0, 60.0], driven.parameters.values, np.zeros(4))
    assert np.all(np.isfinite(np.asarray(after)))


def test_a_window_of_a_recording_sees_the_sensors(rig):
    """Rollout: outputs and slopes are those of the steps one by one."""
    u = rig.rich_input(40)
    names = ("yaw_sensor_delay", "pitch_flexible_mode", "main_tacho_lag")
    base = rig.newtonian()
    model = rig.extended(base, {name: rig.effect(name) for name in names})
    free = ("yaw_sensor_delay.delay", "pitch_flexible_mode.frequency", "k_fvp")
    rollout = Rollout(model, STEP, free=free, substeps=1)
    start = rollout.initial(base.rest(), u[0])
    x = rig.simulate(model, u, STEP, 1, start=start)
    got = rollout.sensitivities(u, [0], [40], start[None, :])
    np.testing.assert_allclose(got.y, rig.readings(model, x, u)[:-1], rtol=1e-10, atol=1e-12)
    for column, name in enumerate(free):
        value = model.parameters[name].value
        sides = []
        for sign in (1, -1):
            p = model.parameters.replaced({name: value * (1 + sign * 1e-6)}).values
            sides.append(rollout.outputs(u, [0], [40], start[None, :], p).y)
        difference = (sides[0] - sides[1]) / (2e-6 * value)
        scale = np.abs(difference).max()
        np.testing.assert_allclose(got.dy[:, :, column - 3], difference, atol=1e-5 * scale)


def test_a_black_box_can_have_sensors_too(rig):
    network = narx(network="narx_horizontal")
    _, x, y = run(rig, network, {"d": SensorDelay(axis="yaw", delay=0.04)}, np.ones((30, 1)), 1)
    yaw = network.state_index("alpha_h")
    assert np.ptp(x[:, yaw]) > 0.01
    row = [signal.name for signal in network.outputs].index("alpha_h")
    np.testing.assert_allclose(y[2:, row], x[:-2, yaw], atol=1e-14)


@pytest.mark.parametrize(
    ("effect", "wanted"),
    [
        (TachoLag(rotor="main", time_constant=0.1), "omega_v"),
        (SensorBias(axis="yaw", bias=0.1), "alpha_h"),
    ],
)
def test_what_is_not_measured_has_no_sensor(rig, effect, wanted):
    model = rig.newtonian()
    model.outputs = tuple(s for s in model.outputs if s.name != wanted)
    with pytest.raises(ModelError, match=f"does not measure '{wanted}'") as caught:
        rig.extended(model, {"e": effect})
    assert "it measures:" in caught.value.remedy


def test_the_mode_of_an_axis_that_rubs_is_excited_by_the_stop(rig):
    """Friction's impulses are part of the acceleration: against an independent integration."""
    base = rig.turntable(inertia=0.05)
    effects = {
        "m": FlexibleMode(axis="yaw", share=1.0, frequency=3.0, damping=0.02),
        "f": rig.effect("yaw_coulomb_friction", torque=0.05),
    }
    _, _, y = run(rig, base, effects, np.zeros((150, 2)), 8, start=[0, 0, 0, 1.0])
    natural, zeta = 2 * np.pi * 3.0, 0.02

    def slope(t, z):
        acceleration = -1.0 if t < 1.0 else 0.0
        rate = max(1.0 - t, 0.0)
        return [rate, z[2], -acceleration - 2 * zeta * natural * z[2] - natural**2 * z[1]]

    solution = solve_ivp(slope, (0, 3), [0, 0, 0], rtol=1e-9, atol=1e-12, max_step=0.01)
    t = STEP * np.arange(151)
    # The axis moved before: a settled sensor begins with the mode at rest beside the axis.
    angle = np.interp(t, solution.t, solution.y[0])
    assert np.abs(y[:, YAW] - angle).max() > 1e-3
    after_stop = y[60:, YAW] - angle[60:]
    crossings = np.flatnonzero(np.diff(np.sign(after_stop)) != 0)
    assert np.mean(np.diff(crossings)) * STEP == pytest.approx(1 / (2 * 3.0), rel=0.03)
