"""Judgement of diagnoses that are made by hand."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from experiments.gap.blind.between_recordings import between_recordings
from experiments.gap.blind.cases import Case
from experiments.gap.blind.drivers import rich_excitation
from experiments.gap.blind.judgement import Answer, FreshResult, JudgedCase, answer_of, on_fresh
from experiments.gap.blind.measures import Table, Target, table
from experiments.gap.blind.recording import Recording, csv_of
from experiments.gap.blind.sealing import OpenedKey
from experiments.gap.blind.statistics import calibration_error, quantile, reliability, share
from experiments.gap.blind.verdicts import document_of as score_document
from experiments.gap.blind.verdicts import markdown
from tests.gap.diagnosis_case import CHANNELS, diagnosis
from trms_cli.core.resources import config_folder
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.diagnosis import document_of
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

DELAY, LAG, FRICTION = "main_input_delay", "main_actuator_lag", "yaw_coulomb_friction"
SIZES = {DELAY: {"delay": 0.04}, LAG: {"time_constant": 0.04}, FRICTION: {"torque": 0.004}}
PLACES = {DELAY: ("main_actuator",), LAG: ("main_actuator",), FRICTION: ("yaw_moment",)}


def case(kind: str = "single", *effects: str, level: str = "medium", **more: Any) -> Case:
    return Case(
        kind=kind,  # type: ignore[arg-type]
        effects={e: SIZES.get(e, {}) for e in effects},
        severity=dict.fromkeys(effects, level),
        locations=tuple(at for e in effects for at in PLACES.get(e, ("yaw_moment",))),
        **more,
    )


def answer(*effects: str, verdict: str = "effect", probability: float = 0.9, **more: Any) -> Answer:
    return Answer(verdict=verdict, causes=((effects, probability),), **more)


def judged(c: Case, a: Answer, name: str = "c001", fresh: FreshResult | None = None) -> JudgedCase:
    return JudgedCase(name=name, case=c, answer=a, fresh=fresh)


def page_of(cases: list[JudgedCase]) -> str:
    """``score.md`` of one method."""
    key = OpenedKey(
        set_name="small",
        seed=7,
        commitment="0" * 64,
        cases={j.name: j.case for j in cases},
        files={},
        fresh=None,
    )
    return markdown(score_document(key, {"trms": table(cases, draws=100)}, {"trms": cases}))


def figure(score_table: Table, measure: str) -> Any:
    return next(row for row in score_table.rows if row.measure.startswith(measure))


def test_exact_means_all_effects_and_no_other() -> None:
    pair = case("pair", DELAY, FRICTION)
    assert judged(pair, answer(FRICTION, DELAY)).exact
    assert not judged(pair, answer(FRICTION)).exact
    assert not judged(case("single", FRICTION), answer(FRICTION, DELAY)).exact
    assert not judged(case("single", FRICTION), answer(FRICTION, verdict="undecided")).exact
    # What is right depends on the kind.
    assert judged(case("null"), answer("no_gap", verdict="no_gap")).right
    assert judged(case("offset"), answer("parameters_only", verdict="parameters_only")).right
    assert judged(case("outside", "yaw_cogging"), answer("none_of_these", verdict="x")).right
    assert not judged(case("offset"), answer("no_gap", verdict="no_gap")).right


def test_a_confusion_counts_where_the_diagnosis_declared_it() -> None:
    truth = case("single", DELAY)
    assert not judged(truth, answer(LAG)).in_group
    assert judged(truth, answer(LAG, confusable=((DELAY, LAG),))).in_group
    assert not judged(truth, answer(FRICTION, confusable=((DELAY, LAG),))).in_group
    assert not judged(truth, answer(LAG, FRICTION, confusable=((DELAY, LAG),))).in_group
    pair = case("pair", DELAY, FRICTION)
    assert judged(pair, answer(LAG, FRICTION, confusable=((LAG, DELAY),))).in_group


def test_places_and_equations() -> None:
    truth = case("single", DELAY)
    right = judged(truth, answer(DELAY, places=("main_actuator", "yaw_moment")))
    beside = judged(truth, answer(DELAY, places=("main_motor",)))
    wrong = judged(truth, answer(DELAY, places=("yaw_moment", "main_actuator")))
    assert [(j.located, j.equation) for j in (right, beside, wrong)] == [
        (True, True),
        (False, True),
        (False, False),
    ]
    assert not judged(truth, answer(DELAY)).located


def test_sizes_are_compared_where_the_law_is_the_same() -> None:
    sizes = {f"{FRICTION}.torque": 0.005}
    assert judged(case("single", FRICTION), answer(FRICTION, sizes=sizes)).size_errors == {
        FRICTION: pytest.approx(0.25)
    }
    assert not judged(case("single", FRICTION), answer(LAG)).size_errors
    hysteresis = Case(kind="single", effects={"yaw_cable_hysteresis": {"torque": 1.0}})
    hysteresis_answer = answer("yaw_cable_hysteresis", sizes={"yaw_cable_hysteresis.torque": 2.0})
    assert not judged(hysteresis, hysteresis_answer).size_errors


def test_the_table_counts_each_kind_where_it_belongs() -> None:
    score_table = table(
        [
            judged(case("single", FRICTION), answer(FRICTION, places=("yaw_moment",))),
            judged(case("single", DELAY, level="strong"), answer(LAG)),
            judged(case("single", DELAY, level="weak"), answer(DELAY)),
            judged(case("single", DELAY, channels="angles"), answer(DELAY)),
            judged(case("single", DELAY, drive="closed_loop"), answer(LAG)),
            judged(case("null"), answer("no_gap", verdict="no_gap")),
            judged(case("null"), answer(FRICTION)),
            judged(case("offset"), answer("parameters_only", verdict="parameters_only")),
            judged(case("outside", "yaw_cogging"), answer(FRICTION, probability=0.71)),
            judged(case("outside", "yaw_cogging"), answer(FRICTION, verdict="undecided")),
            judged(case("pair", DELAY, FRICTION), answer(FRICTION)),
            judged(case("unexcited", DELAY, drive="poor"), answer(LAG)),
        ]
    )
    figures = {row.measure: (row.estimate.value, row.estimate.count) for row in score_table.rows}
    assert figures["single, medium and strong: exact"] == (0.5, 2)
    assert figures["single, medium and strong: place named"] == (0.5, 2)
    assert figures["single, medium and strong: sure of a wrong name"] == (0.5, 2)
    assert figures["single, weak: exact"] == (1.0, 1)
    assert figures["single in closed loop: exact"] == (0.0, 1)
    assert figures["single, angles alone: exact"] == (1.0, 1)
    assert figures["effect named on an exact null"] == (0.5, 2)
    assert figures["effect named on a parameter offset"] == (0.0, 1)
    assert figures["outside the library: wrong name, probability over 0.7"] == (1.0, 2)
    assert figures["outside the library: none of these, or undecided"] == (0.5, 2)
    assert figures["two effects: both"] == (0.0, 1)
    assert figures["two effects: at least one"] == (1.0, 1)
    assert figures["present but not excited: wrong name"] == (1.0, 1)
    assert figures["shrink relative to the oracle: median"] == (None, 0)
    assert score_table.by_effect[DELAY]["all"].count == 2
    assert score_table.confusions[DELAY] == {LAG: 3, DELAY: 2}


def test_the_second_recording_judges_intervals_and_harm() -> None:
    shrink_estimate: dict[str, Any] = {"shrink": 0.8, "shrink_ci95": (0.7, 0.9)}
    inside = FreshResult(shrink=0.75, worse=())
    outside = FreshResult(shrink=0.5, worse=("alpha_v",))
    whole, none = FreshResult(shrink=1.0, worse=()), FreshResult(shrink=None, worse=())
    rubbing = case("single", FRICTION)
    best = judged(rubbing, answer(FRICTION), fresh=whole)
    score_table = table(
        [
            judged(rubbing, answer(FRICTION, **shrink_estimate), "a", inside),
            judged(rubbing, answer(FRICTION, **shrink_estimate), "b", outside),
            judged(case("null"), answer("no_gap", verdict="no_gap"), "n", none),
        ],
        {"a": best, "b": best},
    )
    assert figure(score_table, "95 % interval").estimate.value == 0.5
    assert figure(score_table, "a channel made worse").estimate.value == pytest.approx(1 / 3)
    assert figure(score_table, "shrink relative to the oracle: median").estimate.value == 0.625


def test_intervals_of_shares_are_wilsons() -> None:
    for hits, n in ((0, 10), (3, 10), (10, 10), (1, 44)):
        estimate = share([True] * hits + [False] * (n - hits))
        right = binomtest(hits, n).proportion_ci(method="wilson")
        assert (estimate.low, estimate.high) == pytest.approx((right.low, right.high), abs=1e-9)
    assert share([]).value is None


def test_intervals_of_quantiles_hold_the_truth_as_often_as_they_say() -> None:
    random = np.random.default_rng(0)
    coverage_count = 0
    for trial in range(200):
        estimate = quantile(random.normal(size=60).tolist(), 0.5, 300, trial)
        assert estimate.low is not None
        assert estimate.high is not None
        coverage_count += estimate.low <= 0 <= estimate.high
    assert 0.88 <= coverage_count / 200 <= 0.99


def test_reliability_of_probabilities_and_targets() -> None:
    assert Target(kind="at least", low=0.9).is_met(0.9)
    assert not Target(kind="at least", low=0.9).is_met(0.89)
    assert not Target(kind="at most", high=0.02).is_met(0.03)
    assert not Target(kind="within", low=0.94, high=0.96).is_met(0.97)
    reliability_table = reliability(
        [0.95] * 20 + [0.55] * 20, [True] * 19 + [False] + [True] * 11 + [False] * 9
    )
    assert reliability_table.calibration_error == pytest.approx(0.0, abs=1e-9)
    lies = reliability([0.95] * 10, [False] * 10)
    assert lies.calibration_error == pytest.approx(0.95)
    assert lies.brier == pytest.approx(0.95**2)
    assert [b["count"] for b in reliability_table.bins] == [20, 20]


DOCUMENT: dict[str, Any] = document_of(diagnosis())


def test_a_document_is_read() -> None:
    shuffled = DOCUMENT | {"where": DOCUMENT["where"][::-1]}
    for parsed_answer in (answer_of(DOCUMENT), answer_of(shuffled)):
        assert parsed_answer.first == ((FRICTION,), 0.88)
        assert parsed_answer.places == ("yaw_moment", "tail_thrust", "pitch_moment", "main_motor")
        assert parsed_answer.sizes == {f"{FRICTION}.torque": 0.00412}
        assert (parsed_answer.shrink, parsed_answer.shrink_ci95) == (0.91, (0.86, 0.94))
        assert parsed_answer.seconds == pytest.approx(73.4)
        assert parsed_answer.floors == {
            n: 0.0011 if unit == "rad" else 1.7 for n, unit in CHANNELS.items()
        }


@pytest.mark.parametrize(
    "broken",
    [
        {"schema": "trms.score/1"},
        {"schema": "trms.diagnosis/1"},
        {"schema": "trms.diagnosis/1", "causes": 3, "verdict": "effect"},
        DOCUMENT | {"causes": [{"effects": ["a"]}]},
    ],
)
def test_what_is_no_diagnosis_is_refused(broken: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"schema|Error"):
        answer_of(broken)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds of a rig with friction of yaw, from the library's own code."""
    model = extend_model(Newtonian(), {FRICTION: CoulombFriction(axis="yaw", torque=0.003)})
    n, step = 500, 0.02
    commands = rich_excitation([3], n, step, amplitude=0.6)[0]
    rollout = Rollout(model, step)
    start = rollout.initial(model.rest(), commands[0])
    y = rollout.outputs(commands, [0], [n], start[None]).y
    file = tmp_path_factory.mktemp("fresh") / "c001.csv"
    time = step * np.arange(n, dtype=float)
    file.write_text(csv_of(Case(kind="single"), Recording(time, commands, y)))
    return file


