"""From scores to probabilities, and the constants fitted to rigs whose truth is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.gap.blind.cases import Case
from experiments.gap.blind.judgement import right_causes
from experiments.gap.calibrate import features_of, fit_weights, loss, usual_shares
from tests.gap.diagnosis_case import diagnosis
from tests.gap.recorded import effect
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import json_data
from trms_cli.gap import belief
from trms_cli.gap.belief import (
    Features,
    alternatives,
    calibration,
    change_probabilities,
    change_worth,
    own_feature,
    probabilities_of,
    shares_of,
    usual_gains,
)
from trms_cli.gap.diagnosis import Cause, Onset, SizeEstimate
from trms_cli.gap.posterior import _verdict, merged, special_cases
from trms_cli.gap.problem import applicable_candidates
from trms_cli.library.tasks.diagnose import applied_cause, corrected_words
from trms_cli.models.newtonian import Newtonian

NAMES = (("a",), ("b",), ("a", "b"))


def features(
    gained=0.0, behind=0.0, scores=(0.0, 0.0, 0.0), behinds=(0.0, 0.0, 0.0), errors=1.0
) -> Features:
    return Features(
        gained=gained,
        behind=behind,
        names=NAMES,
        scores=np.array(scores),
        behinds=np.array(behinds),
        sizes=np.array([1, 2, 3]),
        surprises=np.zeros(3),
        errors=np.full(3, errors),
        refit_error=4.0,
        raw_error=4.0,
    )


nats = st.floats(-100, 5000)


@settings(max_examples=100, deadline=None)
@given(st.tuples(nats, nats, nats), st.floats(0, 1e5), st.floats(0, 1e5), nats)
def test_probabilities_are_probabilities(scores, behind, remaining_gap, gained):
    probabilities = probabilities_of(
        features(gained, behind, scores, (remaining_gap, remaining_gap, remaining_gap)),
        calibration().weights,
    )
    assert sum(probabilities.values()) == pytest.approx(1.0)
    assert all(0 <= p <= 1 for p in probabilities.values())
    assert list(probabilities.values()) == sorted(probabilities.values(), reverse=True)


def test_a_cause_that_closes_the_gap_is_believed_and_one_that_leaves_most_of_it_is_not():
    closes = features(behind=3000.0, scores=(2900.0, 50.0, 2901.0), behinds=(0.0, 2900.0, 0.0))
    leaves = features(behind=3000.0, scores=(40.0, 30.0, 41.0), behinds=(2900.0,) * 3)
    for case, first in (
        (features(gained=-3.0), "no_gap"),
        (features(gained=1000.0), "parameters_only"),
        (closes, "a"),
        (leaves, "none_of_these"),
    ):
        assert next(iter(probabilities_of(case, calibration().weights))) == (first,)
    # Of two that explain the same the simpler is likelier.
    probabilities = probabilities_of(
        features(behind=500.0, scores=(480.0, 480.0, 480.0)), calibration().weights
    )
    assert probabilities["a",] > probabilities["b",] > probabilities["a", "b"]
    # One that could not be simulated is no candidate.
    probabilities = probabilities_of(features(scores=(np.nan, 5.0, -np.inf)), calibration().weights)
    assert ("a",) not in probabilities


def test_a_cause_that_harms_a_channel_on_the_sealed_part_is_believed_less():
    def of_a(harm):
        case = features(behind=500.0, scores=(100.0, 0.0, 0.0))
        case = replace(case, harms=np.array([harm, np.nan, np.nan]))
        return probabilities_of(case, calibration().weights)["a",]

    assert of_a(1.2) < 0.5 * of_a(0.0)
    assert of_a(1.2) < of_a(0.6) < of_a(0.0)
    # a little is chance, a help to all channels is told by the errors, and unknown is unknown
    assert of_a(0.05) == of_a(-0.5) == of_a(np.nan) == of_a(0.0)


def test_a_cause_that_begins_within_the_recordings_is_believed_less():
    """With a moment to choose, a drive's wander looks like a derating from somewhere on."""
    throughout = features(gained=5e4, behind=0.1, scores=(27.0, 2.0, 0.0))
    begins = replace(throughout, begins=np.array([1.0, 0.0, 0.0]))
    weights = calibration().weights
    before, after = (probabilities_of(f, weights) for f in (throughout, begins))
    odds = [p["a",] / p["parameters_only",] for p in (before, after)]
    assert odds[0] > 1 > odds[1] and odds[1] < 0.2 * odds[0]
    # where much speaks for it, it is named all the same
    sure = replace(begins, scores=np.array([150.0, 2.0, 0.0]), behind=500.0)
    assert probabilities_of(sure, weights)["a",] > 0.8


