"""Portraits: coordinates, the section that they lie in and the field on it, equilibria in the
window, starts, trajectories and their ends, separatrices, sticking sets.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.rotor_friction import RotorFriction
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.models.vector_field import has_impulses
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.portraits.invariant_sets import (
    grid,
    halving_time,
    kind_of,
    period,
    search,
    separatrices,
    sticking_sets,
)
from trms_cli.stability.portraits.section import default_states, section_of
from trms_cli.stability.portraits.trajectories import (
    NEAR,
    checked_window,
    default_starts,
    default_window,
    drawn_points,
    ends_of,
    given_starts,
    loop_starts,
    trajectories,
)

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


@pytest.mark.parametrize(
    ("states", "others", "where", "words"),
    [
        (("alpha_v", "S_v"), ("alpha_v",), "others[0]", "leaves open"),
        # dα_v/dt = S_v does not depend on α_v.
        (("omega_v", "S_v"), "settled", "others", "alpha_v: what settles"),
    ],
)
def test_what_cannot_settle_is_refused(states, others, where, words):
    with pytest.raises(ConfigurationError, match=words) as error:
        section_of(VERTICAL, states, {}, others)
    assert error.value.where == where


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


WINDOW = np.array([[-2.5, 2.5], [-2.5, 2.5]])
G, F_C = 0.2646, 0.005  # N m


@pytest.fixture(scope="module")
def rests(hover):
    return search(hover, WINDOW)


@pytest.fixture(scope="module")
def into_the_saddle(hover, rests):
    """The separatrix that comes from the left."""
    paths = separatrices(hover, True, WINDOW, rests[1], 25.0)
    return next(path for path in paths if path.into and path.c[:, 0].min() < 0)


def ends_from(section, c, duration=20.0):
    found = trajectories(section, section.place(c), duration, 0.05)
    return ends_of(section, WINDOW, search(section, WINDOW), found)


def test_the_window_holds_the_rest_points_and_the_operating_point(hover):
    window = default_window(hover, {})
    for rest in search(hover, window):
        assert np.all(rest.c > window[:, 0]) and np.all(rest.c < window[:, 1])
    assert len(search(hover, window)) == 2
    given = checked_window(hover.coordinates, {"rate_v": (-1.0, 0.5)})
    assert default_window(hover, given)[1].tolist() == [-1.0, 0.5]


def test_a_swing_within_the_separatrix_stays_within_the_window(hover, into_the_saddle):
    window = default_window(hover, {})
    inside = into_the_saddle.c[into_the_saddle.c[:, 0] < 1.8]
    last_swing = inside[np.flatnonzero(inside[:, 1] < 0)[-1] :]
    assert np.all(np.abs(last_swing[:, 1]) < window[1, 1])


def test_the_window_of_a_motor_holds_what_its_commands_reach():
    section = section_of(MOTOR, None, {"u_v": 1.0})
    window = default_window(section, {})
    for command in (-2.5, 2.5):
        x = section.coordinates.field.motions(section.point.x, [command], 6.0, 0.05)[:, 0]
        assert np.all(x[:, 1] > window[0, 0]) and np.all(x[:, 1] < window[0, 1])


@pytest.mark.parametrize(
    ("window", "where"),
    [
        ({"rate_v": (1.0, -1.0)}, "window.rate_v"),
        ({"rate_v": (1.0, 1.0)}, "window.rate_v"),
        ({"rate_v": (-np.inf, 1.0)}, "window.rate_v"),
        ({"S_v": (-1.0, 1.0)}, "window.S_v"),
    ],
)
def test_limits_that_make_no_window_are_refused(hover, window, where):
    with pytest.raises(ConfigurationError) as error:
        checked_window(hover.coordinates, window)
    assert error.value.where == where


def test_starts_on_the_edge_enter_the_window_and_all_lie_in_it(hover):
    x = default_starts(hover, WINDOW, 28)
    c = hover.coordinates.values(x, hover.point.u)
    assert c.shape == (28, 2) and np.all(c >= WINDOW[:, 0]) and np.all(c <= WINDOW[:, 1])
    edge = np.isclose(np.abs(c), 2.5, rtol=2e-3).any(axis=1)
    assert edge.sum() >= 14
    after = hover.coordinates.field.motions(x[edge], hover.point.u, 0.01, 0.01)[-1]
    moved = hover.coordinates.values(after, hover.point.u)
    assert np.all(np.abs(moved).max(axis=1) < np.abs(c[edge]).max(axis=1))


def test_starts_of_a_loop_lie_around_its_goal(hover):
    c = hover.coordinates.values(loop_starts(hover, WINDOW, 8), hover.point.u)
    assert np.linalg.norm(c / 2.5, axis=1) == pytest.approx(1.0)
    assert c.mean(axis=0) == pytest.approx(0.0, abs=1e-9)


def test_starts_by_name_may_name_other_states(hover):
    x = given_starts(hover, [{"alpha_v": 0.4}, {"rate_v": -1.0, "omega_v": 50.0}])
    assert x[0] == pytest.approx([hover.point.x[0], 0.0, 0.4])
    assert x[1] == pytest.approx([50.0, -1.0, 0.0])
    with pytest.raises(ConfigurationError) as error:
        given_starts(hover, [{}, {"alpha": 1.0}])
    assert error.value.where == "starts[1].alpha"


def test_trajectories_follow_the_field(hover):
    (trajectory,) = trajectories(hover, hover.place([[0.6, 0.5]]), 2.0, 0.01)
    slopes = (trajectory.c[2:] - trajectory.c[:-2]) / 0.02
    assert slopes == pytest.approx(hover.rates(trajectory.c[1:-1]), abs=2e-4)


def test_a_fall_within_a_step_is_drawn_as_it_is():
    section = section_of(MOTOR, ("omega_v", "i_v"), {"u_v": 1.0})
    (trajectory,) = trajectories(section, section.place([[0.0, -2.0]]), 1.0, 0.02)
    # The current is there before the rotor has turned by 0.1 rad/s.
    settled = 8.5 / 8.0
    arrived = np.flatnonzero(np.abs(trajectory.c[:, 1] - settled) < 0.02)[0]
    assert arrived > 2 and 0 <= trajectory.c[arrived, 0] < 0.1
    assert np.all(np.diff(trajectory.time) > 0) and trajectory.time[-1] == pytest.approx(
        1.0, abs=0.01
    )


def test_what_is_drawn_is_evenly_spaced_and_cut_at_the_window(hover):
    (trajectory,) = trajectories(hover, hover.place([[2.3, 1.0]]), 3.0, 0.01)
    points, _ = drawn_points(trajectory, WINDOW, 0.01, 2.0)
    seen = points[np.isfinite(points).all(axis=1)]
    assert len(seen) > 5
    assert np.sum(np.any(np.abs(seen) > 2.5, axis=1)) <= 1  # one point to reach the edge
    steps = np.linalg.norm(np.diff(seen, axis=0) / 5.0, axis=1)
    assert np.median(steps) == pytest.approx(0.01, rel=0.3)


def test_ends_tell_rest_from_turning_over(hover):
    ends = {end.what: end for end in ends_from(hover, [[0.1, 0.0], [2.2, 0.5]], 107.0)}
    assert set(ends) == {"rest", "turning"}
    assert ends["rest"].members == (0,) and ends["turning"].members == (1,)
    assert ends["rest"].rest.c == pytest.approx([0.0, 0.0], abs=1e-9)


def test_the_time_of_arrival_is_that_of_the_envelope(hover):
    start = 0.2
    (end,) = ends_from(hover, [[start, 0.0]], 107.0)
    # The swing decays as exp(−0.0467 t); the rate, 1.83 times as large, is the last to arrive.
    expected = np.log(1.83 * start / (NEAR * 5.0)) / 0.0467
    assert end.times[0] == pytest.approx(expected, abs=1.8)  # within half a swing


def test_the_separatrix_leads_into_the_saddle(hover, rests, into_the_saddle):
    saddle = rests[1].c
    assert into_the_saddle.c[-1] == pytest.approx(saddle)
    near = into_the_saddle.c[np.abs(into_the_saddle.c[:, 0] - 1.6).argmin()]
    (trajectory,) = trajectories(hover, hover.place([near]), 4.0, 0.01)
    assert np.abs(trajectory.c - saddle).max(axis=1).min() < 1e-2


def test_the_separatrix_divides_the_starts(hover, into_the_saddle):
    c = into_the_saddle.c
    # Well before the saddle, on the last swing: left of the hover point, and above it.
    for wanted in (-1.0, -0.3, 0.5, 1.2):
        swing = np.flatnonzero((c[:, 1] > 0) & (np.abs(c[:, 0] - wanted) < 0.05))
        on = c[swing[-1]]
        inside, outside = on * 0.97, on * 1.03
        by_start = {
            number: end.what
            for end in ends_from(hover, [inside, outside], 107.0)
            for number in end.members
        }
        assert by_start == {0: "rest", 1: "turning"}


def test_how_far_back_pitch_may_be_let_go(hover, into_the_saddle):
    farthest = into_the_saddle.c[:, 0].min()
    assert farthest == pytest.approx(-1.159, abs=1e-3)
    ends = ends_from(hover, [[farthest + 0.01, 0.0], [farthest - 0.01, 0.0]], 107.0)
    assert {end.what: end.members for end in ends} == {"rest": (0,), "turning": (1,)}


def test_what_leaves_the_saddle_goes_to_hover_or_over_the_top(hover, rests):
    out = [path for path in separatrices(hover, True, WINDOW, rests[1], 25.0) if not path.into]
    assert len(out) == 2
    assert sorted(path.c[-1, 0] > 2.4 for path in out) == [False, True]
    assert separatrices(hover, True, WINDOW, rests[0], 5.0) == ()  # of no saddle
    assert sticking_sets(hover, WINDOW, rests) == () and not has_impulses(VERTICAL)


def test_motions_into_a_saddle_of_three_states_fill_a_surface():
    section = section_of(VERTICAL, ("omega_v", "S_v", "alpha_v"), {"alpha_v": 0.0})
    window = np.array([[-300.0, 350.0], [-2.5, 2.5], [-2.5, 2.5]])
    saddle = search(section, window)[1]
    paths = separatrices(section, True, window, saddle, 10.0)
    assert sum(path.surface for path in paths) >= 12
    assert sum(not path.into for path in paths) == 2
    x = next(path for path in paths if path.surface).c
    from_middle = trajectories(section, x[len(x) // 2][None], 3.0, 0.01)[0]
    assert (np.abs(from_middle.c - saddle.c) / np.ptp(window, axis=1)).max(axis=1).min() < 0.01


def test_the_ways_out_of_a_saddle_of_more_states_are_motions_of_all_of_them():
    section = section_of(Newtonian(), ("alpha_v", "rate_v"), {"alpha_v": 0.0})
    saddle = search(section, WINDOW)[1]
    back, over = sorted(
        separatrices(section, False, WINDOW, saddle, 25.0), key=lambda path: path.c[-1, 0]
    )
    assert not (back.into or over.into)
    assert np.all(np.abs(back.c) <= 2.5) and over.c[-1, 0] > 2.5
    assert back.c[0] == pytest.approx(saddle.c) and back.c[:, 0].min() < -0.5


@pytest.mark.parametrize(
    ("effect", "torque"),
    [
        (CoulombFriction(axis="pitch", torque=F_C), F_C),
        (StribeckFriction(axis="pitch", torque=F_C, excess=0.5, velocity=0.03), 1.5 * F_C),
    ],
)
@pytest.mark.parametrize("states", [("alpha_v", "rate_v"), ("S_v", "alpha_v")])
def test_pitch_sticks_while_its_moment_is_within_the_friction(effect, torque, states):
    section = section_of(extend_model(VERTICAL, {"rub": effect}), states, {})
    window = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    (held,) = sticking_sets(section, window, search(section, window))
    assert held.what == "α_v" and held.along == states.index("alpha_v")
    rest, width = section.point.x[2], np.arcsin(torque / G)
    assert held.reach == pytest.approx((rest - width, rest + width), abs=2e-4)


def test_a_rotor_sticks_while_its_current_is_too_small():
    motor = extend_model(MOTOR, {"rub": RotorFriction(rotor="main", torque=0.001)})
    section = section_of(motor, ("omega_v", "i_v"), {})
    window = np.array([[-20.0, 20.0], [-0.2, 0.2]])
    (held,) = sticking_sets(section, window, search(section, window))
    assert held.what == "ω_v"
    assert held.reach == pytest.approx((-0.001 / 0.0202, 0.001 / 0.0202), rel=0.01)


def test_trajectories_end_on_the_sticking_set():
    model = extend_model(VERTICAL, {"rub": CoulombFriction(axis="pitch", torque=F_C)})
    section = section_of(model, ("alpha_v", "rate_v"), {})
    window = np.array([[-0.8, -0.4], [-0.4, 0.4]])
    rests = search(section, window)
    sets = sticking_sets(section, window, rests)
    found = trajectories(section, default_starts(section, window, 12), 30.0, 0.05)
    (end,) = ends_of(section, window, rests, found, sets, dry_friction=True)
    assert end.what == "held" and len(end.members) == 12 and end.held is sets[0]
    low, high = sets[0].reach
    finals = np.array([trajectory.c[-1] for trajectory in found])
    assert np.all((finals[:, 0] >= low - 1e-3) & (finals[:, 0] <= high + 1e-3))
    assert np.ptp(finals[:, 0]) > 0.01  # anywhere on it, not at one point
    assert np.abs(finals[:, 1]).max() < 1e-6
