"""The regression of tracking errors: what it runs, what it lets pass, what it refuses."""

import copy
import json
from pathlib import Path

import pytest

from experiments.regression import comparison as comparing
from experiments.regression.__main__ import main
from experiments.regression.expectation import write_expectation
from experiments.regression.matrix import MATRIX, Case, read_matrix
from experiments.regression.runs import Outcome, run_case
from trms_cli.composition.composer import compose
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.scoring.figures import FigureTolerance

#: Two short runs of one controller: a matrix for whole turns of the command.
SMALL = """
every: [sim.duration=6.0, sim.prediction_every=0]
controllers:
  newton_mpc: [controller=newton_mpc]
references:
  square: [ref=square]
  low: [ref=constant]
rigs:
  ideal:
    overrides: [experiment=ideal_rig]
    tolerances: {rmse: 0.002, failures: 0}
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("matrix") / "matrix.yaml"
    file.write_text(SMALL)
    return file


@pytest.fixture(scope="module")
def outcomes(small: Path) -> list[Outcome]:
    return [run_case(case) for case in read_matrix(small)]


def with_rmse(outcome: Outcome, change: float) -> Outcome:
    score = copy.deepcopy(outcome.score)
    assert score is not None
    score["channels"]["alpha_v"]["rmse"] += change
    return Outcome(outcome.case, score)


class TestMatrix:
    @pytest.mark.slow
    def test_every_case_composes(self) -> None:
        cases = read_matrix()
        assert len({case.name for case in cases}) == len(cases) >= 18
        for case in cases:
            config = compose(case.overrides).config
            assert config["sim"]["duration"] <= 40.0
            disturbed = case.name.endswith("disturbed")
            assert set(config["effect"]) == (
                {"yaw_coulomb_friction", "main_input_delay"} if disturbed else set()
            )
            assert set(config["plant"].get("disturbances", ())) == (
                {"yaw_push"} if disturbed else set()
            )
            assert config["plant"]["prior_seed"] == (1 if disturbed else None)
            # It is held to tracking and to a solver that works.
            assert {"rmse", "failures", "samples"} <= set(case.tolerances)

    def test_a_part_of_it_with_something_else(self) -> None:
        cases = read_matrix(pattern="pid/*", extra=["seed=3"])
        assert {case.name.split("/")[0] for case in cases} == {"pid"}
        assert all(case.overrides[-1] == "seed=3" for case in cases)
        with pytest.raises(ConfigurationError, match="nobody"):
            read_matrix(pattern="nobody/*")

    @pytest.mark.parametrize(
        "text", ["", "[]", "every: 3", "{", SMALL.replace("rmse:", "rsme:"), SMALL + "more: 1\n"]
    )
    def test_what_is_no_matrix_is_told(self, tmp_path: Path, text: str) -> None:
        file = tmp_path / "matrix.yaml"
        file.write_text(text)
        with pytest.raises(ConfigurationError, match="no matrix") as caught:
            read_matrix(file)
        assert caught.value.where == str(file)


class TestRun:
    def test_a_run_is_scored_and_traced(self, outcomes: list[Outcome]) -> None:
        for outcome in outcomes:
            assert outcome.score is not None, outcome.problem
            assert outcome.score["complete"]
            assert outcome.score["channels"]["alpha_v"]["rmse"] > 0
            assert outcome.traces["time"].shape == outcome.traces["r_alpha_h"].shape

    def test_a_run_that_cannot_be_made_says_why(self) -> None:
        case = Case("x/y/z", ("controller=nobody",), {"rmse": FigureTolerance()})
        outcome = run_case(case)
        assert outcome.score is None
        assert "nobody" in outcome.problem
        assert comparing.compare_outcome(outcome, comparing.BaselineFile()).bad


class TestComparison:
    @pytest.fixture
    def recorded(self, outcomes: list[Outcome], tmp_path: Path) -> comparing.BaselineFile:
        file = tmp_path / "baseline.json"
        comparing.write_recorded(outcomes, comparing.BaselineFile(), "first", "abc", file)
        return comparing.read_recorded(file)

    def test_a_run_equals_itself_but_not_with_a_failed_solve(self, outcomes, recorded) -> None:
        verdicts = [comparing.compare_outcome(outcome, recorded).verdict for outcome in outcomes]
        assert verdicts == ["same", "same"]
        outcome = with_rmse(outcomes[0], 0.0)
        assert outcome.score is not None
        outcome.score["solver"]["failures"] = 1
        assert comparing.compare_outcome(outcome, recorded).verdict == "worse"
        # Nor does it pass without a baseline.
        compared = comparing.compare_outcome(outcomes[0], comparing.BaselineFile())
        assert (compared.verdict, compared.bad) == ("new", True)

    @pytest.mark.parametrize(
        ("change", "verdict"),
        [(0.0015, "same"), (-0.0015, "same"), (0.003, "worse"), (-0.003, "better")],
    )
    def test_a_figure_decides_beyond_its_tolerance(self, outcomes, recorded, change, verdict):
        compared = comparing.compare_outcome(with_rmse(outcomes[0], change), recorded)
        assert compared.verdict == verdict
        assert compared.bad == (verdict == "worse")

    def test_wall_time_and_figures_that_are_not_held_stay_out(self, recorded) -> None:
        text = json.dumps(recorded.document())
        assert "rmse" in text
        assert not any(word in text for word in ("time_ms", "effort", "overshoot"))

    def test_a_run_that_became_another_is_not_compared(self, outcomes, recorded) -> None:
        case = outcomes[0].case
        other = Case(case.name, (*case.overrides, "seed=1"), case.tolerances)
        comparing.check_matrix([case], recorded)
        with pytest.raises(RecordingError, match="another run"):
            comparing.check_matrix([other], recorded)

    def test_a_failed_run_leaves_the_old_baseline_and_a_new_one_the_reasons(
        self, outcomes, recorded, tmp_path
    ) -> None:
        file = tmp_path / "baseline.json"
        before = file.read_bytes()
        failed = Outcome(outcomes[0].case, None, "it fell over")
        with pytest.raises(RecordingError, match="it fell over"):
            comparing.write_recorded([failed, outcomes[1]], recorded, "no", "", file)
        assert file.read_bytes() == before
        comparing.write_recorded(outcomes, recorded, "second", "def", file)
        again = comparing.read_recorded(file)
        assert (again.reason, again.git) == ("second", "def")
        assert [entry["reason"] for entry in again.history] == ["first"]

    @pytest.mark.parametrize(
        "text",
        ["", "{", "[]", "{}", '{"schema": "trms.score/1"}', '{"schema": "?", "runs": {}}']
        + [f'{{"schema": "{comparing.SCHEMA}", "runs": {runs}}}' for runs in ("3", '{"a": {}}')],
    )
    def test_what_is_no_baseline_is_told(self, tmp_path: Path, text: str) -> None:
        file = tmp_path / "baseline.json"
        file.write_text(text)
        with pytest.raises(RecordingError, match="baseline") as caught:
            comparing.read_recorded(file)
        assert caught.value.where == str(file)
        assert "regression-update" in caught.value.remedy

    def test_the_page_tells_of_this_baseline(self, outcomes, recorded, tmp_path) -> None:
        page, figure = tmp_path / "README.md", tmp_path / "figure.png"
        page.write_text(
            "above\n<!-- expected figures: begin -->\nold\n<!-- expected figures: end -->\nbelow\n"
        )
        write_expectation(outcomes, recorded, page, figure)
        text = page.read_text()
        assert text.startswith("above\n") and text.endswith("\nbelow\n") and "old" not in text
        assert "first" in text and "newton_mpc/square/ideal" in text
        assert figure.read_bytes().startswith(b"\x89PNG")


class TestCommand:
    @pytest.mark.slow
    def test_update_compare_and_fail(self, small: Path, tmp_path: Path, capsys, monkeypatch):
        monkeypatch.setenv("COLUMNS", "80")
        files = ["--matrix", str(small), "--baseline", str(tmp_path / "baseline.json")]
        assert main(["--update", "--reason", "a test", *files]) == 0
        assert "baseline recorded: a test" in capsys.readouterr().out

        assert main([*files, "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        assert document["schema"] == "trms.regression/1"
        assert not document["worse"]
        assert document["baseline"]["reason"] == "a test"

        heavier = "controller.move_weights={u_v: 30.0, u_h: 30.0}"
        assert main([*files, "--only", "*/square/*", heavier]) == 1
        output = capsys.readouterr().out
        assert "WORSE" in output and "alpha_v rmse" in output
        assert max(map(len, output.splitlines())) <= 80

    def test_a_missing_baseline_is_told_before_anything_runs(self, tmp_path: Path, capsys) -> None:
        assert main(["--baseline", str(tmp_path / "none.json")]) == 2
        assert "regression-update" in capsys.readouterr().err

    @pytest.mark.parametrize(
        "argv",
        [
            ["--update"],
            ["--update", "--reason", " "],
            ["--update", "--reason", "why", "--only", "pid/*"],
            ["--update", "--reason", "why", "seed=2"],
            ["--reason", "why"],
        ],
    )
    def test_an_update_needs_a_reason_and_the_whole_matrix(self, argv, capsys) -> None:
        assert main(argv) == 2
        assert "error" in capsys.readouterr().err


def test_the_recorded_baseline_is_of_the_matrix() -> None:
    """Cheap, and says at once what `make regression` would say after half a minute."""
    recorded = comparing.read_recorded()
    cases = read_matrix(MATRIX)
    comparing.check_matrix(cases, recorded)
    assert set(recorded.runs) == {case.name for case in cases}
    assert recorded.reason and recorded.date