def test_scores_that_come_from_a_few_blocks_count_less(monkeypatch):
    monkeypatch.setattr(belief, "LAPSE", 0.0)

    def of_a(deviation):
        case = features(behind=900.0, scores=(600.0, 0.0, 0.0))
        case = replace(case, deviations=np.array([deviation, 1.0, 1.0]))
        return probabilities_of(case, calibration().weights)["a",]

    # 600 ± 40 nats are what a likelihood scatters by, 600 ± 300 nats are one block's
    assert of_a(0.0) == of_a(40.0) > 0.999
    assert of_a(40.0) > of_a(200.0) > of_a(300.0) > of_a(500.0)
    assert 1 - of_a(500.0) > 20 * (1 - of_a(200.0))


def test_a_further_effect_is_judged_by_the_scatter_of_what_it_adds(monkeypatch):
    """The first shows in some blocks more than in others, which says nothing of the second."""
    monkeypatch.setattr(belief, "LAPSE", 0.0)
    first = np.array([10.0, 300.0, 20.0, 250.0, 20.0])
    steady, single = np.full(5, 12.0), np.array([0.0, 0.0, 60.0, 0.0, 0.0])

    def odds(added, by_block=True):
        blocks = np.stack([first, first / 10, first + added])
        case = features(behind=900.0, scores=tuple(blocks.sum(axis=1)))
        case = replace(
            case,
            deviations=np.array([belief.standard_error(b) for b in blocks]),
            by_block=blocks if by_block else np.zeros((0, 0)),
            flexible=500.0,
        )
        probabilities = probabilities_of(case, calibration().weights)
        # what reaches less of the gap gains no lead by it
        assert probabilities["none_of_these",] < 0.05
        return probabilities["a", "b"] / probabilities["a",]

    assert odds(steady) > 5 > 1 > odds(single)
    assert odds(steady) > 20 * odds(steady, by_block=False)
    assert odds(single) < 2 * odds(single, by_block=False)


def test_scores_keep_their_order_when_a_further_effect_counts_more():
    """A single effect and a force without a name that explain more than two lead them still."""
    blocks = np.array([[10.0, 200.0, 10.0], [20.0, 300.0, 20.0], [50.0, 240.0, 40.0]])
    case = features(behind=900.0, scores=tuple(blocks.sum(axis=1)))
    case = replace(
        case,
        deviations=np.array([belief.standard_error(b) for b in blocks]),
        by_block=blocks,
        flexible=400.0,
    )
    rows = alternatives(case)
    scores = {name: row["score"] for name, row in rows.items() if "score" in row}
    assert scores["a",] < scores["a", "b"] < scores["b",] < scores["none_of_these",]
    assert scores["none_of_these",] < 400.0


def test_what_a_further_effect_adds_speaks_for_no_other_competitor():
    """Of a real rig a steady second delay once lifted a law whose score came from one block."""
    one_block = np.array([380.0, 0.0, 10.0, 0.0, 10.0])
    first, steady = np.array([0.0, 250.0, 10.0, 20.0, 20.0]), np.full(5, 19.0)
    blocks = np.stack([first, one_block, first + steady, first + 2 * steady])
    case = replace(
        features(behind=900.0),
        names=(("a",), ("b",), ("a", "c"), ("a", "c", "d")),
        scores=blocks.sum(axis=1),
        behinds=np.zeros(4),
        sizes=np.array([1, 1, 2, 3]),
        surprises=np.zeros(4),
        errors=np.ones(4),
        deviations=np.array([belief.standard_error(b) for b in blocks]),
        by_block=blocks,
    )
    scores = {n: row["score"] for n, row in alternatives(case).items() if n in case.names}
    share = scores["b",] / 400.0
    assert share < 0.5
    assert scores["a",] == pytest.approx(300.0 * share)
    assert scores["a", "c"] == pytest.approx(395.0 * share)  # b explains more
    assert scores["a", "c", "d"] == pytest.approx(490.0 * share + 190.0 * (1 - share))


