"""``trms diagnose`` as a person types it; what it finds is put in by hand."""

import functools
import json
import re
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml

from tests.gap.diagnosis_case import FRICTION, diagnosis
from tests.program import Done, in_process
from trms_cli.core.resources import config_folder
from trms_cli.effects.model_file import load_model
from trms_cli.gap.diagnosis import Cause, DiagnosisResult, FittedParameter, SizeEstimate
from trms_cli.gap.problem import GapProblem

RECORD = ("controller=open_loop", "observer=full_state", "picture=false", "sim.duration=45")
EXCITED = (
    *("signal@controller.u_v=multilevel", "controller.u_v.amplitude=0.5"),
    *("controller.u_v.offset=0.9", "signal@controller.u_h=multilevel"),
    *("controller.u_h.amplitude=0.8", "controller.u_h.seed=5"),
)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of a rig: the log ``rig``, and ``rig.csv``."""
    folder = tmp_path_factory.mktemp("lab")
    in_process(folder, "run", *RECORD, *EXCITED, f"effect={FRICTION}", "out=rig")
    in_process(folder, "export", "rig/run.mcap", "--out", "rig.csv")
    return folder


@pytest.fixture(scope="module")
def trms(lab: Path) -> Callable[..., Done]:
    return functools.partial(in_process, lab)


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether pitch has another zero is asked of a few samples: what is asked takes its time."""
    monkeypatch.setattr("trms_cli.identification.admission.motion._SPARSE", 60)


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., DiagnosisResult]], None]:
    """Put a function in the place of the pipeline; the loops after it take a second."""
    monkeypatch.setattr("trms_cli.gap.worth.DURATION", 1.0)
    monkeypatch.setattr("trms_cli.gap.worth._RISING", 0.0)

    def put(diagnose: Callable[..., DiagnosisResult]) -> None:
        module = types.ModuleType("trms_cli.gap.diagnose")
        module.diagnose = diagnose  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)

    return put


@pytest.fixture
def found(pipeline) -> Callable[[DiagnosisResult], list[GapProblem]]:
    """Let the pipeline find what it is told; gives the problems that it was asked."""

    def tell(answer: DiagnosisResult) -> list[GapProblem]:
        asked: list[GapProblem] = []

        def diagnose(problem: GapProblem, progress: Any) -> DiagnosisResult:
            asked.append(problem)
            progress.update(0.1, 1.0, "refit: start 1 of 2")
            progress.save({"refit": [1.0]})
            return answer

        pipeline(diagnose)
        return asked

    return tell


@pytest.fixture
def diagnosed(found, trms) -> Callable[..., GapProblem]:
    """Diagnose a recording with this result of the pipeline; gives the problem it was asked."""

    def run(answer: DiagnosisResult, out: str, *words: str, real: str = "rig.csv") -> GapProblem:
        asked = found(answer)
        trms("diagnose", f"real={real}", "page=false", f"out={out}", *words)
        (problem,) = asked
        return problem

    return run


def corrected(lab: Path, out: str, name: str = "corrected_model") -> dict:
    """The model that a diagnosis leaves."""
    text = (lab / out / f"{name}.yaml").read_text(encoding="utf-8")
    content: dict = yaml.safe_load(text)
    return content


def runs_with(trms: Callable[..., Done], out: str) -> None:
    """A run takes the corrected model."""
    trms("run", f"model={out}/corrected_model.yaml", "sim.duration=0.2", "picture=false")


def read(file: Path) -> dict:
    content: dict = json.loads(file.read_text(encoding="utf-8"))
    return content