@pytest.mark.parametrize(("better", "worse"), [(True, ()), (False, ("alpha_h",))])
def test_models_run_on_a_recording_that_nobody_saw(recording, tmp_path, better, worse) -> None:
    plain = (config_folder() / "parameters" / "bench.yaml").read_text(encoding="utf-8")
    rubbing = plain + "\neffects: {yaw_coulomb_friction: {torque: 0.003}}\n"
    (tmp_path / "corrected_model.yaml").write_text(rubbing if better else plain, encoding="utf-8")
    (tmp_path / "refit_model.yaml").write_text(plain if better else rubbing, encoding="utf-8")
    floors = {"alpha_v": 5e-4, "alpha_h": 5e-4, "omega_v": 1.6, "omega_h": 1.6}
    fresh_result = on_fresh(answer(FRICTION, floors=floors), tmp_path, recording)
    assert fresh_result is not None
    assert set(fresh_result.worse) >= set(worse)
    assert bool(fresh_result.worse) != better
    if better:
        assert fresh_result.shrink is not None
        assert fresh_result.shrink > 0.9
    assert set(fresh_result.errors) == set(floors)
    for refit, corrected in fresh_result.errors.values():
        assert (corrected < refit) == better
    # what names no effect shrinks nothing, but may make a channel worse all the same
    unnamed = on_fresh(answer("none_of_these", verdict="none_of_these"), tmp_path, recording)
    assert unnamed is not None
    assert unnamed.shrink is None
    assert set(unnamed.worse) == set(fresh_result.worse)
    same = tmp_path / "same"
    same.mkdir()
    for name, comment in (("corrected_model.yaml", "# one\n"), ("refit_model.yaml", "# other\n")):
        (same / name).write_text(comment + plain, encoding="utf-8")
    nothing = answer("no_gap", verdict="no_gap")
    assert on_fresh(nothing, same, recording) == FreshResult(shrink=None, worse=())
    assert on_fresh(answer(FRICTION), tmp_path / "none", recording) is None


