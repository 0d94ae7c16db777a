"""Where a model rests: by angles, by commands, and where it cannot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.operating_point import operating_point
from trms_cli.models.quanser_aero import QuanserAero
from trms_cli.models.tras import Tras
from trms_cli.models.vector_field import VectorField

MODEL = Newtonian()
FIELD = VectorField(MODEL)


def test_hover_by_angle():
    point = operating_point(MODEL, {"alpha_v": 0.0})
    assert point.u[0] == pytest.approx(1.413, abs=5e-4)
    assert point.x[MODEL.state_index("omega_v")] == pytest.approx(196.3, abs=0.05)
    # no thrust of the tail is needed: exactly none, not the square root of a tolerance
    assert point.u[1] == 0.0 and point.x[MODEL.state_index("omega_h")] == pytest.approx(0, abs=1e-9)


def test_rest_without_anything_named():
    point = operating_point(MODEL, {})
    assert point.u.tolist() == [0.0, 0.0]
    assert point.x[MODEL.state_index("alpha_v")] == pytest.approx(-0.619, abs=5e-4)


@settings(max_examples=20, deadline=None)
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