class TestDiagnosis:
    def test_leaves_what_the_contract_names(self, found, trms, lab):
        asked = found(diagnosis())
        done = trms("diagnose", "real=rig.csv", "out=d", "seed=3", "effort=thorough")
        document = read(lab / "d" / "diagnosis.json")
        assert document["verdict"] == "effect" and document["versions"]["trms"]
        assert diagnosis().sentence in " ".join(done.stdout.split())
        # what drives with the corrected model stands in the file as it is typed
        assert "model=d/corrected_model.yaml" in document["worth"]["command"]
        assert set(document["worth"]["after"]) == {"alpha_v", "alpha_h"}
        clone, real = document["control"]  # of a CSV: only a plant option knows its rig
        assert "clone" in clone["why"] and clone["command"] in done.stdout
        assert "plant=NAME" in real["command"] and "model=d/corrected_model.yaml" in real["command"]
        for name in ("diagnosis.json", "corrected_model.yaml", "report.html"):
            assert (lab / "d" / name).is_file() and f"d/{name}" in done.stdout
        assert "refit" in (lab / "d" / "log.txt").read_text(encoding="utf-8")
        assert not (lab / "d" / "diagnose-state.json").exists()
        (problem,) = asked
        assert (problem.seed, problem.effort, problem.model_name) == (3, "thorough", "newtonian")
        assert len(problem.datasets[0]) == 45 / 0.02 and len(problem.candidates) > 30
        # the screen says what the file says
        for cause in document["causes"][:3]:
            assert f"{100 * cause['probability']:.0f} %" in done.stdout
        refit = document["gap"]["alpha_h"]["2.0"]["refit"]
        assert re.search(rf"yaw \[mrad\] .* {1e3 * refit:.3g} ", done.stdout)
        assert document["next_experiment"]["command"] in done.stdout
        # a screen of 80 columns; among the lines are the worth, a line for the rig, one for a clone
        assert len(done.stdout.splitlines()) <= 54

    @pytest.mark.slow
    def test_several_recordings_and_part_of_the_suspects(self, diagnosed, lab):
        (lab / "second.csv").write_bytes((lab / "rig.csv").read_bytes())
        words = ('candidates=[yaw_*,"!yaw_disturbance"]', "data.channels=[alpha_v,alpha_h]")
        problem = diagnosed(diagnosis(), "several", *words, real="[rig.csv,second.csv]")
        assert not (lab / "several" / "report.html").exists()  # page=false
        assert [d.name for d in problem.datasets] == ["rig", "second"]
        assert FRICTION in problem.candidates and "yaw_disturbance" not in problem.candidates
        assert all(name.startswith("yaw_") for name in problem.candidates)
        assert [s.name for s in problem.datasets[0].outputs] == ["alpha_v", "alpha_h"]

    def test_a_model_gets_the_suspects_that_it_can_carry_and_has_not(self, diagnosed):
        no_gap = diagnosis(verdict="no_gap")
        names = set(diagnosed(no_gap, "axis", "model=newtonian_horizontal").candidates)
        assert FRICTION in names and not any(name.startswith("pitch_") for name in names)
        problem = diagnosed(no_gap, "known", f"effect={FRICTION}")
        assert FRICTION not in problem.candidates
        assert f"{FRICTION}.torque" in problem.model.parameters


OWN_EFFECT = '''
from dataclasses import dataclass

from trms_cli.effects.quadratic_damping import QuadraticDamping


@dataclass(frozen=True, kw_only=True)
class Sail(QuadraticDamping):
    """Damping of a sail."""

    patches: int = 2
'''


OWN_MODEL = '''
from trms_cli.models.newtonian import Newtonian


class OurRig(Newtonian):
    """Ours."""
'''


