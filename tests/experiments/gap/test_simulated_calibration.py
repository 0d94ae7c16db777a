"""Features of many diagnoses kept through interruptions, and beliefs held against truths."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.gap import calibrate_change
from experiments.gap import simulate as study
from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.judgement import right_causes
from experiments.gap.calibrate import calibrating, diagnosis_belief, features_of
from experiments.gap.calibrate import main as calibrate
from experiments.gap.calibrate_change import PRIOR, ChangeFeatures, believed
from experiments.gap.calibrate_change import fit as fit_change
from experiments.gap.cross_validation import cross_validated, folds_of, judged, strata_of, tables
from experiments.gap.features_file import FeaturesFile, Line
from experiments.gap.simulate import Simulation, simulate
from trms_cli.core.errors import ConfigurationError

FRICTION = "yaw_coulomb_friction"
EVIDENCE = {
    "gained": 3.0,
    "behind": 40.0,
    "names": [[FRICTION], ["tail_dead_zone", "main_dead_zone"]],
    "scores": [30.0, None],
    "behinds": [1.0, 2.0],
    "sizes": [1, 2],
    "surprises": [0.1, 0.2],
    "errors": [1.0, None],
    "raw_error": None,
    "refit_error": 1.5,
    "shares": {"yaw_moment": 0.02},
    "outside": {"yaw": [9.0, 1.0, 2.0]},
    "something_new": [1, 2, 3],
}


def document(verdict: str = "effect") -> dict[str, Any]:
    causes = [
        {"effects": ["no_gap"], "probability": 0.2, "parameters": {}},
        {"effects": [FRICTION], "probability": 0.8, "parameters": {}},
    ]
    return {
        "schema": "trms.diagnosis/1",
        "verdict": verdict,
        "causes": causes,
        "evidence": EVIDENCE,
    }


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.gap.blind.recording._SETTLING", 0.05)


def stopping(after: int):
    """Stands for diagnoses: fails at two of a kind, and is interrupted after some."""

    def diagnose_all(recordings, out, words, jobs, report) -> dict[str, str]:
        assert words == ["advise=false", "effort=quick"]
        for number, recording in enumerate(recordings):
            if number == after:
                raise KeyboardInterrupt
            assert recording.is_file()
            if recording.stem.endswith("3"):
                report(recording.stem, "cannot be diagnosed")
                continue
            folder = out / recording.stem
            folder.mkdir()
            (folder / "diagnosis.json").write_text(json.dumps(document()))
            (folder / "blind.json").write_text('{"seconds": 1.5}')
            report(recording.stem, "effect")
        return {}

    return diagnose_all


def test_an_interrupted_simulation_goes_on_and_leaves_features_alone(tmp_path, monkeypatch):
    request = Simulation(
        set="small", seed=2, cases=5, batch=3, duration=0.2, words=("effort=quick",)
    )
    messages: list[str] = []
    monkeypatch.setattr(study, "diagnose_all", stopping(1))
    with pytest.raises(KeyboardInterrupt):
        simulate(request, tmp_path, jobs=1, tell=messages.append)
    assert [line.name for line in FeaturesFile(tmp_path).lines()] == ["s00001"]
    monkeypatch.setattr(study, "diagnose_all", stopping(9))
    lines = simulate(request, tmp_path, jobs=1, tell=messages.append, batches=1)
    assert [line.name for line in lines] == ["s00001", "s00002", "s00003"]
    lines = simulate(request, tmp_path, jobs=1, tell=messages.append)
    assert [line.name for line in lines] == [f"s{i:05d}" for i in range(1, 6)]
    assert [bool(line.failed) for line in lines] == [False, False, True, False, False]
    planned = plan("small", 2, 5)
    assert [line.case.kind for line in lines] == [case.kind for case in planned]
    assert [dict(line.case.nuisances) for line in lines] == [dict(c.nuisances) for c in planned]
    assert lines[0].seconds == 1.5 and lines[0].evidence["something_new"] == [1, 2, 3]
    # rigs are gone; what failed is tried again when that is asked for
    assert {p.name for p in tmp_path.iterdir()} == {"features.jsonl.gz", "simulation.json"}
    count = len(messages)
    assert len(simulate(request, tmp_path, jobs=1, tell=messages.append)) == 5
    assert len(messages) == count
    simulate(request, tmp_path, jobs=1, tell=messages.append, retry=True)
    assert any("s00003" in words for words in messages[count:])
    with pytest.raises(ConfigurationError, match="another seed"):
        simulate(Simulation(set="small", seed=3), tmp_path, jobs=1, tell=messages.append)


def test_a_file_that_was_cut_off_loses_its_last_line(tmp_path: Path):
    file = FeaturesFile(tmp_path)
    assert file.lines() == []
    for name in ("a", "b"):
        file.append(Line(name=name, case=Case(kind="null"), document=document()))
    whole = file.path.read_bytes()
    file.path.write_bytes(whole[:-20])
    assert [line.name for line in file.mend()] == ["a"]
    file.append(Line(name="c", case=Case(kind="null"), document={}, failed="no"))
    assert [line.name for line in file.lines()] == ["a", "c"]
    assert [line.name for line in file.mend(without_failed=True)] == ["a"]


def test_features_are_what_the_evidence_has_and_the_posterior_asks_for():
    features = features_of(EVIDENCE)
    assert features.names == ((FRICTION,), ("main_dead_zone", "tail_dead_zone"))
    np.testing.assert_array_equal(features.scores, [30.0, np.nan])
    assert features.gained == 3.0


def test_twins_stay_together_and_folds_are_even():
    cases = plan("development", 1)
    folds = folds_of(cases, 5)
    assert np.ptp(np.bincount(folds)) <= 4
    twins: dict[int, set[int]] = {}
    for case, fold in zip(cases, folds, strict=True):
        if case.twin:
            twins.setdefault(case.twin, set()).add(int(fold))
    assert twins and all(len(of) == 1 for of in twins.values())
    nulls = [f for f, case in zip(folds, cases, strict=True) if case.kind == "null"]
    assert len(set(nulls)) == 5
    np.testing.assert_array_equal(folds, folds_of(cases, 5))


def test_nothing_is_believed_by_what_was_fitted_to_it():
    cases = [Case(kind="null") for _ in range(6)]
    folds = folds_of(cases, 3)

    def fit(pairs):
        return {features for features, _ in pairs}

    def believe(features, training_set):
        assert features not in training_set and len(training_set) == 4
        return {("no_gap",): 1.0}

    rights = [frozenset({("no_gap",)})] * 6
    beliefs = cross_validated(range(6), rights, folds, fit, believe)
    assert judged(beliefs, rights).right.value == 1.0
    text = tables(cases, rights, {"folds": beliefs})
    assert "| all | 6 | folds |" in text and "| 60 to 150 s | 6 |" in text


def test_losses_and_strata():
    right = frozenset({("a",)})
    metrics = judged(
        [{("a",): 0.95, ("b",): 0.05}] * 19 + [{("a",): 0.05, ("b",): 0.95}], [right] * 20
    )
    assert metrics.calibration_error.value == pytest.approx(0.0, abs=1e-9)
    assert metrics.very_sure.value == 0.95 and metrics.very_sure.count == 20
    assert metrics.log_loss.value == pytest.approx(
        -(19 * np.log(0.95) + np.log(0.051)) / 20, abs=0.01
    )
    cases = [
        Case(kind="null", duration=600.0, drive="closed_loop"),
        Case(kind="single", duration=20.0, channels="angles"),
        Case(kind="single", duration=60.0),
    ]
    strata = {name: members.tolist() for name, members in strata_of(cases).items()}
    assert strata["150 to 600 s"] == [0] == strata["closed loop"]
    assert strata["20 to 60 s"] == [1] == strata["two channels"]
    assert strata["60 to 150 s"] == [2] and strata["single"] == [1, 2]


def test_what_begins_is_weighed_where_beginnings_raced():
    case = Case(kind="onset", effects={FRICTION: {"torque": 0.004}}, onset={FRICTION: 9.0})
    before, raced = document(), document()
    raced["evidence"] = {**raced["evidence"], "begins": [1.0, 0.0]}
    lines = [Line(name=f"s{i}", case=case, document=d) for i, d in enumerate((before, raced))]
    assert [line.name for line in calibrating(lines)] == ["s1"]
    # numbers by block and by channel come back as they were, also those that are not finite
    evidence = {**raced["evidence"], "by_block": [[1.0, None], [2.0, 3.0]]}
    np.testing.assert_array_equal(features_of(evidence).by_block, [[1.0, np.nan], [2.0, 3.0]])


def test_the_study_is_told_and_nothing_is_written_unasked(tmp_path, capsys):
    file = FeaturesFile(tmp_path)
    truths = [{FRICTION: {"torque": 0.004}}, {}, {"pitch_quantisation": {"quantum": 0.01}}]
    for i in range(9):
        effects = truths[i % 3]
        case = Case(kind="single" if effects else "null", effects=effects)
        file.append(Line(name=f"s{i}", case=case, document=document()))
    file.append(Line(name="s9", case=Case(kind="null"), document={}, failed="no"))
    # rounding has marks of its own and is not weighed
    assert len(calibrating(file.lines())) == 6
    assert diagnosis_belief(file.lines()[0])[FRICTION,] == 0.8
    package = Path(__file__).parents[3] / "trms_cli" / "gap" / "calibration.json"
    before = package.read_bytes()
    assert calibrate([str(tmp_path), "--folds", "2"]) == 0
    assert package.read_bytes() == before
    output = capsys.readouterr().out
    assert "10 rigs, 1 could not be diagnosed, 6 are weighed" in output
    assert "| all | 6 | 2 folds |" in output and "Reliability, as diagnosed:" in output


def test_what_is_right_for_each_kind():
    case_fields: dict[str, Any] = {"kind": "against", "references": 2}
    friction = {FRICTION: {"torque": 0.004}}
    assert right_causes(Case(**case_fields)) == (("no_change",),)
    assert right_causes(Case(**case_fields, moved={"m_cb": 3.0})) == (("parameters_only",),)
    assert right_causes(Case(**case_fields, effects=friction)) == ((FRICTION,),)
    assert right_causes(Case(kind="onset", effects=friction, onset={FRICTION: 9.0})) == (
        (FRICTION,),
    )
    assert ("none_of_these",) in right_causes(Case(kind="null", imperfect=True))
    assert right_causes(Case(kind="null")) == (("no_gap",),)
    assert (FRICTION,) in right_causes(Case(kind="unexcited", effects=friction))


def test_beliefs_of_changes_are_fitted_to_rigs_that_changed_or_did_not(capsys):
    """Rigs whose recordings of one state gain much teach that a gain is no change."""
    random = np.random.default_rng(2)
    cases = []
    for k in range(40):
        changed = k % 2 == 0
        gains = random.exponential(40.0, 3) + (200.0 if changed else 0.0) * np.array([1, 0, 0])
        features = ChangeFeatures(
            names=("a", "b", "p"),
            kinds=("effect", "effect", "parameter"),
            gains=gains,
            beliefs=np.zeros(3),
            unnamed=-20.0,
            usual=tuple(random.exponential(40.0, 2)),
        )
        cases.append((features, frozenset({("a",) if changed else ("no_change",)})))
    constants = fit_change(cases)

    def surprise(by):
        return -np.mean([np.log(sum(believed(k, by).get(c, 0.0) for c in r)) for k, r in cases])

    assert surprise(constants) < surprise(PRIOR) - 0.05
    assert constants["usual_gain"] > PRIOR["usual_gain"]
    belief = believed(cases[0][0], constants)
    assert sum(belief.values()) == pytest.approx(1.0)
    assert set(belief) == {("a",), ("b",), ("parameters_only",), ("no_change",), ("none_of_these",)}
    # and from the features that lie in the repository
    folder = Path(calibrate_change.__file__).with_name("features") / "calibration"
    assert calibrate_change.main([str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "rigs were compared" in printed and "usual_gain" in printed
    with pytest.raises(SystemExit, match="2"):
        calibrate_change.main([])
    assert "too few" in capsys.readouterr().err
