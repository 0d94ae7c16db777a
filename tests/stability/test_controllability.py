"""Controllability and observability: PBH, Gramians, energies, sensors, constant torques."""

import math

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import TrimSolver
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.stability.local.access import (
    Access,
    controllability_gramian,
    hankel_values,
    observability_gramian,
    scales_of,
    sensor_sets,
    set_words,
    stationary_gramian,
    volts_to_move,
)
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.studies.controllability import Controllability

from .study_cases import NEWTONIAN, answer

U_V, U_H = 0, 1


class Case:
    """A model made linear, with its modes by name."""

    def __init__(self, model, at):
        point = TrimSolver(model).first(at)
        self.model = model
        self.matrices = Linear(model).matrices(point.x, point.u)
        self.scales = scales_of(model, self.matrices, 0.00044, 1.6)
        self.access = Access(model, self.matrices, self.scales)
        self.modes = {mode.name: mode for mode in self.access.modes}
        self.outputs = [signal.name for signal in model.outputs]

    def by_inputs(self, mode, inputs):
        return self.access.by_inputs(self.modes[mode], inputs, 2.0)

    def by_sensors(self, mode, sensors):
        rows = [self.outputs.index(name) for name in sensors]
        return self.access.by_sensors(self.modes[mode], rows)

    def torques(self, sensors, duration=2.0):
        return self.access.torques(sensors, (duration,), 0.01)


AT = {"alpha_v": 0.0, "alpha_h": 0.3}
TURNING = Case(NEWTONIAN, AT)
FREE_YAW = Case(QuanserAero(parameter_set="quanser_aero"), {"alpha_v": 0.2})


@pytest.mark.parametrize("at", [{}, {"alpha_v": 0.0}], ids=["rest", "hover"])
@pytest.mark.parametrize("currents", ["quasi_static", "dynamic"])
def test_the_tail_rotor_does_not_move_yaw_where_it_stands_still(at, currents):
    case = Case(Newtonian(currents=currents), at)
    lost = case.by_inputs("yaw swing", [U_H])
    assert lost.grade == "none" and lost.margin == 0.0
    # Exactly: the Krylov space of its input does not touch yaw, and no reading of zero is rounding.
    a, b = case.matrices.a, case.matrices.b[:, [U_H]]
    span = np.hstack([np.linalg.matrix_power(a, k) @ b for k in range(len(a))])
    span = span / np.abs(span).max(axis=0)
    rows = [case.model.state_index(name) for name in ("S_h", "alpha_h")]
    assert np.abs(span[rows]).max() < 1e-9
    # The main rotor's momentum still turns the beam.
    assert case.by_inputs("yaw swing", [U_V]).grade == "yes"


def test_the_inputs_move_every_mode_together_and_one_neither_the_other_rotor_nor_two_equal_ones():
    reach = TURNING.by_inputs("yaw swing", [U_H])
    assert reach.grade == "yes" and reach.margin > 0.1
    assert all(TURNING.by_inputs(mode, [U_V, U_H]).grade == "yes" for mode in TURNING.modes)
    # No input turns the other rotor.
    assert TURNING.by_inputs("main rotor", [U_H]).grade == "none"
    assert TURNING.by_inputs("tail rotor", [U_V]).grade == "none"
    # Both lags are 20 1/s: a double eigenvalue needs two inputs.
    double = next(name for name, mode in FREE_YAW.modes.items() if mode.multiplicity == 2)
    for inputs, grade in (([U_V], "none"), ([U_H], "none"), ([U_V, U_H], "yes")):
        assert FREE_YAW.by_inputs(double, inputs).grade == grade


def test_the_gain_of_yaw_goes_as_the_speed_of_the_tail_rotor():
    findings = answer(Controllability(range=(-0.04, 0.04), points=9))
    found = findings.results["range"]
    omega = np.array(found["states"]["omega_h"])
    moved = np.array(found["moved_per_unit_rms"]["alpha_h"]["u_h"])
    margin = np.array(found["pbh_margin"]["alpha_h"]["u_h"])
    at_zero = int(np.argmin(np.abs(omega)))
    assert abs(omega[at_zero]) < 1e-8 and moved[at_zero] < 1e-9 * moved.max()
    assert margin[at_zero] == 0.0
    for side in (omega > 1.0, omega < -1.0):
        ratio = moved[side] / np.abs(omega[side])
        assert ratio.max() / ratio.min() < 1.2
    assert any("u_h loses alpha_h at alpha_h = 0" in sentence for sentence in findings.lead)
    assert [m.value for m in findings.measures[:3]] == ["4 of 4", "4 of 4", 4]


