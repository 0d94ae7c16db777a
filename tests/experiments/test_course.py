"""``trms course``: rigs that tell nothing of themselves, and marks that follow from the truth."""

import csv
import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from experiments.course.answers import (
    LISTED,
    NO_EFFECT,
    Answer,
    Scheme,
    Worth,
    mark,
    read_answer,
    truth_of,
)
from experiments.course.sheet import task_sheet
from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.sealing import open_key
from experiments.gap.blind.sets import NAMEABLE
from experiments.gap.blind.severity import levels_reached
from experiments.gap.blind.truths import LIBRARY, group_of
from trms_cli.cli import main
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.newtonian import Newtonian

RIGS = 10


@pytest.fixture(scope="module", autouse=True)
def _short() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
        yield


def rigs(folder: Path, *words: str) -> Path:
    assert main(["course", "rigs", "duration=1", "jobs=1", f"out={folder}", *words]) == 0
    return folder


@pytest.fixture(scope="module")
def handed_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rigs(tmp_path_factory.mktemp("course") / "rigs", f"n={RIGS}", "seed=11")


@pytest.fixture(scope="module")
def cases(handed_out: Path) -> Mapping[str, Case]:
    return open_key(handed_out.with_name("rigs.key"), handed_out).cases


def perfect(rig: str, case: Case, **changes: Any) -> dict[str, Any]:
    truth = dict(truth_of(case))
    uncertainty = None if truth["size"] is None else 0.05 * abs(truth["size"])
    return {"rig": rig, **truth, "uncertainty": uncertainty, **changes}


def hand_in(folder: Path, answers: list[dict[str, Any]]) -> Path:
    folder.mkdir()
    for number, answer in enumerate(answers):
        (folder / f"student {number}.yaml").write_text(yaml.safe_dump(answer))
    return folder


def checked(handed_out: Path, answers: Path, out: Path, *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["course", "check", f"in={handed_out}", f"answers={answers}", f"out={out}", *words])
    return code, json.loads((out / "marks.json").read_text())


class TestRigs:
    def test_each_student_has_a_recording_a_sheet_and_an_empty_form(self, handed_out: Path) -> None:
        folders = sorted(path for path in handed_out.iterdir() if path.is_dir())
        assert [path.name for path in folders] == [f"rig_{k:03d}" for k in range(1, RIGS + 1)]
        for folder in folders:
            files = sorted(path.name for path in folder.iterdir())
            assert files == ["answer.yaml", "recording.csv", "task.md"]
            form = yaml.safe_load((folder / "answer.yaml").read_text())
            assert form.pop("rig") == folder.name
            assert form == dict.fromkeys(("effect", "place", "size", "uncertainty"))

    def test_nothing_that_is_handed_out_tells_the_truth(self, handed_out: Path, cases: Any) -> None:
        texts = {
            folder.name: [(folder / name).read_text() for name in ("task.md", "answer.yaml")]
            for folder in handed_out.iterdir()
            if folder.is_dir()
        }
        # sheets and forms are the same but for the rig's own name
        assert len({str([t.replace(rig, "RIG") for t in text]) for rig, text in texts.items()}) == 1
        heads = {
            "".join((handed_out / rig / "recording.csv").read_text().splitlines(True)[:3])
            for rig in texts
        }
        assert len(heads) == 1
        assert not list(handed_out.rglob("key*"))
        assert "seed" not in (handed_out / "commitment.json").read_text()

    def test_the_sheet_names_the_key_and_what_may_be_answered(self, handed_out: Path) -> None:
        sheet = (handed_out / "rig_001" / "task.md").read_text()
        assert json.loads((handed_out / "commitment.json").read_text())["sha256"] in sheet
        for effect in LISTED:
            row = next(line for line in sheet.splitlines() if line.startswith(f"| `{effect}` "))
            assert all(f"`{place}`" in row for place in LIBRARY[effect].locations)
            assert row.count("|") == 6
        assert sheet.count("\n") < 60  # one page

    def test_units_are_those_of_the_library(self) -> None:
        sheet = task_sheet("rig_001", Newtonian(), "0" * 64, 120.0, 0.02)
        row = {line.split("`")[1]: line for line in sheet.splitlines() if line.startswith("| `")}
        assert "torque [N m]" in row["yaw_coulomb_friction"]
        assert "delay [s]" in row["main_input_delay"]
        assert "arm 0.25 m" in row["pitch_mass_imbalance"]
        assert "120 s at 50 Hz" in sheet

    def test_the_same_seed_makes_the_same_rigs_another_seed_others(
        self, handed_out: Path, tmp_path: Path
    ) -> None:
        again = rigs(tmp_path / "again", f"n={RIGS}", "seed=11")
        other = rigs(tmp_path / "other", f"n={RIGS}", "seed=12")
        for file in handed_out.glob("*/recording.csv"):
            assert file.read_bytes() == (again / file.parent.name / file.name).read_bytes()
            assert file.read_bytes() != (other / file.parent.name / file.name).read_bytes()

    def test_a_seed_that_is_not_given_is_drawn_and_kept(self, tmp_path: Path) -> None:
        seeds = {
            open_key(folder.with_name(f"{folder.name}.key"), folder).seed
            for folder in (rigs(tmp_path / name, "n=1") for name in "ab")
        }
        assert len(seeds) == 2

    def test_a_recording_that_was_changed_is_refused(self, tmp_path: Path, capsys: Any) -> None:
        folder = rigs(tmp_path / "rigs", "n=2", "seed=1")
        recording = folder / "rig_002" / "recording.csv"
        recording.write_text(recording.read_text().replace("1", "2", 1))
        answers = hand_in(tmp_path / "in", [{"rig": "rig_001", "effect": NO_EFFECT}])
        assert main(["course", "check", f"in={folder}", f"answers={answers}"]) == 2
        assert "not the one that was sealed" in capsys.readouterr().err


