"""``study=phase_portrait``: its findings for a model alone and in a loop."""

from __future__ import annotations

import json

import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.controllers.lqr import Lqr
from trms_cli.core.chart import Contour, Curve, Flow, Points, as_data
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Table
from trms_cli.core.plugins import build
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.supply_derating import SupplyDerating
from trms_cli.models.feedback_manual import FeedbackManual
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.observers.full_state import FullState
from trms_cli.stability.portraits.charts import PortraitResult, has_field
from trms_cli.stability.portraits.invariant_sets import rest_point
from trms_cli.stability.portraits.section import section_of
from trms_cli.stability.portraits.trajectories import ends_of, trajectories
from trms_cli.stability.studies.phase_portrait import PhasePortrait, lead_of_model
from trms_cli.stability.study import silent
from trms_cli.stability.subject import LoopParts, Subject

VERTICAL = Newtonian(freedom="vertical")
NAMES = {"controller": "lqr", "observer": "full_state"}
LOOP = LoopParts(VERTICAL, Lqr(), FullState(), 0.02, NAMES)


def found(model=VERTICAL, loop=None, **keys):
    return PhasePortrait(**keys).run(Subject(model, "rig", loop), silent)


@pytest.fixture(scope="module")
def hover():
    return found(at={"alpha_v": 0.0}, starts=12)


def marks(findings, kind):
    return [mark for mark in findings.charts[0].panels[0].marks if isinstance(mark, kind)]


def test_the_results_are_the_portrait_as_data(hover):
    results = json.loads(json.dumps(hover.results, allow_nan=False))
    assert [item["name"] for item in results["coordinates"]] == ["alpha_v", "rate_v"]
    assert results["section_is_invariant"] is True
    focus, saddle = results["equilibria"]
    assert (focus["kind"], saddle["kind"]) == ("stable focus", "saddle")
    ends = results["trajectories"]["ends"]
    assert sum(end["share"] for end in ends) == pytest.approx(1.0)
    assert sorted(n for end in ends for n in end["starts"]) == list(range(12))
    json.dumps([as_data(chart) for chart in hover.charts], allow_nan=False)
    shown = {mark.label: mark for mark in marks(hover, Points)}
    assert shown["stable focus"].marker == "stable" and shown["saddle"].marker == "saddle"
    assert shown["saddle"].x[0] == pytest.approx(1.903, abs=1e-3)
    assert "beyond the mechanical stop of α_v at ±1.05 rad" in " ".join(hover.lead)


def test_flow_and_nullclines_are_those_of_the_field(hover):
    contourpy = pytest.importorskip("contourpy")
    section = section_of(VERTICAL, None, {"alpha_v": 0.0})
    (flow,) = marks(hover, Flow)
    i, j = 7, 30
    rates = section.rates([[flow.x[j], flow.y[i]]])[0]
    assert (flow.u[i, j], flow.v[i, j]) == pytest.approx(tuple(rates))
    contours = marks(hover, Contour)
    assert [mark.label for mark in contours] == ["dα_v/dt = 0", "d²α_v/dt² = 0"]
    for place, mark in enumerate(contours):
        lines = contourpy.contour_generator(mark.x, mark.y, mark.values).lines(0.0)
        points = np.vstack(lines)
        assert len(points) > 50
        typical = np.abs(mark.values).max()
        assert np.abs(section.rates(points)[:, place]).max() < 1e-3 * typical


def test_an_unstable_equilibrium_is_told_by_how_fast_it_grows(hover):
    (table,) = [b for b in hover.sections[1].blocks if isinstance(b, Table)]
    focus, saddle = (row[-1] for row in table.rows)
    growth = max(real for real, _ in hover.results["equilibria"][1]["eigenvalues"])
    assert focus == "halves in 14.9 s"
    assert saddle == f"doubles in {np.log(2) / growth:.3g} s"


def test_names_near_the_right_edge_are_short(hover):
    window = {"alpha_v": (-1.0, 2.0)}
    inside, edge = (
        {mark.label: mark.names for mark in marks(findings, Points)}["saddle"]
        for findings in (hover, found(at={"alpha_v": 0.0}, starts=1, duration=1.0, window=window))
    )
    assert inside == ("1.9",) and edge == ()


def test_no_trajectory_has_the_colour_of_a_nullcline():
    findings = found(at={"alpha_v": 0.0}, starts=12, duration=5.0)
    moving = {c.colour for c in marks(findings, Curve) if c.label == "still moving at the end"}
    others = {c.colour for c in marks(findings, Curve) if c.label != "still moving at the end"}
    assert len(moving) == 1
    assert not moving & ({mark.colour for mark in marks(findings, Contour)} | others)


def test_a_sticking_set_under_its_marker_is_told_in_the_caption():
    rubbing = extend_model(VERTICAL, {"rub": CoulombFriction(axis="pitch", torque=0.0005)})
    findings = found(rubbing, starts=2)
    assert findings.results["sticking"]
    assert not any("dry friction holds" in curve.label for curve in marks(findings, Curve))
    assert "Too short to be seen" in findings.charts[0].caption


def test_commands_are_those_that_reach_the_motor():
    # The drive loses a tenth of its gain under load: the equations know nothing of it.
    derated = extend_model(
        VERTICAL, {"weak": SupplyDerating(rotor="main", depth=0.1, time_constant=0.0)}
    )
    findings = found(derated, at={"alpha_v": 0.0}, starts=({"alpha_v": 0.3},), duration=150.0)
    assert "u_v = 1.413 V: a stable focus at α_v = 0 rad" in findings.lead[0]
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "rest" and end["at"]["alpha_v"] == pytest.approx(0.0, abs=1e-6)


