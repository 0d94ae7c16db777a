"""Where a model rests, at double roots and out of reach too; its equations as numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.cable_hysteresis import CableHysteresis
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.steady_state import SteadyState, Target
from trms_cli.models.tras import Tras
from trms_cli.models.vector_field import VectorField

from .simulate import rates

MODEL = Newtonian()
FIELD = VectorField(MODEL)
U = np.array([1.0, 0.3])


def test_hover_by_angle():
    point = operating_point(MODEL, {"alpha_v": 0.0})
    assert point.u[0] == pytest.approx(1.413, abs=5e-4)
    assert point.x[MODEL.state_index("omega_v")] == pytest.approx(196.3, abs=0.05)
    # no thrust of the tail is needed: exactly none, not the square root of a tolerance
    assert point.u[1] == 0.0 and point.x[MODEL.state_index("omega_h")] == pytest.approx(0, abs=1e-9)


@settings(max_examples=20)
@given(st.floats(-2.5, 2.2), st.floats(-2.5, 2.5))
def test_by_command_nothing_moves_there(u_v, u_h):
    point = operating_point(MODEL, {"u_v": u_v, "u_h": u_h})
    assert np.abs(FIELD.rates(point.x, point.u)).max() < 1e-8
    # the branch that begins at rest is the lower one
    assert point.x[MODEL.state_index("alpha_v")] < 0.96


def test_angle_and_command_lead_to_the_same_point():
    by_angle = operating_point(MODEL, {"alpha_v": 0.2, "alpha_h": -0.6})
    names = [signal.name for signal in MODEL.inputs]
    by_command = operating_point(MODEL, dict(zip(names, by_angle.u.tolist(), strict=True)))
    assert by_command.x == pytest.approx(by_angle.x, abs=1e-6)


def test_a_yaw_that_nothing_pulls_back_stays_where_it_is():
    model = QuanserAero()
    point = operating_point(model, {"alpha_v": 0.1, "alpha_h": 0.4})
    assert np.abs(VectorField(model).rates(point.x, point.u)).max() < 1e-6
    assert point.x[model.state_index("alpha_h")] == pytest.approx(0.4, abs=1e-6)
    # one rotor alone turns the yaw for ever
    with pytest.raises(ConfigurationError, match="begins at rest ends"):
        operating_point(model, {"u_v": 5.0})


@pytest.mark.parametrize(
    ("at", "problem", "remedy"),
    [
        ({"u_v": 2.4}, r"ends at u_v=2\.22", "study=equilibria"),
        ({"alpha_v": 1.5}, "no equilibrium at alpha_v=1.5", "closest that it has: alpha_v=1.05"),
        ({"alpha_v": 0.1, "u_h": 0.2}, "given together", "the others follow"),
        ({"alpa_v": 0.1}, "neither a controlled state nor an input", "did you mean alpha_v"),
    ],
)
def test_where_there_is_none(at, problem, remedy):
    with pytest.raises(ConfigurationError, match=problem) as caught:
        operating_point(MODEL, at)
    assert remedy in caught.value.remedy and caught.value.where.startswith("at")


def test_its_words_have_units_but_for_a_bare_number():
    assert operating_point(MODEL, {}).words(MODEL) == (
        "u_v = 0 V, u_h = 0 V: alpha_v = -0.6194, alpha_h = 0 rad"
    )
    model = Tras()
    words = operating_point(model, {}).words(model)
    assert words.startswith("u_v = 0, u_h = 0: alpha_v = ")


def starts(count: int, seed: int = 0) -> np.ndarray:
    scale = np.array([80.0, 0.3, 0.5, 120.0, 0.3, 0.6])
    return scale * np.random.default_rng(seed).uniform(-1, 1, (count, 6))


def test_many_states_and_commands_at_once_are_each_of_them():
    x = starts(7)
    assert FIELD.rates(x, U) == pytest.approx(np.array([FIELD.rates(row, U) for row in x]))
    commands = np.array([[0.5, 0.0], [1.5, 0.2]])
    both = FIELD.motions(starts(2), commands, 2.0, 0.1)
    for i in range(2):
        alone = FIELD.motions(starts(2)[i], commands[i], 2.0, 0.1)
        assert both[:, i] == pytest.approx(alone[:, 0], abs=1e-12)


def test_slopes_are_those_of_the_rates():
    (x,) = starts(1)
    A, B = FIELD.linearised(x, U)
    for j, step in enumerate(1e-6 * np.maximum(np.abs(x), 1.0)):
        away = np.eye(6)[j] * step
        numeric = (FIELD.rates(x + away, U) - FIELD.rates(x - away, U)) / (2 * step)
        assert A[:, j] == pytest.approx(numeric, rel=1e-5, abs=1e-6)
    away = np.array([1e-6, 0.0])
    numeric = (FIELD.rates(x, U + away) - FIELD.rates(x, U - away)) / 2e-6
    assert B[:, 0] == pytest.approx(numeric, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("count", [1, 3])
def test_motions_are_those_of_another_integrator(count):
    x = starts(count)
    found = FIELD.motions(x, U, 5.0, 0.05)
    assert found.shape == (101, count, 6)
    for i, start in enumerate(x):
        known = solve_ivp(lambda t, z: FIELD.rates(z, U), (0, 5), start, rtol=1e-9, atol=1e-9)
        assert found[-1, i] == pytest.approx(known.y[:, -1], rel=1e-5, abs=1e-6)


def test_dry_friction_holds_an_axis_unless_it_is_left_out():
    stuck = extend_model(MODEL, {"friction": CoulombFriction(axis="pitch", torque=0.05)})
    field = VectorField(stuck)
    start = operating_point(MODEL, {}).x.copy()
    start[MODEL.state_index("alpha_v")] += 0.1
    pitch = MODEL.state_index("alpha_v")
    held = field.motions(start, [0, 0], 2.0, 0.02)[:, 0, pitch]
    free = field.motions(start, [0, 0], 2.0, 0.02, impulses=False)[:, 0, pitch]
    assert np.ptp(held) < 1e-4 < 0.1 < np.ptp(free)


BOTH = Newtonian()
SOLVER = SteadyState(BOTH)


def is_steady(model: Model, target: Target, w: np.ndarray) -> None:
    assert target.converged
    np.testing.assert_allclose(rates(model, target.x, target.u, w), 0.0, atol=2e-8)
    assert target.residual <= 1e-8
    lower, upper = model.input_bounds()
    assert np.all((target.u >= lower - 1e-8) & (target.u <= upper + 1e-8))
    rows = [model.state_index(name) for name in model.controlled]
    np.testing.assert_array_equal(target.x[rows], target.reference_reached)


@given(
    pitch=st.floats(-0.9, 0.95),
    yaw=st.floats(-2.0, 2.0),
    torques=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.005, 0.005)),
    warm=st.booleans(),
)
@settings(max_examples=200)
def test_a_reachable_reference_is_reached(pitch, yaw, torques, warm):
    reference, w = np.array([pitch, yaw]), np.array([*torques, 0.0, 0.0])
    guess = SOLVER.solve(np.array([0.1, 0.4])) if warm else None
    target = SOLVER.solve(reference, w, guess)
    is_steady(BOTH, target, w)
    assert not target.projected
    np.testing.assert_allclose(target.reference_reached, reference, atol=1e-6)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_double_root_is_left_and_entered(sign):
    rest = SOLVER.solve(np.zeros(2))
    assert abs(rest.u[1]) < 1e-4  # no thrust is needed
    turned = SOLVER.solve(np.array([0.3, sign * 0.5]), None, rest)
    assert not turned.projected
    back = SOLVER.solve(np.zeros(2), None, turned)
    is_steady(BOTH, back, np.zeros(4))
    np.testing.assert_allclose(back.u, rest.u, atol=2e-4)


def test_the_answer_depends_on_nothing_but_the_arguments():
    solver = SteadyState(BOTH)
    reference, guess = np.array([0.2, -0.3]), solver.solve(np.zeros(2))
    first = solver.solve(reference, None, guess)
    solver.solve(np.array([0.9, 2.0]), np.array([-0.1, 0.0, 0.0, 0.0]))
    second = solver.solve(reference, None, guess)
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.u, second.u)


def test_out_of_reach_the_closest_is_found_and_flagged():
    w = np.array([-0.1, 0.0, 0.0, 0.0])  # the main rotor cannot lift this to 0.9 rad
    target = SOLVER.solve(np.array([0.9, 0.5]), w)
    is_steady(BOTH, target, w)
    assert target.projected
    assert target.active == (1, 0)
    assert target.u[0] == 2.5
    np.testing.assert_allclose(target.reference_reached[1], 0.5, atol=1e-6)
    # more thrust is more pitch here, so that the closest is at the limit: nothing inside is closer
    for u_v in (2.3, 2.4, 2.49):
        limited = Newtonian()
        limited.input_limits = {"u_v": u_v, "u_h": 2.5}
        closer = SteadyState(limited).solve(np.array([0.9, 0.5]), w)
        assert closer.reference_reached[0] < target.reference_reached[0]
    again = SOLVER.solve(np.array([0.9, 0.51]), w, target)
    np.testing.assert_allclose(again.reference_reached, [target.reference_reached[0], 0.51])
    released = SOLVER.solve(np.array([0.1, 0.5]), w, target)
    assert not released.projected and released.active == (0, 0)


@pytest.mark.parametrize("pitch_weight", [1.0, 30.0])
def test_what_is_out_of_reach_is_shared_as_the_weights_say(pitch_weight):
    """Short of tail thrust, pitch is lowered for the cosine that it costs: against a search."""
    reference, w = np.array([0.2, 2.5]), np.array([0.0, -0.08, 0.0, 0.0])
    solver = SteadyState(BOTH, {"alpha_v": pitch_weight})
    target = solver.solve(reference, w)
    is_steady(BOTH, target, w)
    assert target.active == (0, 1)
    p = dict(zip(BOTH.parameters.names, BOTH.parameters.values, strict=True))
    thrust_moment = p["l_t"] * p["k_fhp"] * target.x[BOTH.state_index("omega_h")] ** 2
    pitch = np.linspace(-0.5, 0.5, 100_001)
    yaw = (thrust_moment * np.cos(pitch) - 0.08) / p["k_chp"]
    cost = pitch_weight * (pitch - reference[0]) ** 2 + (yaw - reference[1]) ** 2
    best = int(np.argmin(cost))
    np.testing.assert_allclose(target.reference_reached, [pitch[best], yaw[best]], atol=2e-5)
    again = solver.solve(reference + 0.01, w, target)
    is_steady(BOTH, again, w)
    assert again.active == (0, 1)


def test_references_beyond_a_stop_end_at_it_and_what_cannot_be_is_said():
    target = SOLVER.solve(np.array([1.4, 0.0]))
    assert target.projected
    assert target.reference_reached[0] == pytest.approx(1.05, abs=1e-6)
    w = np.array([-1.0, 0.0, 0.0, 0.0])
    target = SOLVER.solve(np.array([0.3, 0.0]), w)
    assert not target.converged and target.projected
    assert target.residual > 1e-3
    assert np.all(np.isfinite(target.x)) and np.all(np.isfinite(target.u))
    with pytest.raises(ModelError, match="weights"):
        SteadyState(BOTH, {"alpha_v": 0.0})


@pytest.mark.parametrize(
    "model",
    [
        Newtonian(currents="dynamic"),
        Newtonian(freedom="vertical"),
        Newtonian(freedom="horizontal"),
        extend_model(Newtonian(), {"late": InputDelay(rotor="tail", delay=0.13)}),
    ],
    ids=["currents", "vertical", "horizontal", "delay"],
)
def test_every_model_has_its_steady_states(model):
    solver = SteadyState(model)
    guess = None
    for angle in (0.3, -0.3, 0.0):
        reference = np.full(len(model.controlled), angle)
        target = solver.solve(reference, None, guess)
        is_steady(model, target, np.zeros(model.n_w))
        np.testing.assert_allclose(target.reference_reached, reference, atol=1e-6)
        guess = target
    if len(model.controlled) == 2:
        found, same = (one.solve(np.full(2, 0.3)) for one in (solver, SOLVER))
        for name in ("omega_v", "omega_h", "alpha_v"):
            expected = same.x[BOTH.state_index(name)]
            assert found.x[model.state_index(name)] == pytest.approx(expected, rel=1e-6)


def test_a_reference_is_taken_up_again_when_what_kept_it_out_of_reach_has_gone():
    reference = np.array([-0.3, -0.5])
    push = np.array([0.0, 0.0, 0.0, 0.06])  # N m on the tail rotor: more than its motor has
    target = SOLVER.solve(reference, np.zeros(4))
    for share in (0.2, 0.6, 1.0, 1.0, 0.6, 0.2, 0.0):
        target = SOLVER.solve(reference, share * push, target)
        if share == 1.0:
            assert target.projected
    is_steady(BOTH, target, np.zeros(4))
    assert not target.projected


@pytest.mark.parametrize("warm", [False, True])
def test_a_path_memory_stays_and_the_inputs_hold_the_reference(warm):
    model = extend_model(BOTH, {"h": CableHysteresis(axis="yaw", torque=0.005, width=0.15)})
    solver, reference = SteadyState(model), np.array([0.2, 0.3])
    guess = solver.solve(np.array([0.1, -0.4])) if warm else None
    tail = {}
    for memory in (-1.0, 0.0, 0.7):
        target = solver.solve(reference, None, guess, np.array([memory]))
        is_steady(model, target, np.zeros(model.n_w))
        assert target.exact
        assert target.x[model.path_memory[0]] == pytest.approx(memory, abs=1e-9)
        # The cable's torque −T z is what a constant torque of that size is.
        torque = np.zeros(model.n_w)
        torque[[signal.name for signal in BOTH.disturbances].index(BOTH.axes["yaw"].moment)] = (
            -0.005 * memory
        )
        np.testing.assert_allclose(target.u, SOLVER.solve(reference, torque).u, atol=1e-6)
        tail[memory] = target.u[1]
    assert tail[-1.0] < tail[0.0] < tail[0.7]
    assert solver.solve(reference).x[model.path_memory[0]] == pytest.approx(0.0, abs=1e-9)
