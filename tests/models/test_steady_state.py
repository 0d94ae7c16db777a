"""Steady states satisfy the dynamics, at double roots and out of reach too."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ModelError
from trms_cli.effects.cable_hysteresis import CableHysteresis
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.steady_state import SteadyState, Target

from .simulate import rates

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


def test_the_equilibria_are_those_of_the_rig():
    hover = SOLVER.solve(np.zeros(2))
    assert hover.u[0] == pytest.approx(1.413, abs=1e-3)
    assert hover.x[BOTH.state_index("omega_v")] == pytest.approx(196.3, abs=0.05)
    assert abs(hover.u[1]) < 1e-4  # no thrust is needed: the double root
    turned = SOLVER.solve(np.array([0.0, 1.56]))
    assert turned.u[1] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_double_root_is_left_and_entered(sign):
    rest = SOLVER.solve(np.zeros(2))
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
    full = {n: i for i, n in enumerate(BOTH.state_names)}
    same = SOLVER.solve(np.full(2, 0.3))
    if len(model.controlled) == 2:
        found = solver.solve(np.full(2, 0.3))
        for name in ("omega_v", "omega_h", "alpha_v"):
            assert found.x[model.state_index(name)] == pytest.approx(same.x[full[name]], rel=1e-6)


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
