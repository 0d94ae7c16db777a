"""What holds for every effect of the library, alone and together."""

import re

import casadi as ca
import numpy as np
import pytest

from tests.identification.blackbox.differences import central
from trms_cli.core.errors import ModelError
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.models.discretisation import discretise
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.tras import Tras

FORMS = ["quasi_static", "dynamic"]
#: Largest error ratio that a halved substep must give, by kind; 1/2 is order one.
ORDERS = {"coulomb_friction": 0.9, "stribeck_friction": 0.9, "rotor_friction": 0.9}
#: Effects that need both axes to move, and those that change what is measured alone.
OF_BOTH_AXES = {"main_reaction_on_yaw", "tail_reaction_on_pitch", "gyroscopic_coupling"}
OF_SENSORS = {"sensor_bias", "sensor_delay", "quantisation", "tacho_lag", "flexible_mode"}
#: Parts that an effect needs and its name does not begin with.
NEEDS = {"gyroscopic_coupling": "main", "ground_effect": "main"}


@pytest.fixture(scope="module")
def nominal(rig):
    u = rig.rich_input(800)
    return {form: (u, rig.simulate(rig.newtonian(currents=form), u)) for form in FORMS}


@pytest.mark.parametrize("form", FORMS)
def test_size_zero_changes_no_bit(rig, nominal, form, effect_name):
    u, expected = nominal[form][0][:300], nominal[form][1][:301]
    base = rig.newtonian(currents=form)
    model = rig.extended(base, {effect_name: rig.absent(effect_name)})
    x = rig.simulate(model, u)
    np.testing.assert_array_equal(x[:, : expected.shape[1]], expected)
    few = slice(0, 200)
    np.testing.assert_array_equal(
        rig.readings(model, x[few], u[few][:-1]), rig.readings(base, expected[few], u[few][:-1])
    )


@pytest.mark.parametrize(
    ("form", "compile"),
    [*((form, False) for form in FORMS)]
    + [pytest.param(form, True, marks=pytest.mark.slow) for form in FORMS],
)
def test_all_effects_of_size_zero_together_change_no_bit(rig, nominal, form, compile):
    """Also compiled, as runs are: a compiler may contract what it knows nothing about."""
    u, _ = nominal[form]
    base = rig.newtonian(currents=form)
    expected = rig.simulate(base, u, compile=compile)
    model = rig.extended(base, {name: rig.absent(name) for name in rig.names})
    x = rig.simulate(model, u, compile=compile)
    np.testing.assert_array_equal(x[:, : base.n_x], expected)


def test_every_effect_changes_something(rig, nominal, effect_name):
    u, expected = nominal["quasi_static"]
    base = rig.newtonian()
    model = rig.extended(base, {effect_name: rig.effect(effect_name)})
    start = model.rest()
    start[base.n_x :] = 0.01  # a draught that blows already: noise alone drives it
    x = rig.simulate(model, u, start=start)
    assert np.all(np.isfinite(x))
    change = np.abs(rig.readings(model, x, u) - rig.readings(base, expected, u)).max(axis=0)
    assert np.any(change > [2e-3, 2e-3, 1.0, 1.0])  # rad, rad/s
    if rig.kind(effect_name) in OF_SENSORS:
        np.testing.assert_array_equal(x[:, : base.n_x], expected)


def test_halving_the_substep_converges(rig, effect_name):
    if rig.kind(effect_name) in OF_SENSORS:
        pytest.skip("the motion is the nominal one, bit for bit; see test_sensors for what is read")
    u = 0.6 * rig.rich_input(150)
    model = rig.extended(rig.newtonian(), {effect_name: rig.effect(effect_name)})
    # Many short steps instead of one with many substeps: the answer may not depend on it.
    finest = rig.simulate(model, np.repeat(u, 32, axis=0), 0.02 / 32, 1)[::32, :6]
    scale = np.abs(finest).max(axis=0)
    errors = [
        (np.abs(rig.simulate(model, u, substeps=n)[:, :6] - finest) / scale).max()
        for n in (1, 2, 4)
    ]
    ratio = ORDERS.get(rig.kind(effect_name), 0.5)
    assert errors[0] < 0.02
    assert errors[2] < max(ratio**2 * errors[0], 1e-9), errors


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("present", [True, False])
def test_jacobians_are_finite_at_rest_and_in_motion(rig, effect_name, form, present):
    effect = rig.effect(effect_name) if present else rig.absent(effect_name)
    model = rig.extended(rig.newtonian(currents=form), {effect_name: effect})
    discrete = discretise(model, 0.02, 1, sensors=True)
    slopes, shown = discrete.linearised(), _measurement_slopes(discrete)
    moving = np.linspace(-0.5, 0.7, discrete.n_x)
    for x in (np.zeros(discrete.n_x), moving):
        for u in (np.zeros(2), np.array([1.4, -0.3])):
            p = model.parameters.values
            results = (*slopes(x, u, p, np.zeros(model.n_w)), *shown(x, u, p))
            assert all(np.all(np.isfinite(np.asarray(result))) for result in results)


