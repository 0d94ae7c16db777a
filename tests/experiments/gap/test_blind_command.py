"""``trms blind``: make, run, score, from the command line."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from experiments.gap.blind.cases import Case
from experiments.gap.blind.judgement import right_causes
from experiments.gap.blind.sealing import open_key
from trms_cli.cli import main
from trms_cli.gap.diagnosis import NO_EFFECT

CASES = 12


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("blind") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
        words = ["set=small", f"cases={CASES}", "seed=2", "duration=1", "fresh=0", "jobs=1"]
        assert main(["blind", "make", *words, f"out={folder}"]) == 0
    yield folder


def document(case: Case, **changes: Any) -> dict[str, Any]:
    """A diagnosis that knows the truth."""
    effects = list(right_causes(case)[-1])
    verdict = effects[0] if effects[0] in NO_EFFECT else "effect"
    begins = [{"time_s": t, "ci95": [t, t]} for t in case.onset.values()]
    content = {
        "schema": "trms.diagnosis/1",
        "verdict": verdict,
        "where": [{"location": at, "share": 0.9, "ci95": [0.8, 1]} for at in case.locations[:1]],
        "causes": [
            {
                "effects": effects,
                "probability": 0.99,
                "onset": begins[0] if begins else None,
                "parameters": {
                    f"{effect}.{size}": {"value": value, "sd": 0.0, "unit": ""}
                    for effect, sizes in case.effects.items()
                    for size, value in sizes.items()
                },
            }
        ],
        "seconds": {"all": 3.0},
        "inclusion": dict.fromkeys(case.effects, 0.99),
        "moved": [{"parameter": name} for name in case.moved],
    }
    return content | changes


def write(folder: Path, diagnoses: dict[str, dict[str, Any]]) -> Path:
    for name, content in diagnoses.items():
        (folder / name).mkdir(parents=True)
        (folder / name / "diagnosis.json").write_text(json.dumps(content))
    return folder


@pytest.fixture(scope="module")
def cases(sealed: Path) -> dict[str, Case]:
    return dict(open_key(sealed.with_name("set.key"), sealed).cases)


def test_the_commitment_is_told(tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
    words = ["set=final", "cases=2", "duration=1", "fresh=0", "jobs=1"]
    assert main(["blind", "make", *words, f"out={tmp_path / 's'}"]) == 0
    printed = capsys.readouterr().out
    digest = json.loads((tmp_path / "s" / "commitment.json").read_text())["sha256"]
    assert printed.startswith(f"key  sha256 {digest}")
    assert (tmp_path / "s.key" / "key.json").is_file()
    assert not (tmp_path / "s.key" / "fresh").exists()
    assert sorted(p.name for p in (tmp_path / "s").iterdir()) == ["commitment.json", "recordings"]


def test_perfect_diagnoses_reach_everything(sealed, cases, tmp_path, capsys) -> None:
    diagnoses = write(tmp_path / "found", {name: document(case) for name, case in cases.items()})
    words = [f"in={sealed}", f"diagnoses={diagnoses}", f"out={tmp_path / 'out'}"]
    assert main(["blind", "score", *words]) == 0
    assert "two effects: both" in capsys.readouterr().out
    score = json.loads((tmp_path / "out" / "score.json").read_text())
    method = score["methods"]["found"]
    assert score["schema"] == "trms.blind.score/1"
    assert method["diagnosed"] == CASES
    assert method["mean_seconds"] == 3.0
    assert all(row["reached"] is not False for row in method["measures"])
    assert sum(row["reached"] is True for row in method["measures"]) >= 6
    assert all(facts["right"] for facts in method["judged"].values())
    page = (tmp_path / "out" / "score.md").read_text()
    assert "| two effects: both | ≥ 85 % | 100.0 % [" in page
    # What is diagnosed is not diagnosed again.
    assert main(["blind", "run", f"in={sealed}", f"out={diagnoses}"]) == 0
    assert f"{CASES} of {CASES} are diagnosed already" in capsys.readouterr().out


def test_methods_stand_side_by_side(sealed: Path, cases: dict[str, Case], tmp_path: Path) -> None:
    oracle_shrink = {"all": {"2.0": {"fraction": 0.8, "ci95": [0.7, 0.9]}}}
    half = {"all": {"2.0": {"fraction": 0.4, "ci95": [0.3, 0.5]}}}
    oracle = write(tmp_path / "a", {n: document(c, shrink=oracle_shrink) for n, c in cases.items()})
    one = {n: document(c, shrink=half) for n, c in list(cases.items())[:-1]}
    refit = [{"effects": ["parameters_only"], "probability": 1.0}]
    for content in one.values():
        content |= {"verdict": "parameters_only", "causes": refit}
    blunt = write(tmp_path / "b", one)
    methods = f"diagnoses=[told={oracle},blunt={blunt}]"
    words = [f"in={sealed}", methods, "oracle=told", f"out={tmp_path / 'out'}"]
    assert main(["blind", "score", *words]) == 0
    score = json.loads((tmp_path / "out" / "score.json").read_text())["methods"]
    assert (score["told"]["diagnosed"], score["blunt"]["diagnosed"]) == (CASES, CASES - 1)
    rows = {row["measure"]: row for row in score["blunt"]["measures"]}
    assert rows["shrink relative to the oracle: median"]["value"] == pytest.approx(0.5)
    assert rows["two effects: both"]["reached"] is False
    assert rows["effect named on an exact null"]["reached"] is True


def test_a_recording_that_cannot_be_diagnosed_is_told(sealed, tmp_path, capsys) -> None:
    # a second is too short to be divided; each recording says so, and nothing is left behind
    words = [f"in={sealed}", f"out={tmp_path / 'found'}", "cases=1", "jobs=1"]
    assert main(["blind", "run", *words]) == 1
    assert "c001: " in capsys.readouterr().out
    assert not list((tmp_path / "found").glob("c*"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "nothing given"),
        (["mak"], "did you mean"),
        (["make", "set=smal", "out={tmp}/a"], "no set 'smal'"),
        (["make", "out={tmp}/a", "key={tmp}/a/key"], "lies among the recordings"),
        (["make", "out={set}"], "not empty"),
        (["make", "out={tmp}/a", "sample_time=0.0205"], "whole number of milliseconds"),
        (["run", "in={tmp}", "out={tmp}/b"], "no recordings"),
        (["score", "in={set}", "diagnoses={tmp}/none"], "no folder"),
        (["score", "in={set}", "diagnoses={tmp}"], "no diagnosis of this set"),
        (["score", "in={set}", "diagnoses={tmp}", "out={set}"], "not empty"),
        (["score", "in={tmp}", "diagnoses={tmp}"], "cannot be read"),
        (["score", "in={set}", "diagnoses=[a={tmp},a={tmp}]"], "given twice"),
        (["score", "in={set}", "diagnoses={tmp}", "oracle=b"], "none of the diagnoses"),
    ],
)
def test_wrong_words_are_explained(words, message, sealed, tmp_path, capsys) -> None:
    arguments = [word.format(tmp=tmp_path, set=sealed) for word in words]
    assert main(["blind", *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_diagnosis_of_another_recording_is_refused(sealed, cases, tmp_path, capsys) -> None:
    name, case = next(iter(cases.items()))
    other = document(case, recordings=[{"file": "x.csv", "sha256": "0" * 64}])
    diagnoses = write(tmp_path / "found", {name: other})
    assert main(["blind", "score", f"in={sealed}", f"diagnoses={diagnoses}"]) == 2
    assert "another recording" in capsys.readouterr().err


@pytest.mark.slow
def test_from_rigs_to_the_table(tmp_path: Path) -> None:
    """Make, run and score a tiny set: an hour-glass turned once, with nothing replaced."""
    folder, diagnoses, out = tmp_path / "set", tmp_path / "found", tmp_path / "out"
    words = ["set=small", "cases=3", "seed=3", "duration=30", "fresh=15", "jobs=1"]
    assert main(["blind", "make", *words, f"out={folder}"]) == 0
    few = "with=['candidates=[pitch_coulomb_friction,yaw_coulomb_friction,main_input_delay]']"
    run = ["blind", "run", f"in={folder}", f"out={diagnoses}", "effort=quick", few, "jobs=1"]
    assert main([*run, "cases=1"]) == 0
    assert len(list(diagnoses.glob("c*"))) == 1
    assert main(run) == 0
    assert main(["blind", "score", f"in={folder}", f"diagnoses={diagnoses}", f"out={out}"]) == 0
    method = json.loads((out / "score.json").read_text())["methods"]["found"]
    assert method["diagnosed"] == 3
    assert method["mean_seconds"] > 0
    assert all(facts["fresh"] is not None for facts in method["judged"].values())
    rows = {row["measure"]: row for row in method["measures"]}
    assert rows["a channel made worse by over 2 %"]["count"] == 3


def test_without_the_source_checkout_the_proof_tells_where_it_is(capsys: Any) -> None:
    with pytest.MonkeyPatch.context() as patch:
        for name in [n for n in sys.modules if n.split(".")[0] == "experiments"]:
            patch.delitem(sys.modules, name)
        patch.setitem(sys.modules, "experiments", None)
        assert main(["blind", "score", "in=a", "diagnoses=b"]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "source checkout" in message
    assert "make blind" in message