def test_rigs_of_a_course_can_be_named() -> None:
    """All are driven alike, and each effect is one of those that make a gap of twice the floor."""
    drawn = plan("course", 5, 200)
    assert {case.kind for case in drawn} == {"single", "offset"}
    assert {case.drive for case in drawn} == {"rich"}
    assert {case.channels for case in drawn} == {"four"}
    assert {effect for case in drawn for effect in case.effects} == set(NAMEABLE)
    assert not [case for case in drawn if "weak" in case.severity.values()]
    assert all("medium" in levels_reached(effect) for effect in NAMEABLE)
    assert 10 <= sum(not case.effects for case in drawn) <= 30


def test_other_sets_are_drawn_as_before() -> None:
    effects = {effect for case in plan("development", 5) for effect in case.effects}
    assert len(effects) > 3 * len(NAMEABLE)
    assert any(case.channels == "angles" for case in plan("development", 5))


FRICTION = Case(
    kind="single",
    effects={"yaw_coulomb_friction": {"torque": 0.004}},
    locations=("yaw_moment",),
    group=group_of("yaw_coulomb_friction"),
)
RIGHT = {
    "rig": "rig_001",
    "effect": "yaw_coulomb_friction",
    "place": "yaw_moment",
    "size": 0.0041,
    "uncertainty": 0.0001,
}


class TestMarks:
    @pytest.mark.parametrize(
        ("changes", "points", "verdict"),
        [
            ({}, (4, 2, 2, 2), "right"),
            ({"size": -0.0041}, (4, 2, 0, 0), "right"),
            ({"size": 0.0045}, (4, 2, 0, 0), "right"),  # 12 % off, five deviations
            ({"size": 0.0045, "uncertainty": 0.0003}, (4, 2, 0, 2), "right"),
            ({"uncertainty": 0.00004}, (4, 2, 2, 0), "right"),  # two of them fall short
            ({"uncertainty": 0.002}, (4, 2, 2, 0), "right"),  # half of the size says nothing
            ({"uncertainty": 0.0}, (4, 2, 2, 0), "right"),
            ({"place": "tail_thrust"}, (4, 2, 2, 2), "right"),  # the same equation
            ({"place": "yaw_sensor"}, (4, 0, 2, 2), "right"),
            ({"effect": "yaw_stribeck_friction"}, (3, 2, 0, 0), "confusable"),
            ({"effect": "yaw_cable_stiffness"}, (0, 2, 0, 0), "wrong"),
            ({"effect": "pitch_mass_imbalance", "place": "pitch_moment"}, (0, 0, 0, 0), "wrong"),
        ],
    )
    def test_of_an_effect(self, changes: Any, points: Any, verdict: str) -> None:
        marks = mark(Answer(**{**RIGHT, **changes}), FRICTION, Scheme())
        assert (marks.effect, marks.place, marks.size, marks.uncertainty) == points
        assert (marks.verdict, marks.all) == (verdict, sum(points))

    def test_of_no_effect(self) -> None:
        null = Case(kind="offset")
        none = Answer(rig="rig_001", effect=NO_EFFECT)
        assert mark(none, null, Scheme()).all == Scheme().points.all == 10
        assert mark(Answer(**RIGHT), null, Scheme()).all == 0
        assert mark(none, FRICTION, Scheme()).all == 0

    def test_the_scheme_is_the_lecturers(self) -> None:
        far = Answer(**{**RIGHT, "size": 0.0047})
        assert mark(far, FRICTION, Scheme()).size == 0
        assert mark(far, FRICTION, Scheme(size_within=0.2, points=Worth(size=7.0))).size == 7


