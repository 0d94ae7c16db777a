"""What the studies of the chapters share: refusals, pages with their figures, whole runs."""

import importlib
import json
import re

import pytest

from experiments.expected_figures import Tolerance, differences, read_expected
from trms_cli.core.errors import ConfigurationError

#: A chapter, and its study as far as a test waits for it; the whole ones are `make docs-check`.
STUDIES = {2: [], 5: [], 6: ["--quick"], 7: ["--quick"], 8: ["--quick", "--jobs", "1"]}
#: Pictures that the quick study does not draw.
WHOLE_ONLY = {7: {"estimates_1.png", "estimates_2.png"}}


def program(number: int):
    return importlib.import_module(f"experiments.chapter{number}.__main__")


@pytest.mark.parametrize("text", ["", "[]", "seed: x", "starts: 3", "pairs: {}\n", "questions: x"])
@pytest.mark.parametrize("number", STUDIES)
def test_what_is_no_study_ends_with_a_message(number, text, tmp_path, capsys):
    file = tmp_path / "study.yaml"
    file.write_text(text)
    assert program(number).main(["--study", str(file), "--out", str(tmp_path / "out")]) == 2
    assert "no study" in capsys.readouterr().err


def test_a_figure_that_moved_is_named():
    allowed = {"a": Tolerance(0.01, 0.1)}
    expected_figures = {"a": {"x": 1.0, "y": "proved", "z": None}}
    assert differences({"a": {"x": 1.1, "y": "proved", "z": None}}, expected_figures, allowed) == []
    moved = {"a": {"x": 1.12, "y": "searched", "z": 0.0}}
    words = differences(moved, expected_figures, allowed)
    assert len(words) == 3 and "a: x is 1.12, expected 1.0" in words
    # NaN is none, "w" is new, and "y" and "z" are gone: a part is held against what it was, whole
    assert len(differences({"a": {"x": float("nan"), "w": 1}}, expected_figures, allowed)) == 4
    assert len(differences({}, expected_figures, allowed)) == 3
    # what has no tolerance is not looked at
    assert differences({}, expected_figures, {}) == []


def test_recorded_figures_that_are_missing_are_told(tmp_path):
    file = tmp_path / "expected.json"
    for text in (None, '{"figures": 1}', '{"full": {}}', "["):
        if text is not None:
            file.write_text(text)
        with pytest.raises(ConfigurationError, match="no recorded figures") as caught:
            read_expected(file, "figures")
        assert "--update" in caught.value.remedy


@pytest.mark.parametrize("words", [["--update", "--quick"], ["--update", "--out", "x"]])
@pytest.mark.parametrize("number", [5, 6])
def test_a_part_is_not_recorded(number, words, capsys):
    assert program(number).main(words) == 2
    assert "--update" in capsys.readouterr().err


@pytest.mark.parametrize("number", STUDIES)
def test_the_figures_of_a_page_are_there_and_small(number):
    page, figures = program(number).PAGE, program(number).FIGURES
    pages = [page, *(page.parent.glob("stability*.md") if number == 5 else ())]
    text = "".join(each.read_text(encoding="utf-8") for each in pages)
    largest = 250_000 if number == 8 else 200_000
    page_figures = set(re.findall(rf"figures/chapter{number}/(\w+\.png)", text))
    assert page_figures == {path.name for path in figures.glob("*.png")}
    assert all(path.stat().st_size < largest for path in figures.glob("*.png"))


@pytest.mark.slow
@pytest.mark.parametrize("number", STUDIES)
def test_a_study_elsewhere(number, tmp_path, capsys):
    """It is what was recorded, where that is compared; the page stays, all else is drawn anew."""
    page, figures = program(number).PAGE, program(number).FIGURES
    before = page.read_bytes()
    words = STUDIES[number]
    assert program(number).main([*words, "--out", str(tmp_path)]) == 0, capsys.readouterr().out
    assert page.read_bytes() == before
    drawn = {path.name for path in tmp_path.glob("*.png")}
    if number != 8:
        every = {path.name for path in figures.glob("*.png")}
        assert drawn == every - WHOLE_ONLY.get(number, set())
        least = 10_000 if number == 7 else 5_000
        assert all((tmp_path / name).stat().st_size > least for name in drawn)
    if number in (2, 8):
        document = json.loads((tmp_path / f"chapter{number}.json").read_text())
        assert document["schema"] == f"trms.chapter{number}/1"
        assert number == 2 or len(document["runs"]) == 8
