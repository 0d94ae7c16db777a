"""Equations as numbers: their motions, where a model rests, and where it cannot."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.tras import Tras
from trms_cli.models.vector_field import VectorField

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