def test_a_further_effect_leads_by_no_more_than_it_gains():
    """Of a drive with a rate limit a lag of 0.2 ms was told as well: it gained 4 nats of 2300."""
    lag = np.array([10.0, 90.0, 20.0, 60.0, 20.0])
    limit = lag + np.array([200.0, 500.0, 300.0, 600.0, 400.0])
    blocks = np.stack([lag, limit, limit + 0.8])
    case = replace(
        features(behind=5000.0, scores=tuple(blocks.sum(axis=1))),
        deviations=np.array([belief.standard_error(b) for b in blocks]),
        by_block=blocks,
    )
    scores = {n: row["score"] for n, row in alternatives(case).items() if n in case.names}
    assert 0 < scores["a", "b"] - scores["b",] < 4.1
    # a bench's weights were proved without
    rows = alternatives(replace(case, bench=True))
    assert rows["a", "b"]["score"] - rows["b",]["score"] > 20


def test_stribeck_friction_without_an_excess_is_coulomb_friction():
    model = Newtonian()
    both = {n: effect(n) for n in ("yaw_stribeck_friction", "yaw_coulomb_friction")}
    candidates, _ = applicable_candidates(model, both)

    def entry(excess, *names, velocity=0.03, sd=0.0):
        """A stand-in for a fit; ``sd`` of the excess, zero where it lies on a bound."""
        effects = tuple(candidates[n] for n in names)
        stribeck = "yaw_stribeck_friction"
        values = {f"{stribeck}.excess": excess, f"{stribeck}.velocity": velocity}
        sds = {f"{stribeck}.excess": sd, f"{stribeck}.velocity": 0.0}
        return SimpleNamespace(
            names=names, structure=SimpleNamespace(effects=effects), values=values, sds=sds
        )

    coulomb = entry(0.0, "yaw_coulomb_friction")
    stribeck, small = (entry(e, "yaw_stribeck_friction") for e in (0.5, 0.05))
    probabilities = {
        ("yaw_stribeck_friction",): 0.6,
        ("yaw_coulomb_friction",): 0.3,
        ("no_gap",): 0.1,
    }
    assert special_cases([stribeck, coulomb], candidates) == {}
    merged_probabilities = merged(probabilities, special_cases([small, coulomb], candidates))
    assert merged_probabilities == {("yaw_coulomb_friction",): pytest.approx(0.9), ("no_gap",): 0.1}
    # an excess that is gone at a few mrad/s is that of bristles
    bristles = entry(0.5, "yaw_stribeck_friction", velocity=0.005)
    assert special_cases([bristles, coulomb], candidates) == special_cases(
        [small, coulomb], candidates
    )
    # what has both has one friction
    both_small = entry(0.05, *sorted(both))
    assert special_cases([both_small, coulomb], candidates) == {
        both_small.names: {("yaw_coulomb_friction",): 1.0, both_small.names: 0.0}
    }
    # beside a torque from outside as alone; and where it was not fitted it keeps its name
    beside = {("yaw_disturbance", "yaw_stribeck_friction"): 1.0}
    special = special_cases([small, coulomb], candidates)
    assert merged(beside, special) == {("yaw_coulomb_friction", "yaw_disturbance"): 1.0}
    assert special_cases([small], candidates) == {}
    # an excess that is not known to lie below a fifth is not wholly that of bristles
    for excess, share in ((0.193, 0.535), (0.207, 0.465), (0.36, 0.0228)):
        near = entry(excess, "yaw_stribeck_friction", sd=0.08)
        merged_probabilities = merged(probabilities, special_cases([near, coulomb], candidates))
        assert merged_probabilities == {
            ("yaw_stribeck_friction",): pytest.approx(0.6 * (1 - share), abs=1e-3),
            ("yaw_coulomb_friction",): pytest.approx(0.3 + 0.6 * share, abs=1e-3),
            ("no_gap",): 0.1,
        }