class TestOwn:
    """Effects and models of a user's package."""

    def test_an_effect_enters_the_race_and_the_corrected_model(self, diagnosed, trms, lab):
        folder = lab / "mine"
        (folder / "effect").mkdir(parents=True)
        (folder / "effect" / "sail.yaml").write_text(
            "# a sail on the beam\nsail:\n  _target_: sail_of_diagnose.Sail\n  axis: yaw\n"
            "  coefficient: 0.01  # N m s^2\n  patches: 3\n",
            encoding="utf-8",
        )
        (folder / "sail_of_diagnose.py").write_text(OWN_EFFECT, encoding="utf-8")
        size = SizeEstimate(value=0.0123, sd=0.001, unit="N*m*s^2/rad^2")
        cause = Cause(effects=("sail",), probability=0.9, parameters={"sail.coefficient": size})
        answer = diagnosis(causes=(cause,), parameters={})
        assert "sail" in diagnosed(answer, "own", "--config-dir", str(folder)).candidates
        assert corrected(lab, "own")["effects"]["sail"] == {
            "_target_": "sail_of_diagnose.Sail", "axis": "yaw", "coefficient": 0.0123, "patches": 3,
        }  # fmt: skip
        runs_with(trms, "own")

    def test_a_corrected_model_names_its_class(self, diagnosed, trms, lab):
        folder = lab / "ours"
        (folder / "model").mkdir(parents=True)
        (folder / "model" / "our_rig.yaml").write_text(
            "# our rig\n_target_: our_rig_of_diagnose.OurRig\nparameter_set: bench\n", "utf-8"
        )
        (folder / "our_rig_of_diagnose.py").write_text(OWN_MODEL, encoding="utf-8")
        words = ("--config-dir", str(folder), "model=our_rig")
        diagnosed(diagnosis(parameters=fitted(k_fvp=1.7e-5)), "ours-out", *words)
        target = corrected(lab, "ours-out")["model"]["_target_"]
        assert target == "our_rig_of_diagnose.OurRig"
        model = load_model(str(lab / "ours-out" / "corrected_model.yaml"))
        assert type(model.base).__name__ == "OurRig" and model.effect_name == FRICTION
        assert model.parameters["k_fvp"].value == 1.7e-5
        assert model.parameters["k_fvp"].prior_sd is not None
        runs_with(trms, "ours-out")


def fitted(**values: float) -> dict[str, FittedParameter]:
    return {n: FittedParameter(prior=v, fitted=v, sd=v / 100, unit="") for n, v in values.items()}