def test_what_begins_within_what_changed_and_three_at_once_have_rows_of_their_own() -> None:
    begins = case("onset", FRICTION, onset={FRICTION: 40.0})
    changed: dict[str, Any] = {"references": 2}
    stiff = "yaw_cable_stiffness"
    triple = case("triple", DELAY, FRICTION, stiff)
    parameters: dict[str, Any] = {"verdict": "parameters_only"}
    score_table = table(
        [
            judged(begins, answer(FRICTION, onset=40.9)),
            judged(begins, answer(FRICTION, onset=42.0)),
            judged(begins, answer(FRICTION)),
            judged(begins, answer(LAG, onset=40.0)),
            judged(case("single", FRICTION), answer(FRICTION, onset=3.0)),
            judged(triple, answer(DELAY, stiff)),
            judged(triple, answer(DELAY, LAG)),
            judged(case("against", **changed), answer("no_change", verdict="no_change")),
            judged(case("against", **changed), answer("parameters_only", **parameters)),
            judged(case("against", FRICTION, **changed), answer(FRICTION)),
            judged(
                case("against", moved={"m_cb": 3.0}, **changed),
                answer("parameters_only", moved=("m_cb", "h"), **parameters),
            ),
            judged(
                case("against", moved={"m_cb": 3.0}, **changed),
                answer("parameters_only", moved=("h",), **parameters),
            ),
            judged(case("null"), answer("none_of_these", verdict="none_of_these")),
        ],
        draws=100,
    )
    figures = {row.measure: (row.estimate.value, row.estimate.count) for row in score_table.rows}
    assert figures["begins within: exact"] == (0.75, 4)
    assert figures["begins within: moment told to 1 s"] == (0.5, 4)
    assert figures["begins within, effect named: moment told to 1 s"] == (pytest.approx(1 / 3), 3)
    assert figures["there all the time: a moment told nevertheless"] == (1.0, 1)
    assert figures["three effects: two of them"] == (0.5, 2)
    assert figures["three effects: at least one"] == (1.0, 2)
    assert figures["no change: an effect or a parameter named"] == (0.5, 2)
    assert figures["no change: said so"] == (0.5, 2)
    assert figures["what changed, an effect: exact"] == (1.0, 1)
    assert figures["what changed, a parameter: parameters only"] == (1.0, 2)
    assert figures["what changed, a parameter: which"] == (0.5, 2)
    wrong = "null, offset, no change: wrong with probability over 0.9"
    assert figures[wrong] == (pytest.approx(2 / 3), 3)
    assert figures["null, offset, no change: effect named"] == (0.0, 3)