class TestForms:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"effect": "yaw_coulomb_frictoin"}, "no effect"),
            ({"effect": 3}, "3"),
            ({"place": "yaw"}, "no place"),
            ({"place": None}, "no place"),
            ({"size": None}, "nothing given"),
            ({"size": "large"}, "large"),
            ({"size": float("nan")}, "nan"),
            ({"uncertainty": -0.001}, "-0.001"),
            ({"sd": 0.1}, "unknown key 'sd'"),
            ({"effect": NO_EFFECT}, "has no place"),
        ],
    )
    def test_what_cannot_be_meant_is_refused(self, changes: Any, message: str, tmp_path: Path):
        file = tmp_path / "a.yaml"
        file.write_text(yaml.safe_dump({**RIGHT, **changes}))
        with pytest.raises(ConfigurationError) as refused:
            read_answer(file)
        assert message in f"{refused.value.problem} {refused.value.remedy}"
        assert refused.value.where.startswith(str(file))
        assert refused.value.remedy

    @pytest.mark.parametrize("text", ["", "- 1", "a: [", "\x00", "1: 2", "rig: x\nrig: y", "just"])
    def test_what_is_no_form_is_refused(self, text: str, tmp_path: Path) -> None:
        file = tmp_path / "a.yaml"
        file.write_text(text)
        with pytest.raises(ConfigurationError):
            read_answer(file)

    def test_json_is_read_as_well(self, tmp_path: Path) -> None:
        file = tmp_path / "a.json"
        file.write_text(json.dumps(RIGHT))
        assert read_answer(file) == Answer(**RIGHT)

    def test_a_student_sees_that_a_form_is_readable(self, tmp_path: Path, capsys: Any) -> None:
        file = tmp_path / "a=b.yaml"
        file.write_text(yaml.safe_dump(RIGHT))
        assert main(["course", "check", f"answers={file}"]) == 0
        said = "rig_001: yaw_coulomb_friction at yaw_moment, 0.0041 ± 0.0001"
        assert said in capsys.readouterr().out
        file.write_text("effect:\n")
        assert main(["course", "check", f"answers={file}"]) == 2
        assert "not filled in" in capsys.readouterr().err