class TestModels:
    """The corrected model is taken everywhere, whatever its effects."""

    @pytest.mark.parametrize(
        ("effects", "sizes"),
        [
            ((FRICTION,), {f"{FRICTION}.torque": 0.0041}),
            pytest.param(
                ("main_input_delay",), {"main_input_delay.delay": 0.031}, marks=pytest.mark.slow
            ),
            pytest.param(
                ("pitch_coulomb_friction", "tail_actuator_lag", "yaw_sensor_delay"),
                {
                    "pitch_coulomb_friction.torque": 0.003,
                    "tail_actuator_lag.time_constant": 0.05,
                    "yaw_sensor_delay.delay": 0.05,
                },
                marks=pytest.mark.slow,
            ),
        ],
        ids=lambda v: v[0] if isinstance(v, tuple) else "",
    )
    def test_runs_with_controller_and_observer(self, diagnosed, trms, lab, effects, sizes):
        parameters = {n: SizeEstimate(value=v, sd=v / 20, unit="") for n, v in sizes.items()}
        cause = Cause(effects=effects, probability=0.9, parameters=parameters)
        out = f"models-{len(effects)}-{effects[0]}"
        diagnosed(diagnosis(causes=(cause,), parameters=fitted(k_fvp=1.7e-5, k_oh=0.011)), out)
        content = corrected(lab, out)
        assert set(content["effects"]) == set(effects)
        for name, value in sizes.items():
            effect, _, size = name.partition(".")
            assert content["effects"][effect][size] == value
        assert content["parameters"]["k_fvp"]["value"] == 1.7e-5
        words = ("controller=newton_mpc", "observer=ukf", "sim.duration=0.6", "picture=false")
        trms("run", f"model={out}/corrected_model.yaml", *words, f"out={out}-run")

    def test_is_validated(self, diagnosed, trms, lab):
        diagnosed(diagnosis(parameters={}), "v")
        words = ("real=rig.csv", "model=v/corrected_model.yaml", "data.end=20", "page=false")
        trms("validate", *words, "out=v-validated")
        document = read(lab / "v-validated" / "validation.json")
        assert set(document["error"]["alpha_h"]) == {"0.1", "0.5", "2.0", "10.0"}
        assert document["fit_percent"]["alpha_h"] > 50

    @pytest.mark.parametrize(
        ("verdict", "k_oh"),
        [("no_gap", None), ("parameters_only", 0.0151), ("none_of_these", 0.0151)],
    )
    def test_without_a_cause_nothing_is_added(self, diagnosed, lab, verdict, k_oh):
        diagnosed(diagnosis(verdict=verdict), verdict)
        content = corrected(lab, verdict)
        assert not content.get("effects")
        nominal = yaml.safe_load((config_folder() / "parameters/bench.yaml").read_text("utf-8"))
        expected = k_oh or nominal["parameters"]["k_oh"]["value"]
        assert content["parameters"]["k_oh"]["value"] == expected

    @pytest.mark.parametrize(
        ("answer", "added", "told"),
        [
            ({"verdict": "undecided"}, [FRICTION], "undecided: this is the likeliest cause"),
            (
                {"causes": (Cause(effects=("yaw_disturbance",), probability=0.9),)},
                [],
                "yaw_disturbance was not fitted",
            ),
        ],
    )
    def test_the_likeliest_that_was_fitted_is_added(self, diagnosed, lab, answer, added, told):
        out = told.split()[0]
        diagnosed(diagnosis(**answer), out)
        assert list(corrected(lab, out).get("effects") or ()) == added
        text = (lab / out / "corrected_model.yaml").read_text(encoding="utf-8")
        assert told in text.splitlines()[1]

    def test_the_refit_has_its_own_parameters(self, diagnosed, lab):
        diagnosed(diagnosis(), "refit")
        for name, value in (("refit_model", 1.78e-5), ("corrected_model", 1.79e-5)):
            content = corrected(lab, "refit", name)
            assert content["parameters"]["k_fvp"]["value"] == value
            assert bool(content.get("effects")) == (name == "corrected_model")

    def test_a_recording_may_be_called_by_a_number(self, diagnosed, trms, lab):
        (lab / "7.csv").write_bytes((lab / "rig.csv").read_bytes())
        diagnosed(diagnosis(parameters={}), "number", real="7.csv")
        runs_with(trms, "number")


class TestResume:
    @pytest.fixture
    def states(self, pipeline) -> list[object]:
        """The states that a pipeline is begun with which is interrupted when it begins anew."""
        begun: list[object] = []

        def diagnose(problem: GapProblem, progress: Any) -> DiagnosisResult:
            begun.append(progress.saved())
            if begun[-1] is None:
                progress.save({"refit": [0.1, 2.0]})
                raise KeyboardInterrupt
            return diagnosis()

        pipeline(diagnose)
        return begun

    def test_goes_on_after_an_interruption(self, trms, refused, lab, states):
        done = trms("diagnose", "real=rig.csv", "page=false", "out=stopped", code=130)
        assert "diagnose resume=stopped" in done.stderr
        assert not (lab / "stopped" / "diagnosis.json").exists()
        refused("diagnose", "resume=stopped", "seed=4", words="seed=4 given")
        trms("diagnose", "resume=stopped")
        assert states == [None, {"refit": [0.1, 2.0]}]
        assert (lab / "stopped" / "diagnosis.json").is_file()
        refused("diagnose", "resume=stopped", words="is finished")

    def test_refuses_another_recording_under_the_name(self, trms, lab, states):
        rows = (lab / "rig.csv").read_text(encoding="utf-8").splitlines()
        (lab / "changing.csv").write_text("\n".join(rows), encoding="utf-8")
        trms("diagnose", "real=changing.csv", "out=changed", code=130)
        (lab / "changing.csv").write_text("\n".join(rows[:-100]), encoding="utf-8")
        assert "has changed since" in trms("diagnose", "resume=changed", code=2).stderr