def test_which_modes_and_constant_torques_a_set_of_sensors_tells():
    assert all(TURNING.by_sensors(m, ["alpha_v", "alpha_h"]).grade == "yes" for m in TURNING.modes)
    rest = Case(NEWTONIAN, {})
    assert rest.by_sensors("yaw swing", ["alpha_v"]).grade == "none"
    assert rest.by_sensors("pitch swing", ["alpha_h"]).grade == "none"
    # The main rotor at rest has no thrust, and its momentum turns yaw only.
    assert rest.by_sensors("main rotor", ["alpha_v"]).grade == "none"
    assert rest.by_sensors("main rotor", ["alpha_h"]).grade == "yes"
    assert FREE_YAW.by_sensors("yaw free", ["alpha_v", "omega_v", "omega_h"]).grade == "none"
    assert FREE_YAW.by_sensors("yaw free", ["alpha_h"]).grade == "yes"
    angles, everything = TURNING.torques(["alpha_v", "alpha_h"]), TURNING.torques(TURNING.outputs)
    # Two angles in rest cannot tell more than two torques, whatever the filter.
    assert angles.together == 2 and all(torque.seen for torque in angles.alone.values())
    assert everything.together == 4
    for one, seen in ((TURNING, {"pitch_moment", "main_motor"}), (FREE_YAW, {"pitch_moment"})):
        alone = one.torques(["alpha_v"]).alone
        assert {name for name, t in alone.items() if t.seen} >= seen
        assert not alone["yaw_moment"].seen
    assert not TURNING.torques(["alpha_v"]).alone["tail_motor"].seen


def test_the_error_of_a_torque_is_that_of_a_kalman_filter():
    # A joint filter on state and torque, read every 10 ms, from the same prior.
    case = Case(Newtonian(freedom="vertical"), {"alpha_v": 0.0})
    duration, step = 2.0, 0.01
    (torque, *_) = case.torques(["alpha_v"], duration).alone.values()
    m, n = case.matrices, case.model.n_x
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n] = m.a, m.e[:, 0]
    flow = scipy.linalg.expm(joint * step)
    row = np.zeros((1, n + 1))
    row[0, case.model.state_index("alpha_v")] = 1.0
    # Information of x(0) and d: Σ (Φᵏ)ᵀ cᵀ c Φᵏ / σ², and the prior.
    information = np.zeros((n + 1, n + 1))
    information[:n, :n] = np.diag(1.0 / (10.0 * case.scales.x) ** 2)
    now = np.eye(n + 1)
    for _ in range(round(duration / step)):
        now = flow @ now
        information += now.T @ row.T @ row @ now / 0.00044**2
    error = math.sqrt(np.linalg.inv(information)[n, n])
    assert torque.error == pytest.approx(error, rel=0.03)


def _stable(seed):
    random = np.random.default_rng(seed)
    a = random.normal(size=(4, 4))
    a -= (np.linalg.eigvals(a).real.max() + 0.5) * np.eye(4)
    return a, random.normal(size=(4, 2))


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_stationary_gramians_solve_their_equation_and_are_the_limit(seed):
    a, b = _stable(seed)
    forever = stationary_gramian(a, b)
    assert np.allclose(forever, scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T))
    assert np.abs(a @ forever + forever @ a.T + b @ b.T).max() < 1e-9 * np.abs(b @ b.T).max()
    assert np.allclose(controllability_gramian(a, b, 200.0), forever, rtol=1e-8)