def test_a_model_whose_free_runs_diverge_is_no_better_than_the_worst():
    weights = calibration().weights
    bad = replace(features(), raw_error=50.0, refit_error=50.0)
    gone = replace(features(), raw_error=np.inf, refit_error=np.inf)
    assert probabilities_of(gone, weights) == probabilities_of(bad, weights)
    document = json_data(replace(gone, errors=np.array([np.inf, 2.0, 1.0])))
    assert features_of(document).errors.tolist() == [np.inf, 2.0, 1.0]
    assert features_of(document).raw_error == np.inf


def test_nothing_changed_is_held_against_what_recordings_of_one_state_gain():
    kinds = ["effect", "effect", "parameter"]
    constants = calibration().change

    def unchanged(gain, usual):
        gains = np.array([gain, 0.0, 0.0])
        each, none, other = change_probabilities(kinds, gains, np.zeros(3), -5.0, usual, constants)
        assert each.sum() + none + other == pytest.approx(1.0)
        assert each[0] >= each[1]
        return none

    assert unchanged(3.0, (4.0, 2.0)) > 0.5 > unchanged(200.0, (4.0, 2.0))
    # what recordings of one state gain among themselves is no change
    assert unchanged(40.0, (35.0, 50.0)) > unchanged(40.0, (1.0, 2.0))
    worth = change_worth(kinds, np.zeros(3), np.zeros(3), constants)
    # a kind's belief is shared among its members
    assert np.exp(worth[:2]).sum() == pytest.approx(constants["effect"])


def test_only_what_gains_between_recordings_of_one_state_is_usual():
    between = [{"lag": 60.0, "friction": 2.0}, {"lag": 20.0}]
    assert usual_gains({"lag": 70.0, "friction": 30.0}, between) == (60.0, 20.0)
    # a lag that differs from day to day is a quarter of a reason to doubt a friction
    assert usual_gains({"lag": 10.0, "friction": 30.0}, between) == (15.0, 5.0)
    assert usual_gains({"friction": 30.0}, [{"friction": -3.0}]) == (0.0,)


def test_the_fit_of_the_constants_finds_honest_ones():
    """Cases are drawn from other constants; those are less surprised after a fit."""
    random = np.random.default_rng(1)
    own = calibration().weights
    truth = {**own, "score": 0.05, "effect.further": -2.0, "none.constant": -3.0}
    cases = []
    for _ in range(120):
        drawn = features(
            random.normal(0, 10),
            random.exponential(20),
            random.normal(0, 40, 3),
            random.exponential(20, 3),
        )
        believed = probabilities_of(drawn, truth)
        names = list(believed)
        right = names[random.choice(len(names), p=list(believed.values()))]
        cases.append((drawn, frozenset({right})))
    wrong = {**truth, "score": 0.3, "effect.further": -0.8, "none.constant": -8.0}
    fitted_weights = fit_weights(wrong, cases)
    assert loss(fitted_weights, cases) < loss(wrong, cases) - 0.3
    assert loss(fitted_weights, cases) < loss(truth, cases) + 0.1


def test_what_is_right_for_each_kind_of_case():
    assert right_causes(Case(kind="null")) == (("no_gap",),)
    assert right_causes(Case(kind="offset")) == (("parameters_only",),)
    assert right_causes(Case(kind="outside", effects={"x": {}})) == (("none_of_these",),)
    assert right_causes(Case(kind="pair", effects={"b": {}, "a": {}})) == (("a", "b"),)
    # Usual errors are those that rigs without an effect seldom exceed.
    nulls = [{"pitch_moment": 0.01 * k} for k in range(1, 11)]
    assert usual_shares(nulls)["pitch_moment"] == pytest.approx(0.091, abs=0.001)
    assert usual_shares([{"pitch_moment": 0.004}]) == {"pitch_moment": 0.01}
    assert usual_shares([]) == {}


def test_features_survive_the_file():
    case = features(3.0, 4.0, (1.0, np.nan, 2.0), (0.0, 1.0, 2.0))
    again = features_of(json_data(case))
    np.testing.assert_array_equal(again.scores, case.scores)
    assert again.names == NAMES


def pulled() -> Features:
    """A torque on yaw that nothing foretells, and no cause that explains it."""
    return replace(
        features(behind=9000.0, scores=(1.0, 2.0, 0.0), behinds=(8900.0,) * 3, errors=20.0),
        outside={"yaw": np.array([0.0, 0.0, 0.0, 0.0])},
        flexible=5.0,
        foretold=0.02,
    )