def rewritten(lab: Path, name: str, change: Callable[[pd.DataFrame], pd.DataFrame]) -> str:
    """The recording with its columns changed, under another name."""
    table = pd.read_csv(lab / "rig.csv", comment="#")
    heads = list(table)
    table.columns = [head.partition("[")[0] for head in heads]
    change(table).to_csv(lab / name, header=heads, index=False)
    return name


class TestBadInput:
    """A sentence, and exit code 2, before anything is fitted."""

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            (("real=nowhere.csv",), "nowhere.csv"),
            (("real=rig.csv", "effort=fast"), "quick"),
            (("real=rig.csv", "candidates=[yaw_coulomb]"), "did you mean yaw_coulomb_friction"),
            (("real=rig.csv", "block=0"), "block"),
            (("real=rig.csv", "sealed_share=1.5"), "sealed_share"),
            (("real=rig.csv", "seed=-1"), "seed"),
            (("real=rig.csv", "model=quanser_aero"), "is quanser_aero the model of this rig?"),
            (("real=rig.csv", "model=narx_2dof"), "only steps from sample to sample"),
            (("real=rig.csv", "speed=3"), "speed"),
            ((), "real"),
        ],
    )
    def test_of_the_command_line(self, found, refused, words, says):
        asked = found(diagnosis())
        refused("diagnose", *words, words=says)
        assert not asked

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            (lambda t: t.assign(u_v=t.u_h, u_h=t.u_v), "u_v and u_h are in each other's place"),
            (lambda t: t.assign(alpha_h=0.1), "alpha_h is constant"),
            (lambda t: t[:600], "blocks"),
        ],
    )
    def test_of_the_recording(self, found, refused, lab, change, says):
        asked = found(diagnosis())
        name = rewritten(lab, f"{says.split()[-1]}.csv", change)
        refused("diagnose", f"real={name}", words=says)
        assert not asked

    def test_unlike_rates_are_named(self, found, refused, lab):
        found(diagnosis())
        name = rewritten(lab, "thin.csv", lambda table: table[::2])
        refused("diagnose", f"real=[rig.csv,{name}]", words="data.resample=0.04")

    def test_what_is_a_matter_of_degree_stands_in_the_file(self, found, trms, lab):
        found(diagnosis(warnings=()))
        name = rewritten(
            lab, "gapped.csv", lambda t: t.assign(alpha_h=t.alpha_h.where(t.index >= 1600))
        )
        done = trms("diagnose", f"real={name}", "page=false", "out=degree")
        document = read(lab / "degree" / "diagnosis.json")
        assert any("alpha_h is missing" in warning for warning in document["warnings"])
        assert "alpha_h is missing" in done.stdout


#: A diagnosis by the pipeline itself, short enough for a test.
WHOLE = (
    *("diagnose", "real=rig.csv", "effort=quick", "block=5"),
    f"candidates=[{FRICTION},main_input_delay,pitch_coulomb_friction]",
)