def differences(function, at, which, sizes):
    """Difference quotients of a function in one of its arguments."""
    before, after = at[:which], at[which + 1 :]
    return central(lambda v: np.asarray(function(*before, v, *after)).ravel(), at[which], sizes)


def test_jacobians_equal_differences_in_motion(rig, effect_name):
    model = rig.extended(rig.newtonian(), {effect_name: rig.effect(effect_name)})
    discrete = discretise(model, 0.02, 2, sensors=True)
    slopes = discrete.linearised()
    generator = np.random.default_rng(3)
    x = generator.uniform(0.2, 0.6, discrete.n_x)
    x[[0, 3]] *= 200
    at = [x, np.array([1.3, -0.7]), model.parameters.values, np.full(model.n_w, 1e-3)]
    _, *exact = map(np.asarray, slopes(*at))
    for which, jacobian in enumerate(exact):
        sizes = 1e-6 * np.maximum(np.abs(at[which]), 1e-3)
        expected = differences(discrete.step, at, which, sizes)
        scale = 1 + np.abs(expected).max(axis=0)
        np.testing.assert_allclose(jacobian / scale, expected / scale, atol=2e-4)
    # So do those of the measurement.
    x = np.random.default_rng(4).uniform(0.2, 0.6, discrete.n_x)
    at = [x, np.zeros(2), model.parameters.values]
    in_state, in_sizes = map(np.asarray, _measurement_slopes(discrete)(*at))
    # Rounding has steps, over which it rises like the angle; its quantum has no slope of its own.
    size = 0.05 if rig.kind(effect_name) == "quantisation" else 1e-7
    expected = differences(discrete.measurement, at, 0, size)
    np.testing.assert_allclose(in_state, expected, rtol=1e-5, atol=0.1 * size**0.5)
    if rig.kind(effect_name) != "quantisation":
        expected = differences(discrete.measurement, at, 2, size)[:, 39:]
        np.testing.assert_allclose(in_sizes[:, 39:], expected, rtol=1e-5, atol=0.1 * size**0.5)


def _measurement_slopes(discrete):
    x, u, p, _ = discrete.symbols()
    y = discrete.measurement(x, u, p)
    return ca.Function("slopes", [x, u, p], [ca.jacobian(y, v) for v in (x, p)])


def test_every_effect_works_on_its_own_axis_alone_and_on_no_other(rig, effect_name):
    effect = {effect_name: rig.effect(effect_name)}
    part = NEEDS.get(effect_name, effect_name.split("_")[0])
    vertical, horizontal = rig.newtonian(freedom="vertical"), rig.newtonian(freedom="horizontal")
    own, other = (vertical, horizontal) if part in ("pitch", "main") else (horizontal, vertical)
    words = f"has no {part}|'{part}_(moment|motor)' is not a disturbance"
    with pytest.raises(ModelError, match=words) as caught:
        rig.extended(other, effect)
    assert re.search("(it has|there are):", caught.value.remedy)
    if effect_name in OF_BOTH_AXES:
        with pytest.raises(ModelError, match=r"has no (yaw|pitch) axis"):
            rig.extended(own, effect)
    else:
        x = rig.simulate(rig.extended(own, effect), rig.rich_input(200)[:, :1])
        assert np.all(np.isfinite(x))