def test_a_projection_is_told():
    findings = found(Newtonian(), states=("alpha_v", "alpha_h"), at={"alpha_v": 0.0}, starts=3)
    assert "A projection" in findings.charts[0].caption
    assert any("a projection" in warning for warning in findings.warnings)
    assert findings.results["section_is_invariant"] is False
    # With the rates held, no angle has one: there is no field to draw.
    section = section_of(Newtonian(), ("alpha_v", "alpha_h"), {"alpha_v": 0.0})
    assert not has_field(section, np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    assert not marks(findings, Flow) and not marks(findings, Contour)


def test_slopes_of_two_sides_are_told():
    yaw = found(Newtonian(freedom="horizontal"), at={"u_h": 0.0}, starts=2)
    (result,) = [words for words in yaw.warnings if "mean of both" in words]
    assert result.startswith("at α_h = 0 the slopes differ")
    assert yaw.results["equilibria"][0]["switches"] == ["alpha_h"]
    beside = found(Newtonian(freedom="horizontal"), at={"u_h": 0.5}, starts=2)
    assert not any("mean of both" in words for words in beside.warnings)


def test_three_states_make_a_space():
    findings = found(
        states=("omega_v", "S_v", "alpha_v"), at={"alpha_v": 0.0}, starts=4, duration=20.0
    )
    panel = findings.charts[0].panels[0]
    assert panel.z is not None and panel.z.label == "α_v"
    assert all(curve.z is not None for curve in marks(findings, Curve))
    assert not marks(findings, Flow)


def test_a_slow_motor_is_followed_until_it_has_arrived():
    motor = SingleRotor(rotor="main", currents="dynamic")
    # From full speed backwards: slow where it passes standstill.
    findings = found(motor, at={"u_v": 1.0}, starts=({"omega_v": -280.0},))
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "rest" and end["at"]["omega_v"] == pytest.approx(158.527, abs=1e-2)
    assert "fast one halves in 0.0745 ms" in " ".join(findings.lead)


def test_a_line_of_rest_points_is_one_end():
    findings = found(FeedbackManual(), states=("alpha_h", "rate_h"), starts=5, duration=20.0)
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "line" and "side by side on a line" in findings.lead[0]


def test_dry_friction_takes_the_separatrices_away():
    rubbing = extend_model(VERTICAL, {"rub": CoulombFriction(axis="pitch", torque=0.02)})
    findings = found(rubbing, at={"alpha_v": 0.0}, starts=4)
    assert findings.results["separatrices"] == 0 and findings.results["sticking"]
    assert any("dry friction holds α_v" in curve.label for curve in marks(findings, Curve))


def test_a_loop_brings_every_start_to_the_goal():
    findings = found(loop=LOOP, at={"alpha_v": 0.0}, duration=12.0, starts=4, open_loop_too=True)
    (end,) = findings.results["trajectories"]["ends"]
    assert end["what"] == "rest" and end["share"] == 1.0
    assert "All 4 trajectories under lqr reach the goal" in findings.lead[0]
    assert not marks(findings, Flow) and not marks(findings, Contour)
    labels = {curve.label for curve in marks(findings, Curve)}
    assert {"comes to rest at the goal", "without controller"} <= labels
    (goal,) = [mark for mark in marks(findings, Points) if mark.marker == "star"]
    assert (goal.x[0], goal.y[0]) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert any("nullclines do not exist" in text for text in findings.sections[0].text)


def test_a_command_at_its_bound_is_marked():
    findings = found(
        loop=LOOP, at={"alpha_v": 0.0}, duration=6.0, starts=({"alpha_v": -0.6, "rate_v": -1.5},)
    )
    share = findings.results["share_at_bound"]
    assert 0 < share < 1
    (at_bound,) = [c for c in marks(findings, Curve) if c.label == "command at its bound"]
    assert 0 < np.isfinite(at_bound.x).mean() < 1


def test_a_loop_that_does_not_arrive_is_not_praised():
    findings = found(loop=LOOP, at={"alpha_v": 0.0}, duration=0.4, starts=2)
    assert findings.lead[0].startswith("None of the 2 trajectories under lqr")


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
    "typed",
    [
        ["study.states=[alpha_h,rate_h]", "study.others=settled", "study.starts=5"],
        ["study.starts=[{alpha_v: 0.5}]", "study.window={alpha_v: [-1, 1]}"],
        ["study.others=[omega_v]"],
    ],
)
def test_values_of_each_kind_are_taken(typed):
    config = compose(["study=phase_portrait", *typed], primary="stability").config["study"]
    assert isinstance(build(config, "study"), PhasePortrait)


@pytest.mark.parametrize(
    ("typed", "where"),
    [
        ("study.starts=0", "study.starts"),
        ("study.others=foo", "study.others"),
        ("study.states=alpha_v", "study.states"),
        ("study.duration=0", "study.duration"),
        ("study.step=1", "study.step"),
        ("study.window={alpha_v: 1}", "study.window.alpha_v"),
    ],
)
def test_values_of_the_wrong_kind_are_refused_by_their_key(typed, where):
    config = compose(["study=phase_portrait", typed], primary="stability").config["study"]
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
