"""Portraits: coordinates, the section that they lie in and the field on it, equilibria in the
window, starts, trajectories and their ends, separatrices, sticking sets. The findings of
``study=phase_portrait`` for a model alone and in a loop.
"""

import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.composition.composer import compose
from trms_cli.controllers.lqr import Lqr
from trms_cli.core.chart import Contour, Curve, Flow, Points, as_data
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.core.findings import Table
from trms_cli.core.plugins import build
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.rotor_friction import RotorFriction
from trms_cli.effects.stribeck_friction import StribeckFriction
from trms_cli.effects.supply_derating import SupplyDerating
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.models.vector_field import has_impulses
from trms_cli.observers.full_state import FullState
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.portraits.charts import PortraitResult, has_field
from trms_cli.stability.portraits.invariant_sets import (
    grid,
    halving_time,
    kind_of,
    period,
    rest_point,
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
from trms_cli.stability.studies.phase_portrait import PhasePortrait, lead_of_model
from trms_cli.stability.study import silent
from trms_cli.stability.subject import LoopParts, Subject

VERTICAL = Newtonian(freedom="vertical")
BOTH = Newtonian()
FULL = Newtonian(freedom="vertical", currents="dynamic")
MOTOR = SingleRotor(rotor="main", currents="dynamic")


@pytest.fixture(scope="module")
def hover():
    return section_of(VERTICAL, ("alpha_v", "rate_v"), {"alpha_v": 0.0})


def test_a_rate_is_the_row_of_its_angle_and_coordinates_change_as_along_a_motion(hover):
    x = np.random.default_rng(0).normal(size=(6, 3)) * [100.0, 1.0, 1.0]
    field = hover.coordinates.field
    values = hover.coordinates.values(x, hover.point.u)
    assert values[:, 0] == pytest.approx(x[:, 2])
    assert values[:, 1] == pytest.approx(field.rates(x, hover.point.u)[:, 2])
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
    assert x[:, section.held_states] == pytest.approx(
        np.tile(section.point.x[list(section.held_states)], (8, 1))
    )
    rates = section.coordinates.field.rates(x, section.point.u)
    assert np.abs(rates[:, section.settled]).max(initial=0.0) < 1e-6


def test_a_settled_current_is_the_quasi_static_one_and_a_motor_by_default_shown_with_it():
    section = section_of(FULL, ("alpha_v", "omega_v"), {"u_v": 1.0}, "settled")
    assert [FULL.state_names[i] for i in section.settled] == ["i_v", "S_v"]
    section = section_of(FULL, ("alpha_v", "omega_v"), {"u_v": 1.0}, ("i_v",))
    c = FULL.parameters
    i = section.place([[0.0, 100.0]])[0, FULL.state_index("i_v")]
    volt = c["k_uv"].value * section.point.u[0]
    assert i == pytest.approx((volt - c["kphi"].value * 100.0) / c["R"].value)
    assert default_states(BOTH) == ("alpha_v", "rate_v")
    assert default_states(Newtonian(freedom="horizontal")) == ("alpha_h", "rate_h")
    assert default_states(MOTOR) == ("omega_v", "i_v")


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


ONE_STATE = "one state.*currents=dynamic"


@pytest.mark.parametrize(
    ("model", "states", "others", "where", "words"),
    [
        (BOTH, ("alpha_v", "omga_v"), "held", "states[1]", "omega_v"),
        (BOTH, ("alpha_v",), "held", "states", "two make a plane"),
        (BOTH, ("alpha_v", "alpha_v"), "held", "states", "once"),
        (BOTH, ("rate_v", "S_v"), "held", "states", "angle"),
        (BOTH, ("alpha_v", "S_v", "omega_v", "alpha_h"), "held", "states", "three a space"),
        (SingleRotor(rotor="main"), ("omega_v", "omega_v"), "held", None, ONE_STATE),
        (VERTICAL, ("alpha_v", "S_v"), ("alpha_v",), "others[0]", "leaves open"),
        # dα_v/dt = S_v does not depend on α_v.
        (VERTICAL, ("omega_v", "S_v"), "settled", "others", "alpha_v: what settles"),
    ],
)
def test_states_that_make_no_portrait_are_refused(model, states, others, where, words):
    with pytest.raises(TrmsError) as error:
        section_of(model, states, {}, others)
    assert where is None or error.value.where == where
    assert re.search(words, f"{error.value.problem} {error.value.remedy}")


rates = st.floats(0.01, 50.0)


@given(rates, rates, st.lists(rates, max_size=3), st.booleans())
def test_eigenvalues_make_a_node_a_focus_a_centre_or_a_saddle(one, other, more, stable):
    sign, prefix = (-1.0, "") if stable else (1.0, "un")
    assert kind_of([sign * size for size in (one, other, *more)]) == f"{prefix}stable node"
    pair = [sign * one + 1j * other, sign * one - 1j * other]
    assert kind_of(pair) == f"{prefix}stable focus"
    # A zero eigenvalue (a yaw that nothing pulls back) does not hide it.
    assert kind_of([*pair, 0.0]) == kind_of(pair)
    swing = [1j * other, -1j * other]
    assert kind_of(swing) == "centre" and kind_of([*swing, -one]) == "undecided"
    assert kind_of([one, -other, *(-size for size in more)]) == "saddle"


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


@pytest.mark.parametrize("inductance", [0.00086, 1.0, 2.8, 3.0, 6.4, 20.0, 30.0])
def test_the_current_turns_the_node_of_the_motor_into_a_focus(inductance):
    motor = SingleRotor(rotor="main", currents="dynamic", parameters={"L": inductance})
    section = section_of(motor, ("omega_v", "i_v"), {"u_v": 1.0})
    c = {parameter.name: parameter.value for parameter in motor.parameters}
    damping = (c["B_mr"] + 2 * c["k_tvp"] * section.point.x[1]) / c["J_mr"]
    swings = (c["R"] / inductance - damping) ** 2 < 4 * c["kphi"] ** 2 / (c["J_mr"] * inductance)
    (rest,) = search(section, default_window(section, {}))
    assert rest.kind == ("stable focus" if swings else "stable node")


def test_a_rest_whose_neighbours_rest_too_and_a_swing_that_grows_are_told():
    section = section_of(FeedbackManual(), ("alpha_v", "rate_v"), {})
    rests = search(section, np.array([[-1.0, 0.5], [-1.0, 1.0]]))
    assert rests and not any(rest.isolated for rest in rests)
    assert rests[0].kind == "stable focus"
    # It is yaw that nothing pulls back: only a portrait of yaw shows the line.
    assert not any(rest.line for rest in rests)
    assert len(rests) == 1
    of_yaw = section_of(FeedbackManual(), ("alpha_h", "rate_h"), {})
    assert all(rest.line for rest in search(of_yaw, np.array([[-1.0, 1.0], [-1.0, 1.0]])))
    # The thesis's k_g makes pitch unstable above 0.34 rad.
    section = section_of(Newtonian(parameter_set="rahideh"), None, {"alpha_v": 0.4})
    (focus,) = search(section, np.array([[0.0, 0.8], [-0.5, 0.5]]))
    assert focus.kind == "saddle focus" and not focus.stable
    growing = max(focus.eigenvalues, key=lambda value: value.real)
    assert growing.real > 0 and period(growing) == pytest.approx(2 * np.pi / 1.27, rel=0.01)


def test_on_a_switch_eigenvalues_are_those_of_the_mean():
    # The cable is stiffer on one side of α_h = 0: a swing takes half its time on either, which
    # test_local simulates.
    yaw = Newtonian(freedom="horizontal")
    section = section_of(yaw, None, {"u_h": 0.0})
    (rest,) = search(section, default_window(section, {}))
    assert [yaw.state_names[i] for i in rest.switches] == ["alpha_h"]
    mean = np.linalg.eigvals(Linear(yaw).a(rest.x, section.point.u))
    assert np.sort_complex(rest.eigenvalues) == pytest.approx(np.sort_complex(mean))


def test_of_both_axes_rests_beside_the_section_and_a_turn_away_and_the_modes_that_are_shown():
    # The upper rest of pitch needs another yaw rate state than hover does.
    section = section_of(BOTH, ("alpha_v", "rate_v"), {"alpha_v": 0.0})
    hover, upper = search(section, default_window(section, {}))
    assert hover.in_section
    assert upper.kind == "saddle" and not upper.in_section
    section = section_of(BOTH, ("alpha_h", "rate_h"), {"alpha_v": 0.0})
    (rest,) = search(section, np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    visible = rest.eigenvalues[rest.is_visible][0]
    assert period(visible) == pytest.approx(14.15, abs=0.1)  # not pitch
    # The same rest a turn away has the same eigenvalues.
    section = section_of(BOTH, None, {})
    rests = search(section, np.array([[-4.5, 4.0], [-1.0, 1.0]]))
    first, last = (rest for rest in rests if rest.kind == "saddle")
    assert last.c[0] - first.c[0] == pytest.approx(2 * np.pi)
    assert first.eigenvalues == pytest.approx(last.eigenvalues)
    assert np.count_nonzero(first.eigenvalues.imag) == 2  # rounding makes no pair


WINDOW = np.array([[-2.5, 2.5], [-2.5, 2.5]])
G, F_C = 0.2646, 0.005  # N m


@pytest.fixture(scope="module")
def rests(hover):
    return search(hover, WINDOW)


def ends_from(section, c, duration=20.0):
    found = trajectories(section, section.place(c), duration, 0.05)
    return ends_of(section, WINDOW, search(section, WINDOW), found)


def test_the_window_holds_rest_points_or_what_commands_reach_and_is_searched_alone(hover):
    window = default_window(hover, {})
    for rest in search(hover, window):
        assert np.all(rest.c > window[:, 0]) and np.all(rest.c < window[:, 1])
    assert len(search(hover, window)) == 2
    given = checked_window(hover.coordinates, {"rate_v": (-1.0, 0.5)})
    assert default_window(hover, given)[1].tolist() == [-1.0, 0.5]
    assert len(search(hover, np.array([[-1.0, 1.5], [-1.0, 1.0]]))) == 1
    assert search(hover, np.array([[0.5, 1.5], [-1.0, 1.0]])) == ()
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


def test_starts_lie_in_the_window_around_the_goal_of_a_loop_or_where_their_names_say(hover):
    x = default_starts(hover, WINDOW, 28)
    c = hover.coordinates.values(x, hover.point.u)
    assert c.shape == (28, 2) and np.all(c >= WINDOW[:, 0]) and np.all(c <= WINDOW[:, 1])
    edge = np.isclose(np.abs(c), 2.5, rtol=2e-3).any(axis=1)
    assert edge.sum() >= 14
    after = hover.coordinates.field.motions(x[edge], hover.point.u, 0.01, 0.01)[-1]
    moved = hover.coordinates.values(after, hover.point.u)
    assert np.all(np.abs(moved).max(axis=1) < np.abs(c[edge]).max(axis=1))
    # Those of a loop lie around its goal.
    c = hover.coordinates.values(loop_starts(hover, WINDOW, 8), hover.point.u)
    assert np.linalg.norm(c / 2.5, axis=1) == pytest.approx(1.0)
    assert c.mean(axis=0) == pytest.approx(0.0, abs=1e-9)
    x = given_starts(hover, [{"alpha_v": 0.4}, {"rate_v": -1.0, "omega_v": 50.0}])
    assert x[0] == pytest.approx([hover.point.x[0], 0.0, 0.4])
    assert x[1] == pytest.approx([50.0, -1.0, 0.0])
    with pytest.raises(ConfigurationError) as error:
        given_starts(hover, [{}, {"alpha": 1.0}])
    assert error.value.where == "starts[1].alpha"


def test_trajectories_follow_the_field_and_are_drawn_evenly_spaced_and_cut_at_the_window(hover):
    (trajectory,) = trajectories(hover, hover.place([[0.6, 0.5]]), 2.0, 0.01)
    slopes = (trajectory.c[2:] - trajectory.c[:-2]) / 0.02
    assert slopes == pytest.approx(hover.rates(trajectory.c[1:-1]), abs=2e-4)
    (trajectory,) = trajectories(hover, hover.place([[2.3, 1.0]]), 3.0, 0.01)
    points, _ = drawn_points(trajectory, WINDOW, 0.01, 2.0)
    seen = points[np.isfinite(points).all(axis=1)]
    assert len(seen) > 5
    assert np.sum(np.any(np.abs(seen) > 2.5, axis=1)) <= 1  # one point to reach the edge
    steps = np.linalg.norm(np.diff(seen, axis=0) / 5.0, axis=1)
    assert np.median(steps) == pytest.approx(0.01, rel=0.3)


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


def test_hover_swings_and_decays_as_known_and_ends_tell_rest_from_turning_over(hover, rests):
    ends = {end.what: end for end in ends_from(hover, [[0.1, 0.0], [2.2, 0.5]], 107.0)}
    assert set(ends) == {"rest", "turning"}
    assert ends["rest"].members == (0,) and ends["turning"].members == (1,)
    assert ends["rest"].rest.c == pytest.approx([0.0, 0.0], abs=1e-9)
    start = 0.2
    (end,) = ends_from(hover, [[start, 0.0]], 107.0)
    # The swing decays as exp(−0.0467 t); the rate, 1.83 times as large, is the last to arrive.
    expected = np.log(1.83 * start / (NEAR * 5.0)) / 0.0467
    assert end.times[0] == pytest.approx(expected, abs=1.8)  # within half a swing
    pair = rests[0].eigenvalues[1]
    assert pair == pytest.approx(-0.047 + 1.830j, abs=1e-3)
    assert period(pair) == pytest.approx(3.433, abs=2e-3)
    assert halving_time(pair) == pytest.approx(14.85, abs=0.05)


def test_the_separatrix_leads_into_the_saddle_and_divides_the_starts(hover, rests):
    paths = separatrices(hover, True, WINDOW, rests[1], 25.0)
    from_left = next(path for path in paths if path.into and path.c[:, 0].min() < 0)
    saddle, c = rests[1].c, from_left.c
    assert c[-1] == pytest.approx(saddle)
    near = c[np.abs(c[:, 0] - 1.6).argmin()]
    (trajectory,) = trajectories(hover, hover.place([near]), 4.0, 0.01)
    assert np.abs(trajectory.c - saddle).max(axis=1).min() < 1e-2
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
    # How far back pitch may be let go.
    farthest = c[:, 0].min()
    assert farthest == pytest.approx(-1.159, abs=1e-3)
    ends = ends_from(hover, [[farthest + 0.01, 0.0], [farthest - 0.01, 0.0]], 107.0)
    assert {end.what: end.members for end in ends} == {"rest": (0,), "turning": (1,)}
    # A swing within it stays within the window.
    window = default_window(hover, {})
    inside = c[c[:, 0] < 1.8]
    last_swing = inside[np.flatnonzero(inside[:, 1] < 0)[-1] :]
    assert np.all(np.abs(last_swing[:, 1]) < window[1, 1])
    # What leaves the saddle goes to hover or over the top.
    out = [path for path in paths if not path.into]
    assert len(out) == 2
    assert sorted(path.c[-1, 0] > 2.4 for path in out) == [False, True]
    assert separatrices(hover, True, WINDOW, rests[0], 5.0) == ()  # of no saddle
    assert sticking_sets(hover, WINDOW, rests) == () and not has_impulses(VERTICAL)


def test_motions_into_a_saddle_of_three_states_fill_a_surface_and_those_out_are_motions_of_all():
    section = section_of(VERTICAL, ("omega_v", "S_v", "alpha_v"), {"alpha_v": 0.0})
    window = np.array([[-300.0, 350.0], [-2.5, 2.5], [-2.5, 2.5]])
    saddle = search(section, window)[1]
    paths = separatrices(section, True, window, saddle, 10.0)
    assert sum(path.surface for path in paths) >= 12
    assert sum(not path.into for path in paths) == 2
    x = next(path for path in paths if path.surface).c
    from_middle = trajectories(section, x[len(x) // 2][None], 3.0, 0.01)[0]
    assert (np.abs(from_middle.c - saddle.c) / np.ptp(window, axis=1)).max(axis=1).min() < 0.01
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


def test_trajectories_end_on_the_sticking_set_and_a_rotor_sticks_while_its_current_is_small():
    model = extend_model(VERTICAL, {"rub": CoulombFriction(axis="pitch", torque=F_C)})
    section = section_of(model, ("alpha_v", "rate_v"), {})
    window = np.array([[-0.8, -0.4], [-0.4, 0.4]])
    rests = search(section, window)
    sets = sticking_sets(section, window, rests)
    found = trajectories(section, default_starts(section, window, 12), 30.0, 0.05)
    (end,) = ends_of(section, window, rests, found, sets, dry_friction=True)
    assert end.what == "held" and len(end.members) == 12 and end.sticking_set is sets[0]
    low, high = sets[0].reach
    finals = np.array([trajectory.c[-1] for trajectory in found])
    assert np.all((finals[:, 0] >= low - 1e-3) & (finals[:, 0] <= high + 1e-3))
    assert np.ptp(finals[:, 0]) > 0.01  # anywhere on it, not at one point
    assert np.abs(finals[:, 1]).max() < 1e-6
    motor = extend_model(MOTOR, {"rub": RotorFriction(rotor="main", torque=0.001)})
    section = section_of(motor, ("omega_v", "i_v"), {})
    window = np.array([[-20.0, 20.0], [-0.2, 0.2]])
    (held,) = sticking_sets(section, window, search(section, window))
    assert held.what == "ω_v"
    assert held.reach == pytest.approx((-0.001 / 0.0202, 0.001 / 0.0202), rel=0.01)


NAMES = {"controller": "lqr", "observer": "full_state"}
LOOP = LoopParts(VERTICAL, Lqr(), FullState(), 0.02, NAMES)


def found(model=VERTICAL, loop=None, **keys):
    return PhasePortrait(**keys).run(Subject(model, "rig", loop), silent)


@pytest.fixture(scope="module")
def portrait():
    return found(at={"alpha_v": 0.0}, starts=12)


def marks(findings, kind):
    return [mark for mark in findings.charts[0].panels[0].marks if isinstance(mark, kind)]


def test_the_portrait_as_data_and_its_flow_and_nullclines_those_of_the_field(portrait):
    results = json.loads(json.dumps(portrait.results, allow_nan=False))
    assert [item["name"] for item in results["coordinates"]] == ["alpha_v", "rate_v"]
    assert results["section_is_invariant"] is True
    focus, saddle = results["equilibria"]
    assert (focus["kind"], saddle["kind"]) == ("stable focus", "saddle")
    ends = results["trajectories"]["ends"]
    assert sum(end["share"] for end in ends) == pytest.approx(1.0)
    assert sorted(n for end in ends for n in end["starts"]) == list(range(12))
    json.dumps([as_data(chart) for chart in portrait.charts], allow_nan=False)
    shown = {mark.label: mark for mark in marks(portrait, Points)}
    assert shown["stable focus"].marker == "stable" and shown["saddle"].marker == "saddle"
    assert shown["saddle"].x[0] == pytest.approx(1.903, abs=1e-3)
    assert "beyond the mechanical stop of α_v at ±1.05 rad" in " ".join(portrait.lead)
    # An unstable equilibrium is told by how fast it grows.
    (table,) = [b for b in portrait.sections[1].blocks if isinstance(b, Table)]
    growth = max(real for real, _ in saddle["eigenvalues"])
    times = [row[-1] for row in table.rows]
    assert times == ["halves in 14.9 s", f"doubles in {np.log(2) / growth:.3g} s"]
    contourpy = pytest.importorskip("contourpy")
    section = section_of(VERTICAL, None, {"alpha_v": 0.0})
    (flow,) = marks(portrait, Flow)
    i, j = 7, 30
    rates = section.rates([[flow.x[j], flow.y[i]]])[0]
    assert (flow.u[i, j], flow.v[i, j]) == pytest.approx(tuple(rates))
    contours = marks(portrait, Contour)
    assert [mark.label for mark in contours] == ["dα_v/dt = 0", "d²α_v/dt² = 0"]
    for place, mark in enumerate(contours):
        lines = contourpy.contour_generator(mark.x, mark.y, mark.values).lines(0.0)
        points = np.vstack(lines)
        assert len(points) > 50
        typical = np.abs(mark.values).max()
        assert np.abs(section.rates(points)[:, place]).max() < 1e-3 * typical


def test_no_trajectory_has_the_colour_of_a_nullcline_and_names_near_the_edge_are_short(portrait):
    findings = found(at={"alpha_v": 0.0}, starts=12, duration=5.0)
    moving = {c.colour for c in marks(findings, Curve) if c.label == "still moving at the end"}
    others = {c.colour for c in marks(findings, Curve) if c.label != "still moving at the end"}
    assert len(moving) == 1
    assert not moving & ({mark.colour for mark in marks(findings, Contour)} | others)
    window = {"alpha_v": (-1.0, 2.0)}
    edged = found(at={"alpha_v": 0.0}, starts=1, duration=1.0, window=window)
    inside, edge = (
        {mark.label: mark.names for mark in marks(findings, Points)}["saddle"]
        for findings in (portrait, edged)
    )
    assert inside == ("1.9",) and edge == ()


def test_commands_are_those_that_reach_the_motor():
    # The drive loses a tenth of its gain under load: the equations know nothing of it.
    derated = extend_model(
        VERTICAL, {"weak": SupplyDerating(rotor="main", depth=0.1, time_constant=0.0)}
    )
    findings = found(derated, at={"alpha_v": 0.0}, starts=({"alpha_v": 0.3},), duration=150.0)
    assert "u_v = 1.413 V: a stable focus at α_v = 0 rad" in findings.lead[0]
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "rest" and end["at"]["alpha_v"] == pytest.approx(0.0, abs=1e-6)


def test_a_projection_is_told_and_three_states_make_a_space():
    findings = found(Newtonian(), states=("alpha_v", "alpha_h"), at={"alpha_v": 0.0}, starts=3)
    assert "A projection" in findings.charts[0].caption
    assert any("a projection" in warning for warning in findings.warnings)
    assert findings.results["section_is_invariant"] is False
    # With the rates held, no angle has one: there is no field to draw.
    section = section_of(Newtonian(), ("alpha_v", "alpha_h"), {"alpha_v": 0.0})
    assert not has_field(section, np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    assert not marks(findings, Flow) and not marks(findings, Contour)
    findings = found(
        states=("omega_v", "S_v", "alpha_v"), at={"alpha_v": 0.0}, starts=4, duration=20.0
    )
    panel = findings.charts[0].panels[0]
    assert panel.z is not None and panel.z.label == "α_v"
    assert all(curve.z is not None for curve in marks(findings, Curve))
    assert not marks(findings, Flow)


def test_slopes_of_two_sides_are_told():
    yaw = found(Newtonian(freedom="horizontal"), at={"u_h": 0.0}, starts=2)
    (result,) = [words for words in yaw.warnings if "mean of both" in words]
    assert result.startswith("at α_h = 0 the slopes differ")
    assert yaw.results["equilibria"][0]["switches"] == ["alpha_h"]
    beside = found(Newtonian(freedom="horizontal"), at={"u_h": 0.5}, starts=2)
    assert not any("mean of both" in words for words in beside.warnings)


def test_a_line_of_rest_points_is_one_end_and_a_slow_motor_is_followed_to_its_own():
    findings = found(FeedbackManual(), states=("alpha_h", "rate_h"), starts=5, duration=20.0)
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "line" and "side by side on a line" in findings.lead[0]
    motor = SingleRotor(rotor="main", currents="dynamic")
    # From full speed backwards: slow where it passes standstill.
    findings = found(motor, at={"u_v": 1.0}, starts=({"omega_v": -280.0},))
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "rest" and end["at"]["omega_v"] == pytest.approx(158.527, abs=1e-2)
    assert "fast one halves in 0.0745 ms" in " ".join(findings.lead)


def test_dry_friction_takes_separatrices_away_and_a_set_too_short_to_see_is_told():
    rubbing = extend_model(VERTICAL, {"rub": CoulombFriction(axis="pitch", torque=0.02)})
    findings = found(rubbing, at={"alpha_v": 0.0}, starts=4)
    assert findings.results["separatrices"] == 0 and findings.results["sticking"]
    assert any("dry friction holds α_v" in curve.label for curve in marks(findings, Curve))
    rubbing = extend_model(VERTICAL, {"rub": CoulombFriction(axis="pitch", torque=0.0005)})
    findings = found(rubbing, starts=2)
    assert findings.results["sticking"]
    assert not any("dry friction holds" in curve.label for curve in marks(findings, Curve))
    assert "Too short to be seen" in findings.charts[0].caption


def test_a_loop_brings_every_start_to_the_goal_or_is_not_praised_and_bounds_are_marked():
    findings = found(loop=LOOP, at={"alpha_v": 0.0}, duration=12.0, starts=4, open_loop_too=True)
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "rest" and end["share"] == 1.0
    assert "All 4 trajectories under lqr reach the goal" in findings.lead[0]
    assert (findings.measures[0].label, findings.measures[0].value) == ("reach the goal", "4 of 4")
    assert not marks(findings, Flow) and not marks(findings, Contour)
    labels = {curve.label for curve in marks(findings, Curve)}
    assert {"comes to rest at the goal", "without controller"} <= labels
    (goal,) = [mark for mark in marks(findings, Points) if mark.marker == "star"]
    assert (goal.x[0], goal.y[0]) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert any("nullclines do not exist" in text for text in findings.sections[0].text)
    findings = found(loop=LOOP, at={"alpha_v": 0.0}, duration=0.4, starts=2)
    assert findings.lead[0].startswith("None of the 2 trajectories under lqr")
    findings = found(
        loop=LOOP, at={"alpha_v": 0.0}, duration=6.0, starts=({"alpha_v": -0.6, "rate_v": -1.5},)
    )
    share = findings.results["share_at_bound"]
    assert 0 < share < 1
    (at_bound,) = [c for c in marks(findings, Curve) if c.label == "command at its bound"]
    assert 0 < np.isfinite(at_bound.x).mean() < 1


def test_two_portraits_are_equal():
    motor = SingleRotor(rotor="tail", currents="dynamic")
    first, second = (found(motor, at={"u_h": 1.0}, starts=3) for _ in "ab")
    assert first.results == second.results
    assert [as_data(chart) for chart in first.charts] == [as_data(c) for c in second.charts]


def test_more_points_than_can_be_held_are_refused():
    with pytest.raises(ConfigurationError) as error:
        found(starts=400, duration=1000.0, step=1e-4)
    assert error.value.where == "step"


@pytest.mark.parametrize(
    ("typed", "where"),
    [
        (["study.states=[alpha_h,rate_h]", "study.others=settled", "study.starts=5"], None),
        (["study.starts=[{alpha_v: 0.5}]", "study.window={alpha_v: [-1, 1]}"], None),
        (["study.others=[omega_v]"], None),
        (["study.starts=0"], "study.starts"),
        (["study.others=foo"], "study.others"),
        (["study.states=alpha_v"], "study.states"),
        (["study.duration=0"], "study.duration"),
        (["study.step=1"], "study.step"),
        (["study.window={alpha_v: 1}"], "study.window.alpha_v"),
    ],
)
def test_values_of_each_kind_are_taken_and_others_refused_by_their_key(typed, where):
    config = compose(["study=phase_portrait", *typed], primary="stability").config["study"]
    if where is None:
        assert isinstance(build(config, "study"), PhasePortrait)
        return
    with pytest.raises(ConfigurationError) as error:
        build(config, "study")
    assert error.value.where == where


def test_equilibria_at_one_place_of_the_portrait_are_told_apart():
    # Hover and the saddle above it have the same speed, and no rate.
    section = section_of(VERTICAL, ("omega_v", "S_v"), {"alpha_v": 0.0})
    window = np.array([[100.0, 300.0], [-1.0, 1.0]])
    above = section.point.x + np.array([0.0, 0.0, 1.90274])
    both = [rest_point(section, x) for x in (section.point.x, above)]
    paths = trajectories(section, section.point.x[None], 1.0, 0.1)
    result = PortraitResult(
        section, window, both, paths, ends_of(section, window, both, paths), 1.0
    )
    lead = lead_of_model(result)
    assert "a stable focus at α_v = 0 rad and a saddle at α_v = 1.903 rad" in lead[0]