def test_a_torque_from_outside_is_what_nothing_foretells():
    """Alone, and beside a cause that explains the rest."""
    weights = calibration().weights
    gap = pulled()
    assert next(iter(probabilities_of(gap, weights))) == ("yaw_disturbance",)
    law = replace(gap, flexible=600.0, foretold=0.9)
    assert next(iter(probabilities_of(law, weights))) == ("none_of_these",)
    assert probabilities_of(law, weights)["yaw_disturbance",] < 0.01
    beside = replace(
        gap, scores=np.array([300.0, 2.0, 0.0]), outside={"yaw": np.array([4e3, 0.0, 4e3, 4e3])}
    )
    assert next(iter(probabilities_of(beside, weights))) == ("a", "yaw_disturbance")
    # an effect beside it is a further one: it need not overcome that nothing acts at all
    rows = alternatives(beside)
    first, joint = rows["a",], rows["a", "yaw_disturbance"]
    assert (first["effect.constant"], joint["effect.constant"]) == (1.0, 0.0)
    assert (first["effect.further"], joint["effect.further"]) == (0.0, 1.0)


def test_the_least_gain_of_a_long_recording_is_no_gap():
    """What is significant need not matter: errors of one step that fall by a percent are none."""
    weights = calibration().weights
    null = replace(features(gained=150.0), samples=2e4, raw_error=1.05, refit_error=1.0)
    assert next(iter(probabilities_of(null, weights))) == ("no_gap",)
    # the same gain in a tenth of the samples, or free runs that it betters, is one
    short = replace(null, samples=1e3)
    bettered = replace(null, raw_error=8.0)
    for case in (short, bettered):
        probabilities = probabilities_of(case, weights)
        assert probabilities["no_gap",] < probabilities_of(null, weights)["no_gap",]
        assert probabilities["parameters_only",] > probabilities["no_gap",]


def test_a_torque_that_hardly_changes_is_doubted():
    def torque(memory):
        case = replace(
            features(behind=900.0, scores=(20.0, 10.0, 20.0), behinds=(890.0,) * 3),
            outside={"yaw": np.full(4, 0.0)},
            foretold=0.0,
            memory={"yaw": memory},
        )
        return probabilities_of(case, calibration().weights)["yaw_disturbance",]

    # a sensor that drifts and a spring that ages look like that; three seconds are as good as one
    assert torque(1.0) == torque(3.0) > torque(8.0) > torque(25.0)
    assert torque(25.0) < 0.5 * torque(1.0)


def test_a_force_without_a_name_that_explains_hardly_any_of_the_gap_speaks_for_a_torque_as_well():
    def odds(flexible):
        case = replace(pulled(), flexible=flexible)
        probabilities = probabilities_of(case, calibration().weights)
        return np.log(probabilities["yaw_disturbance",] / probabilities["none_of_these",])

    # sixty nats are nothing of nine thousand that a torque explains, six hundred are much
    assert odds(60.0) == pytest.approx(odds(5.0), abs=1.0)
    assert odds(600.0) < odds(60.0) - 10.0


def test_no_lead_makes_certain():
    """In some rigs features mislead: what is sure by hundreds of nats is more so than by thirty."""
    shares = {lead: shares_of(np.array([lead, 0.0, 0.0])) for lead in (10.0, 30.0, 300.0)}
    assert 0.9 < shares[10.0][0] < 0.99 < shares[30.0][0] < 0.999 < shares[300.0][0]
    for share in shares.values():
        assert share.sum() == pytest.approx(1.0)
    # an order is never changed
    logits = np.array([3.0, 2.9, -40.0, 0.0])
    assert list(np.argsort(shares_of(logits))) == list(np.argsort(logits))


def test_an_effect_that_every_rig_mimics_is_believed_less(monkeypatch):
    monkeypatch.setattr(belief, "LAPSE", 0.0)
    weights = dict(calibration().weights)
    case = features(behind=300.0, scores=(40.0, 40.0, 42.0))
    before = probabilities_of(case, weights)
    after = probabilities_of(case, {**weights, own_feature("a"): -2.0})
    lost = np.log(after["a",] / after["b",]) - np.log(before["a",] / before["b",])
    assert lost == pytest.approx(-2.0)
    # of each effect of a pair
    together = np.log(after["a", "b"] / after["a",]) - np.log(before["a", "b"] / before["a",])
    assert together == pytest.approx(0.0)


