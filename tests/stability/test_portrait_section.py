"""Coordinates of a portrait, the section that it lies in, and the field on that section."""

from __future__ import annotations

import numpy as np
import pytest

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.stability.portraits.rest_points import grid
from trms_cli.stability.portraits.section import default_states, section_of

VERTICAL = Newtonian(freedom="vertical")
BOTH = Newtonian()
FULL = Newtonian(freedom="vertical", currents="dynamic")
MOTOR = SingleRotor(rotor="main", currents="dynamic")


@pytest.fixture(scope="module")
def hover():
    return section_of(VERTICAL, ("alpha_v", "rate_v"), {"alpha_v": 0.0})


def test_a_rate_is_the_row_of_its_angle(hover):
    x = np.random.default_rng(0).normal(size=(6, 3)) * [100.0, 1.0, 1.0]
    field = hover.coordinates.field
    values = hover.coordinates.values(x, hover.point.u)
    assert values[:, 0] == pytest.approx(x[:, 2])
    assert values[:, 1] == pytest.approx(field.rates(x, hover.point.u)[:, 2])


def test_coordinates_change_as_along_a_motion(hover):
    start = np.array([[150.0, 0.4, -0.3]])
    x = hover.coordinates.field.motions(start, hover.point.u, 0.02, 0.01)[:, 0]
    c = hover.coordinates.values(x, hover.point.u)
    assert hover.coordinates.rates(x[1], hover.point.u) == pytest.approx(
        (c[2] - c[0]) / 0.02, rel=1e-4, abs=1e-4
    )


@pytest.mark.parametrize(
    ("model", "states", "others"),
    [
        (VERTICAL, ("alpha_v", "rate_v"), "held"),
        (BOTH, ("alpha_h", "rate_h"), "held"),
        (BOTH, ("rate_v", "rate_h", "alpha_v"), "held"),
        (FULL, ("alpha_v", "omega_v"), ("i_v",)),
    ],
)
def test_a_placed_point_has_the_coordinates_asked_for_and_the_others_as_told(model, states, others):
    section = section_of(model, states, {"alpha_v": 0.1}, others)
    c = np.random.default_rng(1).uniform(-0.4, 0.4, (8, len(states)))
    if "omega_v" in states:
        c[:, 1] += 150.0
    x = section.place(c)
    assert section.coordinates.values(x, section.point.u) == pytest.approx(c, abs=1e-8)
    assert x[:, section.held] == pytest.approx(np.tile(section.point.x[list(section.held)], (8, 1)))
    rates = section.coordinates.field.rates(x, section.point.u)
    assert np.abs(rates[:, section.settled]).max(initial=0.0) < 1e-6


def test_a_settled_current_is_the_quasi_static_one():
    section = section_of(FULL, ("alpha_v", "omega_v"), {"u_v": 1.0}, "settled")
    assert [FULL.state_names[i] for i in section.settled] == ["i_v", "S_v"]
    section = section_of(FULL, ("alpha_v", "omega_v"), {"u_v": 1.0}, ("i_v",))
    c = FULL.parameters
    i = section.place([[0.0, 100.0]])[0, FULL.state_index("i_v")]
    volt = c["k_uv"].value * section.point.u[0]
    assert i == pytest.approx((volt - c["kphi"].value * 100.0) / c["R"].value)


def test_slopes_in_the_section_are_those_of_its_field(hover):
    for section, c in (
        (hover, np.array([0.7, -0.4])),
        (section_of(BOTH, ("alpha_v", "rate_h"), {"alpha_v": 0.1}), np.array([0.3, 0.2])),
    ):
        slopes = section.slopes(c)
        for j, away in enumerate(1e-6 * np.eye(2)):
            numeric = (section.rates(c + away) - section.rates(c - away))[0] / 2e-6
            assert slopes[:, j] == pytest.approx(numeric, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(
    ("model", "states", "at", "invariant"),
    [
        (VERTICAL, ("alpha_v", "rate_v"), {"alpha_v": 0.0}, True),  # the rotor is settled
        (VERTICAL, ("alpha_v", "S_v"), {}, True),
        (VERTICAL, ("omega_v", "S_v", "alpha_v"), {"alpha_v": 0.0}, True),  # all of them
        (VERTICAL, ("omega_v", "alpha_v"), {"alpha_v": 0.0}, False),  # a motion has a rate
        (BOTH, ("alpha_v", "rate_v"), {"alpha_v": 0.0}, False),  # yaw moves with the rotor's drag
        (MOTOR, ("omega_v", "i_v"), {"u_v": 1.0}, True),
    ],
)
def test_a_section_is_invariant_where_no_motion_leaves_it(model, states, at, invariant):
    section = section_of(model, states, at)
    window = np.array([[-0.5, 0.5]] * len(states))
    assert section.is_invariant(grid(window, 5).reshape(-1, len(states))) is invariant
    start = section.place(np.full((1, len(states)), 0.3))
    x = section.coordinates.field.motions(start, section.point.u, 1.0, 0.1)[:, 0]
    back = section.place(section.coordinates.values(x, section.point.u))
    assert np.allclose(back, x, atol=1e-6) is invariant


def test_the_default_is_the_first_axis_or_the_two_states_of_a_motor():
    assert default_states(BOTH) == ("alpha_v", "rate_v")
    assert default_states(Newtonian(freedom="horizontal")) == ("alpha_h", "rate_h")
    assert default_states(MOTOR) == ("omega_v", "i_v")


@pytest.mark.parametrize(
    ("states", "where", "words"),
    [
        (("alpha_v", "omga_v"), "states[1]", "omega_v"),
        (("alpha_v",), "states", "two make a plane"),
        (("alpha_v", "alpha_v"), "states", "once"),
        (("rate_v", "S_v"), "states", "angle"),
        (("alpha_v", "S_v", "omega_v", "alpha_h"), "states", "three a space"),
    ],
)
def test_states_that_make_no_portrait_are_refused(states, where, words):
    with pytest.raises(ConfigurationError) as error:
        section_of(BOTH, states, {})
    assert error.value.where == where
    assert words in error.value.remedy


def test_a_model_of_one_state_is_refused():
    with pytest.raises(ModelError, match="one state") as error:
        section_of(SingleRotor(rotor="main"), ("omega_v", "omega_v"), {})
    assert "currents=dynamic" in error.value.remedy


def test_only_a_state_that_is_left_open_settles():
    with pytest.raises(ConfigurationError) as error:
        section_of(VERTICAL, ("alpha_v", "S_v"), {}, ("alpha_v",))
    assert error.value.where == "others[0]"


def test_what_cannot_settle_is_refused():
    # dα_v/dt = S_v does not depend on α_v.
    with pytest.raises(ConfigurationError, match="alpha_v: what settles") as error:
        section_of(VERTICAL, ("omega_v", "S_v"), {}, "settled")
    assert error.value.where == "others"
