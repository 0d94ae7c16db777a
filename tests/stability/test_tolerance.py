"""What a loop tolerates: the loop run from any state with its commands changed on the way, the
parts of the search, and the study against the linear margins.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.controllers.lqr import Lqr
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.extended_model import effect_names, extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.rotor_reaction import RotorReaction
from trms_cli.models.newtonian import Newtonian
from trms_cli.stability.closed_loop import Enough, LoopRun, run_loop
from trms_cli.stability.loops.tolerance import (
    Bounds,
    CommandDelay,
    Impairment,
    ImpairmentLimits,
    RunVerdict,
    TrialRun,
    find_failure,
    impairments_of,
)
from trms_cli.stability.studies.margins import Margins
from trms_cli.stability.studies.tolerance import Tolerance, _sentence
from trms_cli.stability.study import silent

from .loop_cases import AT, MODEL, POINT, Changed, loop_of, lqr, subject_of

BOUNDS = Bounds(rest=0.02, swing=0.002, chatter=0.02)
TIME = np.arange(0, 40, 0.02)
STILL = np.zeros((TIME.size, 1))


def kind(errors: np.ndarray, commands: np.ndarray = STILL, ended: bool = False) -> str:
    return BOUNDS.verdict(errors.reshape(TIME.size, -1), commands, ended).kind


def swing(decay: float) -> np.ndarray:
    return 0.1 * np.exp(-decay * TIME) * np.cos(1.8 * TIME)


class TestVerdicts:
    @pytest.mark.parametrize(
        ("error", "told"),
        [
            (swing(0.3), "settles"),
            (swing(0.06), "dies out"),
            (swing(0.0), "swings"),
            (swing(-0.05), "swings"),
            # An error that stays.
            (0.03 + 0.1 * np.exp(-TIME), "rests beside"),
            (0.01 + 0.1 * np.exp(-TIME), "settles"),
            (0.3 * np.exp(-0.08 * TIME), "dies out"),
            # One that shrinks too slowly is no rest.
            (0.3 * np.exp(-0.03 * TIME), "still creeping"),
            (0.05 + 0.3 * np.exp(-0.1 * TIME), "still creeping"),
            (0.05 + 0.3 * np.exp(-0.5 * TIME), "rests beside"),
            (-0.3 * np.exp(0.01 * TIME), "rests beside"),
            (0.4 + 0.15 * np.exp(-0.02 * TIME) * np.cos(0.23 * TIME), "rests beside"),
            # A slip is no swing.
            (np.where(TIME < 33, 0.015, -0.005), "dies out"),
        ],
    )
    def test_of_one_angle(self, error, told):
        assert kind(error) == told

    def test_of_commands_at_their_limit_that_chatter_and_of_a_run_that_ended(self):
        assert kind(0.3 * np.exp(-0.03 * TIME), np.ones_like(STILL)) == "rests beside"
        fast = 0.1 * np.sign(np.cos(np.pi * np.arange(TIME.size)))[:, None]
        assert kind(1e-5 * np.cos(TIME), fast) == "chatters"
        assert kind(np.exp(0.1 * TIME), ended=True) == "is lost"
        assert BOUNDS.verdict(np.ones((1, 2)), np.ones((1, 2)), True).axis == 0

    def test_names_the_angle_that_fails(self):
        both = np.column_stack([0.3 * np.exp(-0.03 * TIME), 0.05 * np.ones_like(TIME)])
        found = BOUNDS.verdict(both, STILL, False)
        assert found.kind == "rests beside" and found.axis == 1
        assert found.calm and not found.back
        both = np.column_stack([0.015 * np.ones_like(TIME), 0.01 * np.cos(TIME)])
        found = BOUNDS.verdict(both, STILL, False)
        assert found.kind == "swings" and found.axis == 1 and not found.calm and not found.back


def tried(size: float, good: bool) -> TrialRun:
    told = "settles" if good else "swings"
    run = LoopRun(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    return TrialRun(size, run, RunVerdict(told, np.zeros(1), np.zeros(1), 0))


def search(sizes, stood, precision=1.1, nothing=0.0):
    return find_failure(
        sizes,
        tried(nothing, True),
        lambda size: tried(size, stood(size)),
        precision,
        lambda one: not one.verdict.calm,
    )


class TestTheSearch:
    @given(st.floats(0.011, 0.79), st.floats(1.01, 1.5))
    def test_closes_in_on_a_limit(self, limit, precision):
        found = search((0.05, 0.1, 0.2, 0.4, 0.8), lambda size: size < limit, precision)
        assert found.below.size < limit <= found.above.size
        assert found.above.size <= precision * found.below.size
        assert found.below.size < found.limit < found.above.size
        assert found.again == ()

    def test_tells_that_all_is_stood_that_a_loop_recovers_and_that_nothing_is_stood(self):
        found = search((0.1, 0.2), lambda size: True)
        assert found.above is None and found.limit is None and found.below.size == 0.2
        found = search((1.5, 3.0, 6.0, 12.0), lambda size: size < 2 or size > 10, nothing=1.0)
        assert 1.9 < found.limit < 2.1
        assert found.again == (12.0,)
        found = search((0.1,), lambda size: size <= 0)
        assert found.below.size == 0 and found.above.size == pytest.approx(0.1 / 2**10)


class TestWhatGoesWrong:
    @pytest.mark.parametrize("delay", [0.0, 0.04, 0.05])
    def test_a_delay_is_that_of_the_effect(self, delay):
        rig = MODEL
        for rotor in ("main", "tail"):
            rig = extend_model(rig, {f"{rotor}_late": InputDelay(rotor=rotor, delay=delay)})
        loop, offset = loop_of(lqr()), {"alpha_v": -0.05, "alpha_h": -0.05}
        path = Impairment("delay").path(MODEL, POINT, 0.02, delay)
        ours = run_loop(MODEL, loop, POINT, 8.0, offset=offset, path=path)
        theirs = run_loop(rig, loop, POINT, 8.0, offset=offset)
        # of a whole number of samples it is the same, else the mean over a sample differs a little
        assert np.abs(ours.x - theirs.x)[:, -1].max() < (1e-9 if delay != 0.05 else 2e-4)

    def test_before_the_first_command_the_points_own_is_in_force(self):
        delayed = CommandDelay(2.25, np.array([1.0]))
        given = [delayed(k, np.array([float(k + 2)]))[0] for k in range(5)]
        # u(k − 2) and u(k − 3), three parts to one
        assert given == pytest.approx([1.0, 1.0, 0.75 * 2 + 0.25 * 1, 2.75, 3.75])

    def test_a_gain_acts_on_all_of_a_command_within_its_limits(self):
        large = Impairment("gain", "u_h", up=True).path(MODEL, POINT, 0.02, 3.0)
        assert large(0, np.array([1.0, 0.5])) == pytest.approx([1.0, 1.5])
        assert large(0, np.array([1.0, -1.0])) == pytest.approx([1.0, -2.5])
        small = Impairment("gain", "u_v")
        assert small.shown(4.0) == 0.25
        assert small.path(MODEL, POINT, 0.02, 4.0)(0, np.ones(2)) == pytest.approx([0.25, 1.0])
        changed = Impairment("gain", "u_v", up=True, of_changes=True)
        changes = changed.path(MODEL, POINT, 0.02, 2.0)
        assert changes(0, POINT.u + 0.1) == pytest.approx(POINT.u + np.array([0.2, 0.1]))

    def test_friction_is_an_effect_on_the_rig_and_each_rig_has_its_own(self):
        rig = Impairment("friction", "pitch").rig(MODEL, 0.004)
        assert effect_names(rig) == ("added_friction_pitch",)
        assert rig.parameters["added_friction_pitch.torque"].value == 0.004
        keys = [one.key for one in impairments_of(Newtonian(freedom="vertical"))]
        assert keys == ["delay", "gain_up_u_v", "gain_down_u_v", "friction_pitch"]


#: Close to the point the rig is linear, and the simulated limit has to be the foretold one.
NEAR = Tolerance(
    at=AT,
    offset={"alpha_v": -0.002, "alpha_h": -0.002},
    duration=30.0,
    rest=0.002,
    swing=0.00005,
    chatter=0.0005,
    delays=(0.1, 0.2),
    gains=(),
    frictions=(),
    precision=1.02,
)


class TestTheStudy:
    @pytest.mark.parametrize("gain", [1.0, pytest.param(0.7, marks=pytest.mark.slow)])
    def test_near_its_point_a_loop_stands_the_delay_that_its_margins_foretell(self, gain):
        findings = NEAR.run(subject_of(Changed(lqr(), gain=(gain, gain))), silent)
        found = findings.results["tolerances"]["delay"]
        # the hold of a fraction of a control period is not the phase of a delay, but nearly
        assert found["calm"]["limit"] == pytest.approx(found["linear"], rel=0.06)
        assert found["compared"] == "as foretold"

    @pytest.mark.slow
    def test_far_from_it_tells_all_limits(self):
        study = replace(
            NEAR,
            offset={"alpha_v": -0.2, "alpha_h": -0.2},
            rest=0.02,
            swing=0.002,
            chatter=0.02,
            gains=(2.0, 8.0),
            frictions=(0.003,),
            precision=1.5,
        )
        findings = study.run(subject_of(lqr()), silent)
        told = findings.results["tolerances"]
        json.dumps(findings.results, allow_nan=False)
        assert set(told) == {
            *("delay", "gain_up_u_v", "gain_down_u_v", "gain_up_u_h", "gain_down_u_h"),
            *("friction_pitch", "friction_yaw"),
        }
        # 1.41 V hold the point: a gain below 1.41/2.5 cannot
        share = float(POINT.u[0]) / 2.5
        down = told["gain_down_u_v"]["back"]
        assert down["above"] <= share and down["below"] > 0.8 * share
        assert down["verdict"] == "rests beside"
        assert f"below {share:.2g}" in told["gain_down_u_v"]["compared"]
        assert told["friction_pitch"]["linear"] is None
        drawn = {chart.name for chart in findings.charts}
        assert drawn == {"tolerance_overview", "tolerance_responses"}
        assert len(findings.lead) == 8

    def test_its_margins_are_those_of_the_other_study(self):
        """Both studies measure by the same defaults."""
        ours, theirs = Tolerance(), Margins()
        assert ours.at == theirs.at
        assert math.isclose(theirs.lowest, 0.1) and theirs.periods == 6


def test_a_gain_too_small_is_stood_down_to_a_factor():
    impairment = Impairment("gain", "u_v")
    found = search((2.0, 4.0), lambda size: size < 1.8, nothing=1.0)
    told = _sentence(ImpairmentLimits(impairment, found, found, None, True))
    assert "stood down to ×0." in told and "up to" not in told
    found = search((2.0, 4.0), lambda size: True, nothing=1.0)
    told = _sentence(ImpairmentLimits(impairment, found, found, None, True))
    assert "stood down to ×0.25, the most tried" in told
    told = _sentence(ImpairmentLimits(replace(impairment, up=True), found, found, None, True))
    assert "stood up to ×4" in told


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"delays": ()}, "no sizes"),
        ({"offset": {"alpha_x": 0.1}}, "alpha_x"),
        ({"offset": {"alpha_v": -2.0}}, "counts as lost"),
        pytest.param(
            {"duration": 1.0, "swing": 1e-9, "rest": 1e-9},
            "with nothing wrong",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_makes_no_sense_is_refused(keys, says):
    with pytest.raises(ConfigurationError, match=says):
        replace(NEAR, **keys).run(subject_of(lqr()), silent)


@pytest.mark.slow
def test_a_loop_that_does_not_hold():
    findings = NEAR.run(subject_of(Changed(lqr(), late=4)), silent)
    assert findings.results["holds"] is False


LOOP = loop_of(Lqr())
PITCH = MODEL.state_index("alpha_v")


def test_the_loop_rests_at_its_point_comes_back_to_it_goes_to_another_and_repeats_itself():
    run = run_loop(MODEL, LOOP, POINT, 2.0)
    assert run.time.shape == (100,) and run.x.shape == (100, 6) and run.u.shape == (100, 2)
    assert np.abs(run.x - POINT.x).max() < 1e-6 and not run.ended and not run.failures
    assert run.statuses == {"ok": 100}
    run = run_loop(MODEL, LOOP, POINT, 20.0, offset={"alpha_v": 0.1})
    assert run.x[0, PITCH] == pytest.approx(0.1, abs=1e-9)
    assert np.abs(run.x[-1] - POINT.x).max() < 0.01
    run = run_loop(MODEL, LOOP, POINT, 20.0, reference={"alpha_v": 0.2})
    assert run.x[-1, PITCH] == pytest.approx(0.2, abs=0.01)
    first, second = (run_loop(MODEL, LOOP, POINT, 3.0, offset={"alpha_h": 0.1}) for _ in "ab")
    assert np.array_equal(first.x, second.x) and np.array_equal(first.u, second.u)


def test_what_reaches_the_motors_and_what_the_rig_is_may_differ_from_what_the_controller_knows():
    run = run_loop(MODEL, LOOP, POINT, 1.0, path=lambda k, u: u + (0.1 if k == 10 else 0.0))
    assert run.applied[10] == pytest.approx(run.u[10] + 0.1)
    assert np.delete(run.applied, 10, 0) == pytest.approx(np.delete(run.u, 10, 0))
    assert np.abs(run.x[:11] - POINT.x).max() < 1e-6 < np.abs(run.x[12:] - POINT.x).max()
    rig = extend_model(MODEL, {"reaction": RotorReaction(rotor="main", drag=3e-7, inertia=1e-4)})
    known, other = (run_loop(model, LOOP, POINT, 20.0) for model in (MODEL, rig))
    assert np.abs(other.x - known.x).max() > 0.01


def test_a_run_may_end_at_a_state_or_when_its_path_has_enough():
    def enough(k, u):
        if k == 20:
            raise Enough("seen")
        return u

    by_path = run_loop(MODEL, LOOP, POINT, 2.0, path=enough)
    assert by_path.ended == "seen" and by_path.x.shape == (20, 6) and by_path.u.shape == (20, 2)
    at_once = run_loop(MODEL, LOOP, POINT, 2.0, until=lambda x: "here")
    assert at_once.ended == "here" and at_once.x.shape == (0, 6) and at_once.u.shape == (0, 2)
