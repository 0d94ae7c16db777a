"""``trms investigate`` as a person types it; what is diagnosed is put in by hand, but once."""

import functools
import json
import sys
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.gap.diagnosis_case import FRICTION
from tests.gap.test_investigation import advice, believed
from tests.program import Done, in_process
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.simulation.closed_loop import Loop

SHORT = ("first=25", "lead_in=5", "effort=quick", "jobs=1", "page=false", "out=inv")


@pytest.fixture
def trms(tmp_path: Path) -> Callable[..., Done]:
    return functools.partial(in_process, tmp_path)


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trms_cli.identification.admission.motion._SPARSE", 60)


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[int]]:
    """Let the pipeline answer in turn; how many recordings it was given each time."""

    def put(*each: DiagnosisResult | type[BaseException]) -> list[int]:
        counts: list[int] = []

        def diagnose(problem: Any, progress: Any = None) -> DiagnosisResult:
            counts.append(len(problem.datasets))
            answer = each[min(len(counts), len(each)) - 1]
            if isinstance(answer, type):
                raise answer
            return answer

        module = types.ModuleType("trms_cli.gap.diagnose")
        module.diagnose = diagnose  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
        return counts

    return put


def document(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "inv/investigation.json").read_text())
    return content


def test_experiments_are_made_until_one_cause_is_sure(trms, answers, tmp_path):
    counts = answers(believed(0.6, next_experiment=advice(5.0)), believed(0.98))
    done = trms("investigate", *SHORT)
    assert counts == [1, 2]  # the second time all recordings together
    content = document(tmp_path)
    assert content["ending"] == "sure"
    assert [e["recorded"] for e in content["experiments"]] == [25.0, 40.0]
    assert [e["probabilities"][FRICTION] for e in content["experiments"]] == [0.6, 0.98]
    assert all((tmp_path / e["log"]).is_file() for e in content["experiments"])
    assert (tmp_path / "inv/diagnosis/corrected_model.yaml").is_file()
    assert (tmp_path / "inv/diagnosis/diagnosis.json").is_file()
    assert "After 2 experiments and 65 s of rig time" in done.stdout


def test_a_recording_that_cannot_be_diagnosed_is_left_out(trms, answers, tmp_path):
    still = advice(5.0)
    commands = np.zeros_like(still.prediction.experiment.commands)
    experiment = replace(still.prediction.experiment, commands=commands)
    still = replace(still, prediction=replace(still.prediction, experiment=experiment))
    counts = answers(believed(0.6, next_experiment=still))
    done = trms("investigate", *SHORT)
    assert counts == [1]  # the inputs of the second never moved
    assert document(tmp_path)["ending"] == "unusable"
    assert [e["usable"] for e in document(tmp_path)["experiments"]] == [True, False]
    assert "yaw Coulomb friction" in done.stdout


@pytest.mark.slow
def test_the_budget_ends_it_and_more_of_it_goes_on(trms, answers, tmp_path):
    answers(believed(0.6, next_experiment=advice(5.0)))
    done = trms("investigate", *SHORT, "budget=30")
    assert document(tmp_path)["ending"] == "budget"
    assert "resume=inv" in done.stdout
    counts = answers(believed(0.6, next_experiment=advice(5.0)), believed(0.97))
    done = trms("investigate", "resume=inv", "budget=100")
    assert counts == [1, 2]
    assert document(tmp_path)["ending"] == "sure"
    assert len(document(tmp_path)["experiments"]) == 2


def test_ctrl_c_keeps_what_is_recorded(trms, answers, tmp_path, monkeypatch):
    answers(KeyboardInterrupt)
    done = trms("investigate", *SHORT, code=130)
    assert "investigate resume=inv" in done.stderr
    assert len(document(tmp_path)["experiments"]) == 1
    counts = answers(believed(0.99))
    trms("investigate", "resume=inv")
    assert counts == [1]
    assert document(tmp_path)["ending"] == "sure"


def test_an_interrupted_experiment_counts_as_far_as_it_came(trms, answers, tmp_path, monkeypatch):
    answers(believed(0.99))
    run = Loop.run

    def broken_off(self: Loop, progress: Any, stop: Any) -> None:
        def tell(time: float, error: float) -> None:
            if time >= 12.0:
                raise KeyboardInterrupt

        run(self, tell, stop)

    monkeypatch.setattr(Loop, "run", broken_off)
    trms("investigate", *SHORT, code=130)
    (experiment,) = document(tmp_path)["experiments"]
    assert not experiment["complete"]
    assert 11.0 < experiment["recorded"] < 14.0


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["budget=10"], "budget"),
        (["first=12"], "first"),
        (["candidates=[nothing]"], "candidates"),
        (["plant=udp", "effect=yaw_coulomb_friction"], "effect"),
        (["sure=2"], "sure"),
    ],
)
def test_what_cannot_be_is_refused_before_the_rig_moves(trms, tmp_path, words, where):
    done = trms("investigate", *words, "out=inv", code=2)
    assert f"in  {where}" in done.stderr
    assert not (tmp_path / "inv").exists()


def test_a_real_rig_is_not_driven_where_nobody_confirms(trms, tmp_path, monkeypatch):
    from trms_cli.core.errors import ConfigurationError
    from trms_cli.library.tasks import run

    def refused(composition: Any, listener: Any) -> None:
        assert composition.config["plant"]["arm"] is False
        assert not listener.confirm("the rig will move")
        raise ConfigurationError("the rig was not armed: nobody confirmed", where="plant.arm")

    monkeypatch.setattr(run, "perform", refused)
    done = trms("investigate", "plant=udp", *SHORT, code=2)
    assert "nobody confirmed" in done.stderr and "arm=true" in done.stderr
    assert np.loadtxt(tmp_path / "inv/experiment-1.csv", delimiter=",", skiprows=3).shape[1] == 3


@pytest.mark.slow
def test_a_simulated_rig_from_end_to_end(trms, tmp_path):
    trms(
        *("investigate", f"effect={FRICTION}", "plant.prior_seed=3", "effort=quick", "jobs=1"),
        *("page=false", "out=inv"),
    )
    content = document(tmp_path)
    assert content["ending"] == "sure"
    last = content["experiments"][-1]["probabilities"]
    assert max(last, key=last.get) == FRICTION
    assert content["rig_time_s"] <= 300.0