def test_parameters_and_states_carry_the_name_of_the_effect(rig):
    names = ["yaw_cable_hysteresis", "main_actuator_lag"]
    model = rig.extended(rig.newtonian(), {name: rig.effect(name) for name in names})
    assert model.state_names[-1] == "yaw_cable_hysteresis.memory"
    assert [signal.name for signal in model.memory(0.02)] == ["main_actuator_lag.lagged"]
    assert model.parameters["main_actuator_lag.time_constant"].unit == "s"
    assert model.parameters.names[:39] == rig.newtonian().parameters.names


def test_a_second_effect_of_the_same_name_is_refused(rig):
    """The sizes of the two could not be told apart."""
    friction = {"yaw_coulomb_friction": rig.effect("yaw_coulomb_friction")}
    with pytest.raises(ModelError, match="already"):
        rig.extended(rig.extended(rig.newtonian(), friction), friction)


@pytest.mark.slow
def test_all_effects_together_run_with_their_memory_in_place(rig):
    """Input-path effects in a row, states and impulses: sizes of x and x⁺ agree."""
    effects = {name: rig.effect(name) for name in rig.names}
    for order in (list(effects), list(reversed(effects))):
        model = rig.extended(rig.newtonian(), {name: effects[name] for name in order})
        discrete = discretise(model, 0.02, 4, sensors=True)
        assert discrete.step.size_in(0) == discrete.step.size_out(0) == (len(discrete.states), 1)
        assert np.all(np.isfinite(rig.simulate(model, rig.rich_input(300))))


def test_a_command_passes_the_input_paths_in_the_order_of_their_names(rig):
    effects = {
        "main_actuator_lag": rig.effect("main_actuator_lag"),
        "main_dead_zone": rig.effect("main_dead_zone", width=0.5),
    }
    results = [
        rig.simulate(rig.extended(rig.newtonian(), {name: effects[name] for name in order}), u)
        for u in [np.tile([0.6, 0.0], (10, 1))]
        for order in (list(effects), list(reversed(effects)))
    ]
    lag_first, dead_zone_first = (x[-1, 6] for x in results)
    assert lag_first > 0.5  # the lag saw the whole command,
    assert dead_zone_first < 0.11  # or what the dead zone had left


def test_the_work_grows_with_the_effects_and_not_with_their_combinations(rig):
    def instructions(*names):
        effects = {name: rig.effect(name) for name in names}
        return discretise(rig.extended(rig.newtonian(), effects), 0.02, 4).step.n_instructions()

    alone = instructions()
    three = instructions("pitch_coulomb_friction", "yaw_stribeck_friction", "main_actuator_lag")
    assert three < 2 * alone
    together = instructions(*rig.names)
    assert together - alone < 3 * sum(instructions(name) - alone for name in rig.names)


def test_a_base_of_one_state_keeps_its_size(rig):
    """CasADi gives an empty slice of a 1 × 1 matrix the shape (1, 0), which adds a row of zeros."""
    model = ExtendedModel(rig.newtonian(), "lag", rig.effect("main_actuator_lag"))
    model = ExtendedModel(model, "no_memory", rig.effect("yaw_coulomb_friction"))
    memory = ca.SX.sym("m", 1)
    p = ca.SX.sym("p", len(model.parameters))
    _, after = model.input_path(memory, ca.SX.sym("u", 2), p, (0.0, 1.0), 0.02)
    assert after.shape == (1, 1)


@pytest.mark.slow
@pytest.mark.parametrize("other", [Tras, QuanserAero, Lagrangian])
def test_other_models_take_every_effect_too(rig, effect_name, other):
    """Absent it changes no bit, present it changes something, whatever the rig is called."""
    base = other()
    u = rig.rich_input(60) * base.input_bounds()[1] / 2.5
    start = base.rest()
    start[base.state_index("S_v")] = start[base.state_index("S_h")] = 0.5
    expected = rig.simulate(base, u, start=start)
    absent = rig.extended(base, {effect_name: rig.absent(effect_name)})
    np.testing.assert_array_equal(rig.simulate(absent, u, start=start)[:, :6], expected)
    model = rig.extended(base, {effect_name: rig.effect(effect_name)})
    blown = np.concatenate([start, np.full(model.n_x - 6, 0.01)])
    x = rig.simulate(model, u, start=blown)
    y, plain = rig.readings(model, x, u), rig.readings(base, expected, u)
    assert np.all(np.isfinite(y))
    assert np.any(y != plain)
