"""Coordinates of a portrait, the section that it lies in, and the field on that section.

Equilibria in the window of a portrait: where they are, and what they are.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.portraits.invariant_sets import grid, halving_time, kind_of, period, search
from trms_cli.stability.portraits.section import default_states, section_of
from trms_cli.stability.portraits.window import default_window

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


rates = st.floats(0.01, 50.0)


@given(st.lists(rates, min_size=2, max_size=5), st.booleans())
def test_real_eigenvalues_of_one_sign_make_a_node(sizes, stable):
    sign = -1.0 if stable else 1.0
    assert kind_of([sign * size for size in sizes]) == f"{'' if stable else 'un'}stable node"


@given(rates, rates, st.booleans())
def test_a_pair_makes_a_focus(real, imaginary, stable):
    sign = -1.0 if stable else 1.0
    pair = [sign * real + 1j * imaginary, sign * real - 1j * imaginary]
    assert kind_of(pair) == f"{'' if stable else 'un'}stable focus"
    # A zero eigenvalue (a yaw that nothing pulls back) does not hide it.
    assert kind_of([*pair, 0.0]) == kind_of(pair)


@given(rates, rates, st.lists(rates, max_size=3))
def test_both_signs_make_a_saddle(out, into, more):
    assert kind_of([out, -into, *(-size for size in more)]) == "saddle"


def test_what_only_swings_is_a_centre():
    assert kind_of([2j, -2j]) == "centre"
    assert kind_of([2j, -2j, -1.0]) == "undecided"


@pytest.mark.parametrize("command", [{"alpha_v": 0.0}, {"u_v": 1.0}, {"u_v": 1.8}])
def test_the_upper_rest_of_pitch_is_the_mirror_of_the_lower_one(command):
    # G sin(α + 0.6194) = l_m F_v: the sine is the same on both sides of its crest.
    section = section_of(VERTICAL, ("alpha_v", "rate_v"), command)
    window = default_window(section, {})
    low, high = search(section, window)
    without_command = section_of(VERTICAL, ("alpha_v", "rate_v"), {}).point.x[2]
    assert low.c[0] == pytest.approx(section.point.x[2])
    assert high.c[0] == pytest.approx(np.pi + 2 * without_command - low.c[0])
    assert (low.kind, high.kind) == ("stable focus", "saddle")
    assert low.in_section and high.in_section


def test_hover_swings_and_decays_as_known():
    (hover, _) = search(
        section := section_of(VERTICAL, ("alpha_v", "rate_v"), {"alpha_v": 0.0}),
        default_window(section, {}),
    )
    pair = hover.eigenvalues[1]
    assert pair == pytest.approx(-0.047 + 1.830j, abs=1e-3)
    assert period(pair) == pytest.approx(3.433, abs=2e-3)
    assert halving_time(pair) == pytest.approx(14.85, abs=0.05)


@pytest.mark.parametrize("inductance", [0.00086, 1.0, 2.8, 3.0, 6.4, 20.0, 30.0])
def test_the_current_turns_the_node_of_the_motor_into_a_focus(inductance):
    motor = SingleRotor(rotor="main", currents="dynamic", parameters={"L": inductance})
    section = section_of(motor, ("omega_v", "i_v"), {"u_v": 1.0})
    c = {parameter.name: parameter.value for parameter in motor.parameters}
    damping = (c["B_mr"] + 2 * c["k_tvp"] * section.point.x[1]) / c["J_mr"]
    swings = (c["R"] / inductance - damping) ** 2 < 4 * c["kphi"] ** 2 / (c["J_mr"] * inductance)
    (rest,) = search(section, default_window(section, {}))
    assert rest.kind == ("stable focus" if swings else "stable node")


def test_a_rest_whose_neighbours_rest_too_is_told():
    section = section_of(FeedbackManual(), ("alpha_v", "rate_v"), {})
    rests = search(section, np.array([[-1.0, 0.5], [-1.0, 1.0]]))
    assert rests and not any(rest.isolated for rest in rests)
    assert rests[0].kind == "stable focus"
    # It is yaw that nothing pulls back: only a portrait of yaw shows the line.
    assert not any(rest.line for rest in rests)
    assert len(rests) == 1
    of_yaw = section_of(FeedbackManual(), ("alpha_h", "rate_h"), {})
    assert all(rest.line for rest in search(of_yaw, np.array([[-1.0, 1.0], [-1.0, 1.0]])))


def test_a_swing_that_grows_is_told_from_a_way_out():
    # The thesis's k_g makes pitch unstable above 0.34 rad.
    section = section_of(Newtonian(parameter_set="rahideh"), None, {"alpha_v": 0.4})
    (focus,) = search(section, np.array([[0.0, 0.8], [-0.5, 0.5]]))
    assert focus.kind == "saddle focus" and not focus.stable
    growing = max(focus.eigenvalues, key=lambda value: value.real)
    assert growing.real > 0 and period(growing) == pytest.approx(2 * np.pi / 1.27, rel=0.01)


def test_a_portrait_tells_the_modes_that_it_shows():
    section = section_of(BOTH, ("alpha_h", "rate_h"), {"alpha_v": 0.0})
    (rest,) = search(section, np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    assert period(rest.eigenvalues[rest.shown][0]) == pytest.approx(14.15, abs=0.1)  # not pitch


def test_on_a_switch_eigenvalues_are_those_of_the_mean():
    # The cable is stiffer on one side of α_h = 0: a swing takes half its time on either.
    yaw = Newtonian(freedom="horizontal")
    section = section_of(yaw, None, {"u_h": 0.0})
    (rest,) = search(section, default_window(section, {}))
    assert [yaw.state_names[i] for i in rest.switches] == ["alpha_h"]
    mean = np.linalg.eigvals(Linear(yaw).a(rest.x, section.point.u))
    assert np.sort_complex(rest.eigenvalues) == pytest.approx(np.sort_complex(mean))
    angle = yaw.state_index("alpha_h")
    start = rest.x.copy()
    start[angle] = 0.3
    path = section.coordinates.field.motions(start, section.point.u, 30.0, 0.01)[:, 0, angle]
    down = np.flatnonzero((path[:-1] > 0) & (path[1:] <= 0))
    swing = 0.01 * np.diff(down)[0]
    assert period(rest.eigenvalues[0]) == pytest.approx(swing, rel=0.02)


def test_the_same_rest_a_turn_away_has_the_same_eigenvalues():
    section = section_of(BOTH, None, {})
    rests = search(section, np.array([[-4.5, 4.0], [-1.0, 1.0]]))
    first, last = (rest for rest in rests if rest.kind == "saddle")
    assert last.c[0] - first.c[0] == pytest.approx(2 * np.pi)
    assert first.eigenvalues == pytest.approx(last.eigenvalues)
    assert np.count_nonzero(first.eigenvalues.imag) == 2  # rounding makes no pair


def test_a_rest_beside_the_section_is_told():
    # The upper rest of pitch needs another yaw rate state than hover does.
    section = section_of(BOTH, ("alpha_v", "rate_v"), {"alpha_v": 0.0})
    hover, upper = search(section, default_window(section, {}))
    assert hover.in_section
    assert upper.kind == "saddle" and not upper.in_section


def test_only_the_window_is_searched():
    section = section_of(VERTICAL, ("alpha_v", "rate_v"), {"alpha_v": 0.0})
    assert len(search(section, np.array([[-1.0, 1.5], [-1.0, 1.0]]))) == 1
    assert search(section, np.array([[0.5, 1.5], [-1.0, 1.0]])) == ()
