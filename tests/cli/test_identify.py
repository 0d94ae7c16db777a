"""``trms identify`` as a person types it."""

import functools
import json
import re
import signal
from pathlib import Path

import pytest
import yaml

from tests.program import in_process, wait_for
from trms_cli.core import wording
from trms_cli.models.newtonian import Newtonian

FIT = ("identify", "real=rig", "model=newtonian_vertical", "free=[k_fvp,k_ov,J_mr]")
SMALL = ("method=genetic", "method.individuals=8", "method.generations=4", "picture=false")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the recording ``rig`` of a rig whose parameters were drawn."""
    folder = tmp_path_factory.mktemp("lab")
    in_process(
        folder,
        *("run", "model=newtonian_vertical", "controller=open_loop", "observer=full_state"),
        *("plant.prior_seed=3", "sim.duration=24", "signal@controller.u_v=multilevel"),
        *("controller.u_v.amplitude=0.6", "controller.u_v.offset=0.9"),
        *("picture=false", "out=rig"),
    )
    return folder


@pytest.fixture(scope="module")
def trms(lab: Path):
    return functools.partial(in_process, lab)


def read(folder: Path) -> dict:
    document: dict = json.loads((folder / "identification.json").read_text(encoding="utf-8"))
    return document


@pytest.fixture(scope="module")
def fitted(trms, lab) -> tuple[str, dict]:
    """What is printed of a fit, and its document."""
    done = trms(*FIT[:3], "out=fit")
    return done.stdout, read(lab / "fit")


class TestFit:
    def test_leaves_model_figures_and_page(self, fitted, lab):
        _, document = fitted
        assert document["schema"] == "trms.identification/1"
        assert document["outcome"] == "converged"
        assert {r["part"] for r in document["recordings"]} == {"fit", "held_out"}
        for name in ("model.yaml", "free_runs.png", "parameters.png", "convergence.png"):
            assert (lab / "fit" / name).stat().st_size > 1000
        page = (lab / "fit" / "identification.html").read_text(encoding="utf-8")
        assert "k_ov" in page and 'src="http' not in page

    def test_finds_the_rig_within_what_it_reports(self, fitted):
        true = Newtonian(freedom="vertical").parameters.draw(3)
        _, document = fitted
        for name, p in document["parameters"].items():
            assert abs(p["value"] - true[name].value) < 4 * p["sd"]
        errors = document["errors"]["held_out"]
        for name, after in errors["after"].items():
            assert after["rmse"] < errors["before"][name]["rmse"]
        assert errors["after"]["alpha_v"]["rmse"] < 0.001

    def test_prints_what_it_writes(self, fitted):
        printed, document = fitted
        for name, p in document["parameters"].items():
            line = next(line for line in printed.splitlines() if line.split()[:1] == [name])
            shown = (wording.number(p["value"], sd=p["sd"]), wording.number(p["sd"]))
            assert all(figure in line for figure in shown)
        rmse = document["errors"]["held_out"]["after"]["alpha_v"]["rmse"]
        assert f"{1e3 * rmse:.3g}" in printed
        assert " validate model=fit/model.yaml real=rig/run.mcap" in printed

    def test_the_model_runs(self, fitted, trms, lab):
        _, document = fitted
        content = yaml.safe_load((lab / "fit" / "model.yaml").read_text(encoding="utf-8"))
        value = document["parameters"]["k_ov"]["value"]
        assert content["parameters"]["k_ov"]["value"] == value
        assert document["recordings"][0]["sha256"][:16] in content["source"]
        trms("run", "model=fit/model.yaml", "sim.duration=1", "picture=false", "out=ran")

    def test_what_has_no_part_is_left_out_and_said(self, trms):
        done = trms("identify", "real=rig", "model=newtonian_vertical", *SMALL, "out=all")
        assert "no part in the equations, so not fitted: k_uh, J_tr" in done.stdout
        assert "next" in done.stdout and "resume=all method.generations=8" in done.stdout

    def test_an_effect_s_size_is_fitted(self, trms, lab):
        size = "pitch_coulomb_friction.torque"
        trms(
            "identify", "real=rig", "model=newtonian_vertical", "effect=pitch_coulomb_friction",
            f"free=[k_ov,{size}]", f"priors.{size}.mean=0.001", f"priors.{size}.sd=0.001",
            f"bounds.{size}=[0,0.01]", *SMALL, "out=effect",
        )  # fmt: skip
        content = yaml.safe_load((lab / "effect" / "model.yaml").read_text(encoding="utf-8"))
        fitted_size = read(lab / "effect")["parameters"][size]["value"]
        assert content["effects"]["pitch_coulomb_friction"]["torque"] == fitted_size

    def test_driven_by_the_measured_rotor(self, trms, lab):
        done = trms(*FIT[:3], "free=[k_fvp,k_ov]", "driven=omega_v", *SMALL, "out=driven")
        assert list(read(lab / "driven")["errors"]["fit"]["after"]) == ["alpha_v"]
        assert "driven=[omega_v]" in done.stdout

    def test_a_sweep_prints_a_line_a_fit(self, trms):
        done = trms(*FIT, *SMALL, "-m", "seed=1,2", "launcher.workers=0", "out=sweep")
        lines = [line for line in done.stdout.splitlines() if "RMSE" in line]
        assert len(lines) == 2 and "seed=2" in lines[1]


class TestInterruption:
    @pytest.mark.slow
    def test_a_stopped_search_writes_its_best_and_goes_on_to_the_same_end(self, trms, started, lab):
        words = [*FIT, "method=genetic", "method.individuals=8", "picture=false"]
        trms(*words, "method.generations=40", "out=whole")
        process = started(*words, "method.generations=5000", "out=stopped", folder=lab)
        state = lab / "stopped" / "fit-state.json"
        wait_for(state.exists)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
        assert process.returncode == 130, err
        assert "interrupted: the best so far is kept" in out
        assert "resume=stopped" in out and (lab / "stopped" / "model.yaml").is_file()
        assert "stopping at the best so far" in err
        done = len(json.loads(state.read_text(encoding="utf-8"))["generations"])
        assert done < 5000
        end = max(40, done)
        trms("identify", "resume=stopped", f"method.generations={end}")
        if end == 40:
            assert read(lab / "stopped")["parameters"] == read(lab / "whole")["parameters"]

    @pytest.mark.parametrize(
        ("word", "told"),
        [
            ("method.individuals=9", "individuals was 8 and is 9 now"),
            *((w, "for all else fit anew") for w in ("seed=4", "real=rig", "method=narx")),
            ("model=lagrangian", "for all else fit anew"),
        ],
    )
    def test_another_fit_is_refused_and_changes_nothing(self, trms, lab, word, told):
        if not (lab / "kept").is_dir():
            trms(*FIT, *SMALL, "out=kept")
        files = [lab / "kept" / name for name in ("request.json", "model.yaml")]
        before = [file.read_bytes() for file in files]
        assert told in trms("identify", "resume=kept", word, code=2).said
        assert [file.read_bytes() for file in files] == before

    @pytest.mark.parametrize(
        ("folder", "words"),
        [("nowhere", "there is no folder"), ("rig", "not the folder of a fit"), ("", "no folder")],
    )
    def test_what_cannot_go_on_is_told(self, refused, folder, words):
        refused("identify", f"resume={folder}", words=words)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "real must be given"),
        (["real=none.csv"], "there is no such file"),
        (["real=rig", "free=[k_foo]"], "did you mean"),
        (["real=rig", "free=[k_fhp]"], "has no part in the equations"),
        (["real=rig", "bounds.k_ov=[1]"], "[lower, upper]"),
        (["real=rig", "priors.k_ov=5"], "in quotes"),
        (["real=rig", "driven=alpha_x"], "in driven"),
        (["real=rig", "validation.share=2"], "expected a number >= 0 and < 1"),
        (["real=rig", "validation.real=rig"], "is fitted as well"),
        (["real=rig", "model.currents=dynamic"], "in model.currents"),
        (["real=rig", "effect=yaw_coulomb_friction"], "has no yaw axis"),
        (["real=rig", "windows.length=-1"], "expected a number > 0"),
        (["real=rig", "data.end=0.5"], "record"),
        (["real=rig", "method=narx", "driven=[omega_v]"], "leave driven out"),
        (["real=rig", "method=nnoe", "free=[k_ov]"], "leave free out"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_told_with_what_to_do(refused, words, told):
    refused("identify", "model=newtonian_vertical", *words, "out=never", words=told)


@pytest.mark.parametrize("method", ["multiple_shooting", "genetic"])
def test_a_rig_that_cannot_be_simulated_is_an_error_and_leaves_no_model(trms, lab, method):
    out = f"runaway_{method}"
    small = SMALL[1:3] if method == "genetic" else ()
    rotor = "model.parameters={J_mr: 1e-9}"  # far too light for any integration step
    done = trms(*FIT[:3], rotor, "free=[k_ov]", f"method={method}", *small, f"out={out}", code=1)
    assert "no start could be simulated" in done.stderr
    assert not (lab / out / "model.yaml").exists()


class TestDoubts:
    """What a fit says of itself when it should not be believed."""

    def test_a_search_that_did_not_settle(self, trms, lab):
        done = trms(*FIT, *SMALL, "out=unsettled")
        assert "the search had not settled" in done.stdout
        settled = trms(*FIT, "picture=false", "out=settled")
        assert "had not settled" not in settled.stdout

    def test_a_fit_that_is_worse_than_none(self, trms, lab):
        held = ("free=[k_ov]", "bounds.k_ov=[0.02,0.03]", "priors.k_ov={mean: 0.025, sd: 0.001}")
        done = trms(*FIT[:3], *held, "picture=false", "out=worse")
        assert re.search(r"^\? worse than before .*: pitch", done.stdout, re.MULTILINE)

    @pytest.mark.parametrize(
        ("words", "start"), [(("data.start=2",), r"data\.start=2"), ((), r"data\.start=1[0-9]")]
    )
    def test_the_next_command_judges_on_what_was_held_out(self, trms, words, start):
        done = trms(*FIT, *words, "picture=false", f"out=next{len(words)}")
        (command,) = re.findall(r"(validate model=.*)", done.stdout)
        assert re.search(start, command)