@pytest.fixture(scope="module")
def done(trms) -> Done:
    """What the pipeline itself leaves."""
    done: Done = trms(*WHOLE, "out=whole")
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.slow
class TestWhole:
    """With the pipeline itself, on the rig whose yaw has friction."""

    def test_names_the_effect_and_its_size(self, done, lab):
        document = read(lab / "whole" / "diagnosis.json")
        assert document["verdict"] == "effect"
        assert document["causes"][0]["effects"] == [FRICTION]
        size = document["causes"][0]["parameters"][f"{FRICTION}.torque"]
        assert abs(size["value"] - 0.005) < 0.0005
        assert sum(cause["probability"] for cause in document["causes"]) == pytest.approx(1.0)
        assert document["where"][0]["location"] == "yaw_moment"
        assert document["sentence"] in " ".join(done.stdout.split())

    def test_the_corrected_model_is_better_than_the_refit(self, done, trms, lab):
        errors = {}
        for name in ("refit_model", "corrected_model"):
            trms(
                "validate", "real=rig.csv", f"model=whole/{name}.yaml", "data.start=30",
                "page=false", f"out=whole-{name}",
            )  # fmt: skip
            errors[name] = read(lab / f"whole-{name}" / "validation.json")["error"]["alpha_h"]
        assert errors["corrected_model"]["2.0"] < 0.3 * errors["refit_model"]["2.0"]

    def test_stopped_and_resumed_it_says_the_same(self, done, trms, lab, monkeypatch):
        from trms_cli.reporting.progress import DiagnoseProgress

        told = DiagnoseProgress.update

        def stopping(self: DiagnoseProgress, fraction: float, cost: float, message: str) -> bool:
            return told(self, fraction, cost, message) and not message.startswith("where")

        monkeypatch.setattr(DiagnoseProgress, "update", stopping)
        trms(*WHOLE, "out=parted", code=130)
        monkeypatch.setattr(DiagnoseProgress, "update", told)
        trms("diagnose", "resume=parted")
        whole, parted = (read(lab / f / "diagnosis.json") for f in ("whole", "parted"))
        for document in (whole, parted):
            del document["seconds"], document["control"]  # which names the folder
        assert parted == whole

    def test_a_quick_one_leaves_out_what_takes_long(self, done, lab):
        document = read(lab / "whole" / "diagnosis.json")
        assert document["worth"] is None
        assert document["next_experiment"] is None
        page = (lab / "whole" / "report.html").read_text(encoding="utf-8")
        assert "<table" in page
        assert "data:image" not in page


@pytest.mark.slow
def test_what_changed_is_told_against_recordings_of_a_known_state(trms, lab):
    """The same rig before its yaw had friction, driven by other commands."""
    for seed in ("7", "8"):
        other = ("controller.u_v.seed=3", f"controller.u_h.seed={seed}")
        trms("run", *RECORD, *EXCITED, *other, f"out=before{seed}")
        trms("export", f"before{seed}/run.mcap", "--out", f"before{seed}.csv")
    known = "against=[before7.csv,before8.csv]"
    few = f"candidates=[{FRICTION},main_input_delay,yaw_quantisation]"
    done = trms("diagnose", "real=rig.csv", known, few, "out=changed")
    document = read(lab / "changed" / "diagnosis.json")
    assert document["verdict"] == "effect"
    assert document["causes"][0]["effects"] == [FRICTION]
    assert document["causes"][0]["parameters"][f"{FRICTION}.torque"]["value"] == pytest.approx(
        0.005, rel=0.15
    )
    assert [len(document[key]) for key in ("recordings", "against")] == [1, 2]
    assert document["shrink"]["all"]["2.0"]["fraction"] > 0.5
    assert {"main_input_delay", "yaw_quantisation"} <= {r["effect"] for r in document["rejected"]}
    assert all(row["se"] is None for row in document["race"])
    assert document["sentence"] in " ".join(done.stdout.split())
    assert FRICTION in corrected(lab, "changed")["effects"]
    runs_with(trms, "changed")
    # a third recording of the state before has not changed
    trms("diagnose", "real=before8.csv", "against=before7.csv", few, "out=same", "page=false")
    assert read(lab / "same" / "diagnosis.json")["verdict"] == "no_change"


def test_a_recording_is_not_compared_with_itself(lab):
    done = in_process(lab, "diagnose", "real=rig.csv", "against=rig.csv", "out=itself", code=2)
    assert "among the recordings in question" in done.said
    done = in_process(lab, "diagnose", "real=rig.csv", "against=absent.csv", "out=itself", code=2)
    assert "absent.csv" in done.said