def test_a_cause_whose_size_is_open_is_not_decided():
    """Searches that fit as well and end elsewhere have not found what the recordings say."""
    probabilities = {("yaw_flexible_mode",): 0.95, ("none_of_these",): 0.05}
    assert _verdict(probabilities, (), True) == "effect"
    assert _verdict(probabilities, (), False) == "undecided"


def test_a_torque_that_an_error_of_the_sensor_explains_as_well_is_doubted():
    """Play in an encoder: a torque of several times what acts on the axis, and no other cause."""
    weights = calibration().weights
    gap = pulled()
    torque = replace(gap, sensor={"yaw": 0.75}, force={"yaw": 0.2})
    play = replace(gap, sensor={"yaw": 0.99}, force={"yaw": 4.0})
    assert next(iter(probabilities_of(torque, weights))) == ("yaw_disturbance",)
    assert next(iter(probabilities_of(play, weights))) == ("none_of_these",)


def test_a_cause_beside_a_torque_from_outside_is_applied_alone():
    result = diagnosis()
    sizes = {"yaw_coulomb_friction.torque": SizeEstimate(value=0.004, sd=1e-4, unit="N*m")}
    effects = ("pitch_disturbance", "yaw_coulomb_friction")
    joint = Cause(effects=effects, probability=0.9, parameters=sizes)
    applied = applied_cause(replace(result, verdict="effect", causes=(joint,)))
    assert applied is not None and applied.effects == ("yaw_coulomb_friction",)
    alone = replace(joint, effects=("pitch_disturbance",), parameters={})
    assert applied_cause(replace(result, verdict="effect", causes=(alone,))) is None


def test_a_corrected_model_says_which_part_it_was_fitted_to():
    """A beginning that raced was fitted to all, one that a comparison found to what was before."""
    result = diagnosis()
    sizes = {"yaw_coulomb_friction.torque": SizeEstimate(value=0.004, sd=1e-4, unit="N*m")}
    begun = Cause(
        effects=("yaw_coulomb_friction",),
        probability=0.9,
        parameters=sizes,
        onset=Onset(time_s=20.0, ci95=(19.0, 21.0)),
    )
    raced = replace(result, verdict="effect", causes=(begun,), against=())
    assert "fitted to the recordings with" in corrected_words(raced)
    nothing = replace(raced.race[0], effects=("no_change",))
    compared = replace(raced, race=(*raced.race, nothing))
    assert "fitted to the beginning of the recordings with" in corrected_words(compared)
    assert corrected_words(compared).endswith("begins later")


def test_what_is_usual_goes_by_the_place_or_by_its_kind() -> None:
    any_rig = belief.calibration(belief.ANY_RIG)
    shares = any_rig.usual_shares
    assert any_rig.usual("current_actuator") == shares[belief.ACTUATOR]
    assert any_rig.usual("carriage_force") == shares[belief.EQUATION]
    bench = belief.calibration()
    assert bench.usual("yaw_moment") == bench.usual_shares["yaw_moment"]
    assert bench.usual("elsewhere") == max(bench.usual_shares.values())


def test_a_law_is_weighed_at_any_port() -> None:
    case = replace(
        features(behind=0.0),
        names=(("carriage_coulomb_friction",), ("current_lag",)),
        scores=np.array([50.0, 50.0]),
        behinds=np.zeros(2),
        sizes=np.ones(2),
        surprises=np.zeros(2),
        errors=np.ones(2),
    )
    weights = belief.calibration(belief.ANY_RIG).weights
    plain = belief.probabilities_of(case, weights)
    assert plain["carriage_coulomb_friction",] == pytest.approx(plain["current_lag",])
    own = belief.probabilities_of(case, {**weights, "own.coulomb_friction": 2.0})
    assert own["carriage_coulomb_friction",] > 3 * own["current_lag",]


@pytest.mark.parametrize(
    "text",
    [None, "no JSON", "[]", '{"weights": "none"}', '{"usual": 1}', '{"weights": {"score": 1.0}}'],
)
def test_a_file_that_is_no_calibration_is_refused(tmp_path, text) -> None:
    path = tmp_path / "own.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigurationError, match="no calibration"):
        belief.calibration_file(path)
