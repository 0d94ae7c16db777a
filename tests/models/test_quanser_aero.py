"""The Quanser Aero: its published numbers, its energy, its limits, its use by the rest."""

import casadi as ca
import numpy as np
import pytest

from trms_cli.core.plugins import build
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.parameters import parameter_file
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.steady_state import SteadyState

from ..simulation.looping import composed, looped
from .simulate import rates, slopes, travel

FREE = {"d_1": 0.0, "d_2": 0.0}


def inertias() -> tuple[float, float]:
    """I_b and I_f of the published masses and lengths, kg m²."""
    beam = 2 * 0.146 * 0.158**2 + 2 * 0.2 * 0.158**2 + 0.2 * 0.016**2 + 0.458 * 0.165**2 / 12
    return beam, 0.526 * 0.02**2 / 2


@pytest.mark.parametrize("seed", range(4))
def test_energy_is_kept_without_friction_and_thrust(seed):
    model = QuanserAero(parameters=FREE)
    beam, yoke = inertias()
    generator = np.random.default_rng(seed)
    start = np.zeros(6)
    start[[1, 2, 4, 5]] = generator.uniform(-1, 1, 4) * [3.0, 1.0, 2.0, 0.8]
    errors = []
    for step in (0.02, 0.01):
        x = travel(model, start, (0, 0), 4.0, step)
        yaw_rate, pitch_rate, pitch = x[:, 1], x[:, 4], x[:, 5]
        about_yaw = yoke + beam * np.cos(pitch) ** 2
        kinetic = 0.5 * beam * pitch_rate**2 + 0.5 * about_yaw * yaw_rate**2
        energy = kinetic - 0.016 * 9.81 * 0.2 * np.cos(pitch)
        momentum = about_yaw * yaw_rate
        errors.append(np.abs(energy - energy[0]).max() + np.abs(momentum - momentum[0]).max())
    assert errors[1] < 1e-7
    assert errors[1] < errors[0] / 8  # of fourth order


def test_friction_takes_energy_by_the_published_coefficients():
    x = np.array([0, 0.7, 0.0, 0, 0.4, 0.0])
    f = rates(QuanserAero(), x) - rates(QuanserAero(parameters=FREE), x)
    beam, yoke = inertias()
    assert f[4] == pytest.approx(-0.0031 * 0.4 / beam, rel=1e-9)
    assert f[1] == pytest.approx(-0.0075 * 0.7 / (yoke + beam), rel=1e-9)


@pytest.mark.parametrize(("main", "tail"), [(150.0, 0.0), (0.0, 150.0), (-120.0, 90.0)])
def test_either_rotor_turns_both_axes(main, tail):
    pitch = 0.3
    x = np.array([tail, 0.0, 0.0, main, 0.0, pitch])
    held = (main / 17.38, tail / 17.38)  # neither rotor speeds up
    beam, yoke = inertias()
    squares = main * abs(main), tail * abs(tail)
    on_pitch = 0.158 * (1.26e-6 * squares[0] + 1.08e-6 * squares[1])
    on_yaw = 0.158 * np.cos(pitch) * (1.26e-6 * squares[1] - 1.08e-6 * squares[0])
    f = rates(QuanserAero(), x, held)
    gravity = -0.016 * 9.81 * 0.2 * np.sin(pitch)
    assert f[4] == pytest.approx((on_pitch + gravity) / beam, rel=1e-9)
    assert f[1] == pytest.approx(on_yaw / (yoke + beam * np.cos(pitch) ** 2), rel=1e-9)


@pytest.mark.parametrize("tilts", [(0.0, 0.0), (0.05, 0.1)])
def test_what_speeds_a_rotor_up_turns_the_beam_the_other_way(tilts):
    """With no thrust and level, each rotor's momentum and the beam's add up to a constant."""
    e_m, e_t = tilts
    model = QuanserAero(parameters={**FREE, "e_m": e_m, "e_t": e_t})
    beam, yoke = inertias()
    f = rates(model, np.zeros(6), (4.0, -3.0))
    main, tail = 17.38 * 4.0 / 0.05, 17.38 * -3.0 / 0.05
    assert f[3] == pytest.approx(main, rel=1e-12)
    assert beam * f[4] == pytest.approx(1.1e-5 * (tail + e_m * main), rel=1e-9)
    assert (yoke + beam) * f[1] == pytest.approx(1.1e-5 * (e_t * tail - main), rel=1e-9)
    # A torque on a rotor is borne by the beam as that of its motor is.
    pushed = rates(model, np.zeros(6), (4.0, -3.0), (0, 0, 1e-3, 0))
    assert (yoke + beam) * (pushed[1] - f[1]) == pytest.approx(-1e-3, rel=1e-9)


