"""Chapter 4: its cases, its page, and a tiny version of it."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.chapter4 import page
from experiments.chapter4.__main__ import main
from experiments.chapter4.cases import Case, read_study
from experiments.chapter4.fits import CaseOutcome, GreyboxFit, run_case
from trms_cli.composition.composer import compose
from trms_cli.core.errors import ConfigurationError


class TestCases:
    def test_are_eleven_and_compose(self) -> None:
        study = read_study()
        assert [case.number for case in study.cases] == list(range(1, 12))
        assert len({case.name for case in study.cases}) == 11
        for case in study.cases:
            assert case.fit != case.held_out
        # Every way of recording once: composing takes a while.
        for number in (2, 3, 4, 6, 8, 10):
            case = study.cases[number - 1]
            config = compose(case.fit).config
            assert config["sim"]["duration"] <= 60 and config["plant"]["prior_seed"]
            assert compose(["real=x.csv", *case.identify], "identify").config["free"]
        assert set(study.methods) == {"genetic", "multiple_shooting"}
        assert set(study.comparison) == {"genetic", "cma_es", "multiple_shooting"}
        assert len(study.seeds) >= 3 and len(study.compared) == 2

    def test_a_part_is_chosen_by_number_or_name(self) -> None:
        assert [c.number for c in read_study("3").cases] == [3]
        assert [c.number for c in read_study("dry friction*").cases] == [7, 8]
        with pytest.raises(ConfigurationError, match="no case is called"):
            read_study("12")


def errors(rmse: float) -> dict:
    return {"alpha_v": {"rmse": rmse, "max_abs_error": rmse, "fit_percent": 9.0, "unit": "rad"}}


@pytest.fixture
def findings() -> page.Findings:
    time = np.arange(50.0)
    trace = {"alpha_v": np.sin(time)}
    outcomes = []
    for number in (1, 9):
        outcome = CaseOutcome(
            Case(number, f"case {number}", (), (), ()), 12, errors(0.05), [],
            {"time": time, **trace}, trace,
        )  # fmt: skip
        for i, method in enumerate(("genetic", "cma_es", "multiple_shooting")):
            for seed in (0, 1):
                history = [(50, 1.0, 400.0), (100, 2.0, 100.0 + seed)]
                outcome.fits.append(
                    GreyboxFit(method, errors(0.01 / (i + 1)), 100.0 - 50 * i + seed, 2.0, 100,
                           history, {"k_ov": 0.006}, trace)
                )  # fmt: skip
        outcomes.append(outcome)
    white_grey = [
        CaseOutcome(o.case, o.free, o.white, o.fits[::4], o.measured, o.white_trace)
        for o in outcomes
    ]
    return page.Findings(white_grey, outcomes, 12.0)


class TestPage:
    def test_tables_hold_what_was_found(self, findings) -> None:
        tables = page.tables(findings)
        head, first, *_ = tables["white-against-grey"]
        row = dict(zip(head, first, strict=True))
        assert row["white"] == "50" and row["genetic algorithm"] == "10"
        assert row["multiple shooting"] == "3.33" and row["free"] == "12"
        head, first, *_ = tables["comparison"]
        row = dict(zip(head, first, strict=True))
        # least of all is multiple shooting's 0 with seed 0
        assert row["cost above the least [nats]"] == "100 (100 to 101)"

    def test_is_rewritten_between_its_marks_only(self, findings, tmp_path: Path) -> None:
        copy, figures = tmp_path / "page.md", tmp_path / "figures"
        copy.write_text(page.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
        page.publish(findings, copy, figures)
        once = copy.read_text(encoding="utf-8")
        assert (
            "| 1 | case 1 | 12 | pitch | 50 |" in once
            and "The 4 fits of white against grey took 8 s of processor time" in once
        )
        page.publish(findings, copy, figures)
        assert copy.read_text(encoding="utf-8") == once
        for name in ("white_against_grey", "cases", "case_1", "case_9", "comparison"):
            assert (figures / f"{name}.png").stat().st_size > 5000

    def test_the_page_in_the_docs_holds_every_case(self) -> None:
        text = page.PAGE.read_text(encoding="utf-8")
        table = text.partition("<!-- white-against-grey: begin -->")[2]
        for case in read_study().cases:
            assert f"| {case.number} | {case.name} |" in table
            # Each with pitch and yaw, and each drawn.
            assert f"(figures/chapter4/case_{case.number}.png)" in text
        rows = table.partition("<!--")[0].splitlines()
        assert sum("| pitch |" in row for row in rows) == 11
        assert sum("| yaw |" in row for row in rows) == 11


@pytest.mark.slow
def test_a_tiny_study_runs(tmp_path: Path, capsys) -> None:
    assert main(["--quick", "--only", "1", "--jobs", "1", "--out", str(tmp_path)]) == 0
    document = json.loads((tmp_path / "chapter4.json").read_text(encoding="utf-8"))
    assert document["schema"] == "trms.chapter4/1"
    (case,) = document["cases"]
    shooting = next(fit for fit in case["grey"] if fit["method"] == "multiple_shooting")
    white = case["white"]["alpha_v"]["rmse"]
    assert shooting["errors"]["alpha_v"]["rmse"] < 0.1 * white
    assert {fit["method"] for fit in document["comparison"][0]["grey"]} == {
        "genetic", "cma_es", "multiple_shooting",
    }  # fmt: skip
    assert "white-against-grey" in capsys.readouterr().out


def test_a_case_is_fitted_and_judged_on_what_was_held_out() -> None:
    case = read_study("1", quick=True).cases[0]
    outcome = run_case(case, {"multiple_shooting": ("method=multiple_shooting",)})
    (fit,) = outcome.fits
    assert outcome.free == 25
    for angle in ("alpha_v", "alpha_h"):
        assert fit.errors[angle]["rmse"] < 0.1 * outcome.white[angle]["rmse"]
        assert len(outcome.measured["time"]) == len(fit.trace[angle])