def test_calibration_is_a_row_with_an_interval() -> None:
    rows = [
        judged(
            case("single", FRICTION),
            answer(FRICTION if i < 19 else LAG, probability=0.95, inclusion={FRICTION: 0.9}),
        )
        for i in range(20)
    ]
    score_table = table(rows, draws=200)
    error = figure(score_table, "expected calibration error").estimate
    assert error.value == pytest.approx(0.0, abs=1e-9) and error.low <= error.value <= error.high
    assert figure(score_table, "said with 0.9 and more: right").estimate.value == 0.95
    assert figure(
        score_table, "expected calibration error of each"
    ).estimate.value == pytest.approx(0.1)
    p = np.random.default_rng(0).uniform(size=50)
    hit = p > 0.4
    whole = reliability(p.tolist(), hit.tolist()).calibration_error
    assert calibration_error(p, hit) == pytest.approx(whole)


def test_what_was_missed_is_shown_by_kind() -> None:
    cases = [
        judged(case("single", FRICTION), answer(FRICTION, probability=0.95), "a"),
        judged(case("single", DELAY), answer(LAG, probability=0.91), "b"),
        judged(case("single", DELAY), answer(FRICTION, probability=0.5), "c"),
        judged(case("null"), answer("no_gap", verdict="no_gap", probability=0.6), "d"),
    ]
    page = page_of(cases)
    rows = [line.split(" | ") for line in page.splitlines()]
    assert ["| single", DELAY, f"{LAG} (0.91), {FRICTION} (0.50) |"] in rows
    by_kind = next(row for row in rows if row[0] == "| single")
    assert (by_kind[1], by_kind[3]) == ("3", "2")
    assert by_kind[2].startswith("33.3 %")
    assert by_kind[4].startswith("50.0 %")
    assert sum(row[0] == "| null" for row in rows) == 1