def test_dry_friction_holds_below_its_size_and_brakes_above():
    held = {**FREE, "F_1": 0.003, "F_2": 0.002, "d_x": 0.0}
    model = QuanserAero(parameters=held)
    beam, yoke = inertias()
    beam -= 0.2 * 0.016**2  # of the mass that now lies on the axis
    x = travel(model, np.zeros(6), (0, 0), 1.0, w=[0.0029, -0.0019, 0, 0])[-1]
    # It creeps below v_s, by the torque's share of the friction.
    assert x[4] == pytest.approx(5e-4 * 0.0029 / 0.003, rel=1e-6)
    assert x[1] == pytest.approx(-5e-4 * 0.0019 / 0.002, rel=1e-6)
    faster = travel(model, x, (0, 0), 1.0, w=[0.0049, 0, 0, 0])[-1]
    assert faster[4] - x[4] == pytest.approx((0.0049 - 0.003) / beam, rel=0.01)
    after = travel(model, [0, 0.5, 0, 0, 0, 0], (0, 0), 0.01)[-1]
    assert after[1] == pytest.approx(0.5 - 0.002 * 0.01 / (yoke + beam), rel=1e-6)
    rigid = QuanserAero(parameters={**held, "v_s": 1e-9})
    x = travel(rigid, np.zeros(6), (0, 0), 0.01, w=[0.0029, -0.0019, 0, 0])[-1]
    assert np.abs(x).max() < 1e-9  # v_s


def test_a_torque_moves_an_axis_at_rest_to_first_order():
    model = QuanserAero(parameter_set="quanser_aero_record")
    linear = discretise(model, 0.02).linearised()
    by_torque = np.asarray(linear(np.zeros(6), [0, 0], model.parameters.values, np.zeros(4))[4])
    assert by_torque[4, 0] > 0.05
    assert by_torque[1, 1] > 0.05


def test_recorded_angles_are_late_by_the_filter():
    model = QuanserAero(parameter_set="quanser_aero_record")
    x, u, p, _ = model.symbols()
    shown = ca.Function("y", [x, u, p], [model.measurement(x, u, p)])
    state = [90.0, 0.5, 0.7, 120.0, -0.4, 0.3]
    values = model.parameters.values
    y = np.asarray(shown(state, [0, 0], values)).ravel()
    np.testing.assert_allclose(y, [0.3 + 0.032 * 0.4, 0.7 - 0.032 * 0.5, 120.0, 90.0], rtol=1e-12)


def test_the_fitted_set_is_the_published_one_but_for_what_was_fitted():
    published, fitted = (parameter_file(n) for n in ("quanser_aero", "quanser_aero_record"))
    assert set(published.parameters) == set(fitted.parameters)
    for name, entry in fitted.parameters.items():
        if entry.sd is not None:
            # What may differ from run to run is no less than what one run leaves open.
            assert entry.prior_sd * abs(entry.value) >= 0.95 * entry.sd, name
        elif name != "tau_y":
            assert entry.value == published.parameters[name].value, name


def test_a_command_beyond_the_amplifier_acts_as_its_limit():
    model = QuanserAero()
    beyond, at_limit = (travel(model, np.zeros(6), u, 1.0, 0.02) for u in ((36.2, -30), (24, -24)))
    np.testing.assert_array_equal(beyond, at_limit)
    # Also behind a delay, whose mean over a step is of what the amplifier lets through.
    delayed = extend_model(model, {"d": InputDelay(rotor="main", delay=0.03)})
    x = np.zeros(discretise(delayed, 0.02).n_x)
    beyond, at_limit = (travel(delayed, x, (u, 0), 0.06, 0.02)[-1, :6] for u in (36.2, 24.0))
    np.testing.assert_array_equal(beyond, at_limit)


def test_the_rotor_follows_its_command_with_its_time_constant():
    x = travel(QuanserAero(), np.zeros(6), (10.0, -5.0), 0.05, 0.005)
    assert x[-1, 3] == pytest.approx(173.8 * (1 - np.exp(-1)), rel=1e-6)
    assert x[-1, 0] == pytest.approx(-86.9 * (1 - np.exp(-1)), rel=1e-6)


def test_the_documented_eigenvalues():
    model = QuanserAero()
    at_rest = np.linalg.eigvals(slopes(model, model.rest())[0])
    expected = [-20, -20, -0.4061, -0.0844 + 1.3047j, -0.0844 - 1.3047j, 0]
    key = lambda v: (round(v.real, 3), round(v.imag, 3))  # noqa: E731
    np.testing.assert_allclose(
        sorted(at_rest, key=key), sorted(map(complex, expected), key=key), atol=2e-4
    )


def test_it_holds_a_pitch_with_both_rotors():
    target = SteadyState(QuanserAero()).solve(np.array([0.3, 0.0]), np.zeros(4), None)
    assert not target.projected
    np.testing.assert_allclose(target.u, [9.430, 8.731], atol=2e-3)


def test_what_is_measured_can_be_the_angles_alone():
    model = build(
        {"_target_": "trms_cli.models.quanser_aero.QuanserAero", "rotor_speeds": False}, "model"
    )
    assert [signal.name for signal in model.outputs] == ["alpha_v", "alpha_h"]


@pytest.mark.parametrize(
    "chosen",
    [
        # A PID, tuned where the rotors thrust; in dry friction its integral leaves some 0.02 rad.
        ["experiment=quanser_aero", "model.parameter_set=quanser_aero", "sim.duration=25"],
        pytest.param(
            ["model=quanser_aero", "controller=newton_mpc"], marks=pytest.mark.slow, id="newton_mpc"
        ),
    ],
)
def test_a_controller_tracks_with_it(chosen):
    settings = ["sim.duration=12", *chosen, "ref=constant"]
    settings += ["ref.alpha_v.offset=0.3", "ref.alpha_h.offset=0.5"]
    state = looped(composed(*settings)).history.columns("/plant/state")
    assert state["alpha_v"][-50:] == pytest.approx(0.3, abs=0.02)
    assert state["alpha_h"][-50:] == pytest.approx(0.5, abs=0.02)