class TestCheck:
    def test_whoever_knows_the_truth_has_all_points(self, handed_out, cases, tmp_path) -> None:
        answers = hand_in(tmp_path / "in", [perfect(rig, case) for rig, case in cases.items()])
        code, document = checked(handed_out, answers, tmp_path / "out")
        assert code == 0
        assert document["schema"] == "trms.course.marks/1"
        assert {row["points"] for row in document["rigs"].values()} == {10.0}
        table = list(csv.DictReader((tmp_path / "out" / "marks.csv").open()))
        assert [row["rig"] for row in table] == sorted(cases)
        assert {float(row["points"]) for row in table} == {10.0}

    def test_in_their_own_folders_and_what_is_missing(self, handed_out, cases, tmp_path, capsys):
        """Forms may be filled in where they lie; one that is still empty was not handed in."""
        (tmp_path / "in").mkdir()
        for rig in ("rig_001", "rig_002"):
            (tmp_path / "in" / rig).mkdir()
            form = (handed_out / rig / "answer.yaml").read_text()
            (tmp_path / "in" / rig / "answer.yaml").write_text(form)
        (tmp_path / "in" / "rig_001" / "answer.yaml").write_text(
            yaml.safe_dump(perfect("rig_001", cases["rig_001"]))
        )
        code, document = checked(handed_out, tmp_path / "in", tmp_path / "out")
        assert code == 0
        assert document["rigs"]["rig_001"]["points"] == 10
        assert document["rigs"]["rig_002"]["problem"] == "nothing handed in"
        assert f"1 of {RIGS} handed in" in capsys.readouterr().out

    def test_a_form_that_cannot_be_read_stops_nobody_elses(
        self, handed_out, cases, tmp_path, capsys
    ) -> None:
        good = perfect("rig_001", cases["rig_001"])
        twice = perfect("rig_002", cases["rig_002"])
        stray = perfect("rig_099", cases["rig_002"])
        answers = hand_in(tmp_path / "in", [good, twice, twice, stray])
        (answers / "rig_003.yaml").write_text("rig: rig_003\neffect: =cmd()\n")
        (answers / "none.yaml").write_text("- nothing\n")
        code, document = checked(handed_out, answers, tmp_path / "out")
        assert code == 2
        message = " ".join(capsys.readouterr().err.split())
        assert "4 forms could not be marked" in message
        assert "no rig 'rig_099'" in message
        marked = document["rigs"]
        assert marked["rig_001"]["points"] == 10
        assert "more than once" in marked["rig_002"]["problem"]
        assert "no effect '=cmd()'" in marked["rig_003"]["problem"]
        assert marked["rig_002"]["points"] == marked["rig_003"]["points"] == 0

    def test_points_are_those_that_are_asked_for(self, handed_out, cases, tmp_path) -> None:
        rig, case = next((r, c) for r, c in cases.items() if c.effects)
        answers = hand_in(tmp_path / "in", [perfect(rig, case, place="main_tacho")])
        words = ["points.effect=1", "points.place=9", "points.size=0", "points.uncertainty=0"]
        _, document = checked(handed_out, answers, tmp_path / "out", *words)
        assert document["rigs"][rig]["points"] == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "nothing given"),
        (["rig"], "did you mean"),
        (["rigs"], "out must be given"),
        (["rigs", "out={tmp}/a", "n=0"], "0 given"),
        (["rigs", "out={tmp}/a", "n=many"], "many"),
        (["rigs", "out={tmp}/a", "key={tmp}/a/key"], "lies among the recordings"),
        (["rigs", "out={set}"], "not empty"),
        (["rigs", "out={tmp}/a", "sample_time=0.0205"], "whole number of milliseconds"),
        (["rigs", "out={tmp}/a", "sed=3"], "sed"),
        (["check", "in={set}"], "answers must be given"),
        (["check", "answers={tmp}/none"], "there is no"),
        (["check", "answers={tmp}"], "holds no form"),
        (["check", "in={tmp}", "answers={form}"], "cannot be read"),
        (["check", "in={set}", "answers={form}", "key={tmp}"], "cannot be read"),
        (["check", "in={set}", "answers={form}", "size_within=-1"], "size_within"),
        (["check", "in={set}", "answers={form}", "points.effect=-1"], "points.effect"),
        (["check", "in={set}", "answers={form}", "points.efect=1"], "efect"),
        (["check", "in={set}", "answers={form}", "out={set}"], "not empty"),
    ],
)
def test_wrong_words_are_explained(words, message, handed_out, tmp_path, capsys) -> None:
    form = tmp_path / "form" / "a.yaml"
    (form.parent / "deep").mkdir(parents=True)
    form.write_text(yaml.safe_dump(RIGHT))
    (tmp_path / "empty").mkdir()
    places = {"tmp": tmp_path / "empty", "set": handed_out, "form": form}
    assert main(["course", *(word.format(**places) for word in words)]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_without_the_source_checkout_it_tells_where_it_is(capsys: Any) -> None:
    with pytest.MonkeyPatch.context() as patch:
        for name in [n for n in sys.modules if n.split(".")[0] == "experiments"]:
            patch.delitem(sys.modules, name)
        patch.setitem(sys.modules, "experiments", None)
        assert main(["course", "rigs", "out=a"]) == 2
    assert "source checkout" in " ".join(capsys.readouterr().err.split())