def test_what_was_missed_is_told_with_what_the_truth_explains() -> None:
    scores = {
        frozenset({FRICTION}): 40.0,
        frozenset({FRICTION, DELAY}): 60.0,
        frozenset({"flexible"}): 45.0,
        frozenset(): 0.0,
    }
    lacking = judged(case("pair", FRICTION, DELAY), answer(FRICTION, scores=scores), "a")
    unnamed = judged(
        case("single", FRICTION), answer("none_of_these", verdict="none_of_these", scores=scores)
    )
    torque = judged(
        case("pair", FRICTION, "yaw_disturbance"), answer("parameters_only", scores=scores)
    )
    assert [j.lead for j in (lacking, unnamed, torque)] == [20.0, -5.0, 40.0]
    # another effect than those that raced, and a rig without any
    assert judged(case("single", LAG), answer(FRICTION, scores=scores)).lead is None
    assert judged(case("null"), answer(FRICTION, scores=scores)).lead is None
    page = page_of([lacking, unnamed])
    assert f"{FRICTION} (0.90, +20)" in page and "none_of_these (0.90, -5)" in page
    assert "2 of the 2 were fitted with the rig's own effects, too: in 1 of these" in page


def test_how_errors_differ_between_recordings_is_that_of_what_was_drawn() -> None:
    """Deviations come back, by channel and by how far the two models are apart."""
    random = np.random.default_rng(3)
    judged_cases = []
    for i in range(400):
        ratio = 1.01 if i % 2 else 3.0
        own = 0.02 if i % 2 else 0.4
        common, a, b = 0.3 * random.standard_normal(), *own * random.standard_normal(2)
        sealed = {"alpha_v": (1e-3, 1e-3 / ratio), "omega_v": (2.0, 2.0)}
        fresh = {
            "alpha_v": (1e-3 * np.exp(common + a), 1e-3 / ratio * np.exp(common + b)),
            "omega_v": (2.0 * np.exp(common / 4), 2.0 * np.exp(common / 4)),
        }
        sealed_answer = replace(answer(FRICTION), sealed=sealed)
        result = FreshResult(shrink=0.5, worse=(), errors=fresh)
        judged_cases.append(judged(case("single"), sealed_answer, f"c{i:03d}", result))
    spreads = between_recordings(judged_cases)
    by_band = {(s.channels, s.low, s.high): s for s in spreads}
    near, far = by_band["angles", 1.0, 1.02], by_band["angles", 2.2, 4.5]
    assert (near.count, far.count) == (200, 200)
    assert near.apart == pytest.approx(0.02 * 2**0.5, rel=0.25)
    assert far.apart == pytest.approx(0.4 * 2**0.5, rel=0.25)
    assert near.refit == pytest.approx(0.3, rel=0.25)
    assert near.correlation > 0.9 > far.correlation
    speeds = by_band["speeds", 1.0, None]
    assert speeds.count == 400
    assert speeds.apart == 0
    assert speeds.refit == pytest.approx(0.075, rel=0.2)
    page = page_of(judged_cases)
    assert "| angles | 2.2 to 4.5 |" in page
    assert "| speeds | any |" in page
    # what names no effect has two models that nobody is promised anything of
    assert not between_recordings(
        [judged(case("single"), replace(sealed_answer, verdict="no_gap"))]
    )
