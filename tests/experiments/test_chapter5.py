"""The study of chapter 5: what it asks, that its answers are what was recorded, its page."""

import re

import pytest

from experiments.chapter5.__main__ import EXPECTED, PAGE
from experiments.chapter5.answers import answers, figures_of
from experiments.chapter5.page import parts_of
from experiments.chapter5.study import Question, Study, read_study
from experiments.expected_figures import Tolerance, differences, read_expected
from trms_cli.composition.catalogue import read_groups
from trms_cli.core.errors import ConfigurationError

#: What issue and thesis ask for, by the study that answers it.
STUDIES = {
    *("equilibria", "local", "root_locus", "controllability", "phase_portrait", "limit_cycles"),
    *("hunting", "lyapunov", "region_of_attraction", "margins", "tolerance"),
}


class TestStudy:
    def test_every_study_that_there_is_is_asked_and_the_quick_one_is_a_part(self):
        full, quick = read_study().questions, read_study(quick=True).questions
        studies = set()
        for name, question in full.items():
            assert question.figures and question.why, name
            (word,) = [text for text in question.overrides if text.startswith("study=")]
            studies.add(word.removeprefix("study="))
        assert studies == STUDIES == set(read_groups()["study"])
        assert 2 <= len(quick) < len(full)
        assert all(full[name].overrides == q.overrides for name, q in quick.items())


class TestExpectation:
    def test_quick_study(self):
        study = read_study(quick=True)
        figures = figures_of(study, answers(study, 1, None, lambda name: None))
        allowed = dict.fromkeys(figures, study.tolerance)
        assert differences(figures, read_expected(EXPECTED, "figures"), allowed) == []

    def test_recorded_is_what_is_asked(self):
        recorded = read_expected(EXPECTED, "figures")
        figures_by_question = {name: set(q.figures) for name, q in read_study().questions.items()}
        assert {name: set(figures) for name, figures in recorded.items()} == figures_by_question

    def test_a_key_that_is_not_there_is_told(self):
        study = Study({"q": Question("why", [], ["a.1.b"])}, Tolerance(0, 0))
        with pytest.raises(ConfigurationError, match=r"no 'a\.1\.b'") as caught:
            figures_of(study, {"q": {"results": {"a": [{"b": 1.0}]}}})
        assert "questions.q" in caught.value.where
        study.questions["q"].figures = ["a.#"]
        assert figures_of(study, {"q": {"results": {"a": [{}, {}]}}}) == {"q": {"a.#": 2}}
        study.questions["q"].figures = ["a.0"]
        with pytest.raises(ConfigurationError, match="no single figure"):
            figures_of(study, {"q": {"results": {"a": [{"b": 1.0}]}}})


class TestPage:
    def test_it_has_a_place_for_every_question_and_no_other(self):
        text = PAGE.read_text(encoding="utf-8")
        begun = re.findall(r"<!-- (\w+): begin -->", text)
        assert sorted(begun) == sorted(read_study().questions)
        for name, question in read_study().questions.items():
            part = text.partition(f"<!-- {name}: begin -->")[2].partition("<!--")[0]
            for word in question.overrides:
                assert word.split("=")[0] in part
            assert part.count("\n- ") >= 1

    def test_a_part_is_made_of_the_answer(self):
        document = {
            "lead": ["It rests."],
            "warnings": ["linear only"],
            "tables": [{"columns": ["|x|"], "rows": [[1.23456], [None]], "caption": "Rest."}],
            "charts": [{"name": "plane", "caption": "The plane."}],
        }
        question = Question("to see", ["study=local"], tables=[0], pictures={"plane": "rest_plane"})
        study = Study({"rest": question}, Tolerance(0, 0))
        part = parts_of(study, {"rest": document})["rest"]
        assert part.splitlines()[0] == "`trms stability study=local`: to see."
        assert "- It rests." in part and "- *linear only*" in part
        assert "| \\|x\\| |" in part and "| 1.23 |" in part and "| – |" in part
        assert "![The plane.](figures/chapter5/rest_plane.png)" in part