@given(st.integers(0, 10_000), st.floats(0.01, 3.0))
@settings(max_examples=15, deadline=None)
def test_finite_gramians_are_the_integral_for_unstable_systems_too(seed, duration):
    a, b = _stable(seed)
    a = a + 0.8 * np.eye(4)  # unstable

    def rate(t, w):
        return (a @ w.reshape(4, 4) + w.reshape(4, 4) @ a.T + b @ b.T).ravel()

    run = solve_ivp(rate, (0, duration), np.zeros(16), rtol=1e-10, atol=1e-12, method="DOP853")
    expected = run.y[:, -1].reshape(4, 4)
    found = controllability_gramian(a, b, duration)
    assert np.allclose(found, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


def test_finite_gramians_stand_fast_poles_and_those_of_a_step_count_the_same_energy():
    # A block exponential would not stand the poles of the currents.
    case = Case(Newtonian(currents="dynamic"), AT)
    volts = []
    for c in (case, TURNING):
        gramian = controllability_gramian(c.matrices.a, c.matrices.b[:, [U_H]], 2.0)
        direction = np.eye(c.model.n_x)[c.model.state_index("alpha_h")]
        volts.append(volts_to_move(gramian, direction, 0.1, 2.0))
    assert volts[0] == pytest.approx(volts[1], rel=1e-3)
    stationary = stationary_gramian(case.matrices.a, case.matrices.b)
    assert np.isfinite(stationary).all()
    step = 0.005
    a, b = TURNING.matrices.a, TURNING.matrices.b
    block = scipy.linalg.expm(np.block([[a, b], [np.zeros((2, 6)), np.zeros((2, 2))]]) * step)
    found = controllability_gramian(block[:6, :6], block[:6, 6:], 2.0, step)
    expected = controllability_gramian(a, b, 2.0)
    assert np.allclose(found, expected, rtol=2e-2, atol=1e-2 * np.abs(expected).max())


def test_the_least_command_moves_the_rig_as_far_as_it_says():
    a, b, T = TURNING.matrices.a, TURNING.matrices.b[:, [U_H]], 2.0
    row = np.eye(6)[NEWTONIAN.state_index("alpha_h")]
    gramian = controllability_gramian(a, b, T)
    volts = volts_to_move(gramian, row, 0.1, T)
    reach = row @ gramian @ row

    def command(t):
        return float((b.T @ scipy.linalg.expm(a.T * (T - t)) @ row)[0]) * 0.1 / reach

    def rate(t, x):
        return np.append(a @ x[:6] + b[:, 0] * command(t), command(t) ** 2)

    run = solve_ivp(rate, (0, T), np.zeros(7), rtol=1e-8, atol=1e-10)
    assert run.y[:6, -1] @ row == pytest.approx(0.1, rel=1e-5)
    assert math.sqrt(run.y[6, -1] / T) == pytest.approx(volts, rel=1e-5)


def test_hankel_values_do_not_depend_on_the_states():
    a, b = _stable(3)
    c = np.random.default_rng(4).normal(size=(2, 4))
    turn = np.random.default_rng(5).normal(size=(4, 4)) + 3 * np.eye(4)
    back = np.linalg.inv(turn)
    found = [
        hankel_values(stationary_gramian(m, n), stationary_gramian(m.T, o.T))
        for m, n, o in ((a, b, c), (turn @ a @ back, turn @ b, c @ back))
    ]
    assert found[0] == pytest.approx(found[1], rel=1e-7)
    assert np.allclose(
        observability_gramian(a, c, 1.0), controllability_gramian(a.T, c.T, 1.0), rtol=1e-12
    )


def test_usual_sets_of_sensors_and_those_that_do_not_exist():
    model = Newtonian()
    sets = sensor_sets(model, None)
    assert [set_words(model, one) for one in sets] == [
        *("all", "angles, omega_v", "angles, omega_h", "angles"),
        *("alpha_v", "alpha_h", "omega_v", "omega_h"),
    ]
    assert sensor_sets(model, [["alpha_h"]]) == (("alpha_h",),)
    for sensors in ((("alpha_z",),), ((),)):
        with pytest.raises(ConfigurationError, match=r"study\.sensors"):
            answer(Controllability(sensors=sensors))


def test_the_study_reports_everything_and_varies_the_pitch_where_yaw_is_free():
    findings = answer(Controllability(points=7))
    results = findings.results
    assert results["at"]["x"]["alpha_h"] == pytest.approx(0.3)
    assert results["gramians"]["lyapunov_residual"] < 1e-10
    assert len(results["gramians"]["hankel"]) == 6
    yaw = next(mode for mode in results["modes"] if mode["name"] == "yaw swing")
    assert set(yaw["by_input"]) == {"u_v", "u_h", "together"}
    drawn = {"controllability_loss", "controllability_volts", "observability_torques"}
    assert {chart.name for chart in findings.charts} == drawn
    angles = next(t for t in results["torques"] if t["sensors"] == ["alpha_v", "alpha_h"])
    assert angles["together"] == 2
    findings = answer(Controllability(points=7), QuanserAero())
    found = findings.results["range"]
    assert found["over"] == "alpha_v"
    moved = np.array(found["moved_per_unit_rms"]["alpha_v"]["u_v"])
    assert np.argmin(moved) == np.argmin(np.abs(found["values"]))  # level, the rotors stand still
