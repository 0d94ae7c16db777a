"""Equilibria in the window of a portrait: where they are, and what they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.portraits.rest_points import halving_time, kind_of, period, search
from trms_cli.stability.portraits.section import section_of
from trms_cli.stability.portraits.window import default_window

VERTICAL = Newtonian(freedom="vertical")
BOTH = Newtonian()

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
