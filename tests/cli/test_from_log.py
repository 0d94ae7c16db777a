"""From a recording back to the rig: ``trms run --from LOG`` with another controller or model."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from trms_cli.recordings.log_reader import read_log

RIG = ("plant.prior_seed=3", "effect=yaw_coulomb_friction", "picture=false")
OPEN = (
    "controller=open_loop",
    "observer=full_state",
    "signal@controller.u_v=multilevel",
    "controller.u_v.amplitude=0.5",
    "controller.u_v.offset=0.9",
    "controller.u_h.amplitude=0.8",
    "sim.duration=26",
)
QUICK = ("sim.duration=1", "picture=false")


@pytest.fixture
def rig(trms, tmp_path: Path) -> Path:
    """The log of a simulated rig under commands that were played."""
    trms("run", *OPEN, *RIG, "out=rig")
    return tmp_path / "rig" / "run.mcap"


def config(log: Path) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load(read_log(log).config)
    return content


def next_lines(printed: str) -> list[list[str]]:
    """The words of each line to be typed next, without the program and the comment behind it."""
    lines = printed[printed.index("\nnext ") :].splitlines()
    typed = [line.removeprefix("next").partition("    # ")[0].strip() for line in lines]
    return [shlex.split(line)[1:] for line in typed if " run " in f" {line} " and line[0] != "#"]


class TestControllers:
    def test_a_controller_after_commands_that_were_played(self, rig, trms, tmp_path):
        done = trms("run", "--from", "rig/run.mcap", "controller=pid", *QUICK, "out=pid")
        told = " ".join(done.stderr.split())
        assert "left out, as typed for an option that is replaced: signal@controller.u_v" in told
        assert "the log followed no reference; now ref square" in told
        assert config(tmp_path / "pid" / "run.mcap")["plant"] == config(rig)["plant"]
        # what that left out is not typed in the new log, which is repeated as any other
        assert trms("run", "--from", "pid", "picture=false", "out=again").stderr == ""

    def test_commands_of_a_file(self, trms, tmp_path):
        (tmp_path / "commands.csv").write_text(
            "t[s],u_v[V],u_h[V]\n0,0.1,0\n1,0.2,0.1\n", encoding="utf-8"
        )
        played = ("controller=played", "controller.u_v.file=commands.csv")
        trms("run", *played, *QUICK, "out=rig")
        done = trms("run", "--from", "rig", "controller=pid", "picture=false", "out=pid")
        assert "left out" in done.stderr and "ref square for its 1 s" in done.stderr

    def test_a_sweep_leaves_out_what_one_of_its_controllers_has_not(self, rig, trms, tmp_path):
        words = ("-m", "controller=pid,lqr", *QUICK, "launcher.workers=0", "out=swept")
        trms("run", "--from", "rig", *words)
        plants = [config(tmp_path / "swept" / n / "run.mcap")["plant"] for n in "01"]
        assert plants == [config(rig)["plant"]] * 2

    def test_what_the_new_option_has_too_stays(self, trms, tmp_path):
        words = (
            "controller=newton_mpc",
            "controller.sample_time=0.04",
            "controller.max_iterations=4",
        )
        trms("run", *words, "ref.alpha_h.amplitude=0.3", *QUICK, "out=first")
        done = trms("run", "--from", "first", "controller=lqr", "ref=sine", "out=second")
        assert (
            "left out, as typed for an option that is replaced: controller.max_iter" in done.stderr
        )
        now = config(tmp_path / "second" / "run.mcap")
        assert (
            now["controller"]["sample_time"] == 0.04 and now["ref"]["alpha_h"]["amplitude"] == 0.3
        )

    def test_another_signal_at_the_same_place(self, rig, trms, tmp_path):
        trms("run", "--from", "rig", "signal@controller.u_h=constant", *QUICK, "out=held")
        controller = config(tmp_path / "held" / "run.mcap")["controller"]
        assert set(controller["u_h"]) == {"_target_", "offset"}
        assert controller["u_v"] == config(rig)["controller"]["u_v"]

    def test_effects_that_are_replaced_take_their_sizes_along(self, trms, tmp_path):
        size = "effect.yaw_coulomb_friction.torque=0.01"
        trms("run", *RIG, size, "controller=lqr", "sim.duration=1", "out=first")
        trms("run", "--from", "first", "effect=tail_dead_zone", "out=other")
        assert list(config(tmp_path / "other" / "run.mcap")["plant"]["effects"]) == [
            "tail_dead_zone"
        ]
        both = "effect=[yaw_coulomb_friction,tail_dead_zone]"
        trms("run", "--from", "first", both, "out=both")
        effects = config(tmp_path / "both" / "run.mcap")["plant"]["effects"]
        assert effects["yaw_coulomb_friction"]["torque"] == 0.01

    @pytest.mark.parametrize(
        ("words", "told"),
        [
            (["controller=pdi"], "did you mean pid?"),
            (["model=nowhere"], "model has no option 'nowhere'"),
            (["model=nowhere/model.yaml"], "there is no file"),
            (["controller=pid", "controller.u_v.amplitude=1"], "there is no key 'u_v'"),
        ],
    )
    def test_what_is_wrong_is_told(self, rig, refused, words, told):
        refused("run", "--from", "rig", *words, words=told)


class TestModels:
    """``model=`` is what controller and observer believe; the rig is the log's."""

    @pytest.mark.parametrize(
        "words",
        [
            ["model=lagrangian"],
            ["model.parameters.k_g=0.1"],
            ["model=narx_2dof", "model@model.rig=newtonian_full"],
            ["model=newtonian_full", "plant.sensors.loss_probability=0"],
        ],
    )
    def test_the_rig_stays(self, rig, trms, tmp_path, words):
        closed = ("controller=lqr", "observer=ukf")
        trms("run", "--from", "rig", *closed, *words, *QUICK, "out=new")
        then, now = config(rig), config(tmp_path / "new" / "run.mcap")
        assert now["plant"] == then["plant"] and now["model"] != then["model"]
        # and in a repetition of that one as well
        trms("run", "--from", "new", "model=newtonian", *QUICK, "out=newer")
        assert config(tmp_path / "newer" / "run.mcap")["plant"] == then["plant"]

    def test_values_of_the_former_model_are_the_rigs_alone(self, trms, tmp_path):
        trms("run", "model.parameters.k_g=0.18", "controller=lqr", *QUICK, "out=first")
        done = trms("run", "--from", "first", "model=lagrangian", "out=second")
        assert "left out" in done.stderr and "model.parameters.k_g=0.18" in done.stderr
        now = config(tmp_path / "second" / "run.mcap")
        assert now["model"]["parameters"] == {}
        assert now["plant"] == config(tmp_path / "first" / "run.mcap")["plant"]
        assert now["plant"]["model"]["parameters"] == {"k_g": 0.18}
        # other sensors on the same rig
        trms("run", "--from", "second", "plant=ideal", "out=third")
        third = config(tmp_path / "third" / "run.mcap")["plant"]
        assert third["model"] == now["plant"]["model"]

    def test_the_equations_are_chosen_by_whoever_says_so(self, rig, trms, tmp_path):
        both = (
            "model=lagrangian",
            "model@plant.model=lagrangian",
            "controller=lqr",
            "observer=ukf",
        )
        trms("run", "--from", "rig", *both, *QUICK, "out=clone")
        now = config(tmp_path / "clone" / "run.mcap")
        assert now["plant"]["model"] == now["model"]

    def test_the_header_and_the_log_tell_which_model_and_which_plant(self, rig, trms, tmp_path):
        words = ("controller=lqr", "observer=ukf", "model=lagrangian")
        done = trms("run", "--from", "rig", *words, *QUICK, "out=new")
        plant = "simulated (newtonian + yaw_coulomb_friction, prior_seed 3)"
        assert f"model lagrangian · plant {plant}" in " ".join(done.stdout.split())
        run = read_log(tmp_path / "new" / "run.mcap").run
        assert (run["model"], run["plant"]) == ("lagrangian", plant)


class TestWhatIsAdvised:
    FIT = ("identify", "free=[k_oh]", "picture=false", "out=fit")

    def test_what_a_run_advises_runs(self, rig, trms, tmp_path):
        done = trms("run", *OPEN, *RIG, "out=other")
        (line,) = next_lines(done.stdout)
        assert line == ["run", "--from", "other/run.mcap", "controller=pid"]
        trms(*line, *QUICK, "out=pid")

    def test_a_fit_drives_the_rig_that_was_recorded(self, rig, trms, tmp_path):
        done = trms(*self.FIT, "real=rig")
        (line,) = next_lines(done.stdout)
        assert line[:3] == ["run", "--from", "rig/run.mcap"]
        # the log's observer read the true state, which no fitted model stands for
        assert {"controller=newton_mpc", "model=fit/model.yaml", "observer=ukf"} <= set(line)
        trms(*line, *QUICK, "out=controlled")
        now = config(tmp_path / "controlled" / "run.mcap")
        assert now["plant"] == config(rig)["plant"]
        assert now["model"]["path"] == "fit/model.yaml"

    def test_of_a_recording_that_is_no_log_a_clone_is_called_one(self, rig, trms, tmp_path):
        trms("export", "rig/run.mcap", "--out", "rig.csv")
        done = trms(*self.FIT, "real=rig.csv")
        clone, real = next_lines(done.stdout)
        assert "simulated clone of the fitted model, not on the rig" in done.stdout
        assert clone == ["run", "model=fit/model.yaml", "controller=newton_mpc"]
        trms(*clone, *QUICK, "out=clone")
        assert real[1] == "plant=NAME" and "by the plant option" not in real
        assert "the plant option that drives it" in " ".join(done.stdout.split())

    def test_a_model_of_one_axis_cannot_drive_both(self, rig, trms):
        words = ("model=newtonian_vertical", "free=[k_ov]", "picture=false", "out=fit")
        done = trms("identify", "real=rig", *words)
        (line,) = next_lines(done.stdout)
        assert line == ["run", "model=fit/model.yaml", "controller=newton_mpc"]

    def test_an_experiment_on_the_recorded_rig_has_nothing_of_the_logs_commands(
        self, rig, trms, tmp_path
    ):
        from trms_cli.composition.composer import compose
        from trms_cli.core.plugins import build
        from trms_cli.library.tasks.control_advice import on_recorded_rig

        composition = compose([])
        model = build(composition.config["model"], "model")
        words = "controller=open_loop signal@controller.u_v=square controller.u_v.amplitude=0.3"
        command = f"trms run model=newtonian {words} sim.duration=1"
        line = shlex.split(on_recorded_rig(command, model, [str(rig)], composition))
        trms(*line[1:], "picture=false", "out=next")
        now, anew = config(tmp_path / "next" / "run.mcap"), compose(shlex.split(words)).config
        assert now["controller"] == anew["controller"] and now["seed"] == 1
        assert now["plant"] == config(rig)["plant"]
        assert on_recorded_rig(command, model, [str(tmp_path / "rig.csv")], composition) == command


def test_keys_that_a_log_did_not_have_yet_keep_nothing_out(trms, tmp_path):
    """A log of an earlier version, whose configuration lacks what the program got since."""
    from trms_cli.recordings.run_log import RunLog
    from trms_cli.recordings.topics import CONFIG_ATTACHMENT, Field, Topic

    trms("run", "controller=lqr", "plant.parameters.k_g=0.1", *QUICK, "out=first")
    log = read_log(tmp_path / "first" / "run.mcap")
    logged = yaml.safe_load(log.config)

    def rewritten(name: str) -> str:
        text = yaml.dump(logged, sort_keys=False).encode()
        topic = Topic("/command", (Field("u_v", "V"),))
        files = {CONFIG_ATTACHMENT: ("application/yaml", text)}
        RunLog(tmp_path / name, [topic], dict(log.run), files).close("completed")
        return name

    del logged["sim"]["scene_every"]
    old = rewritten("old.mcap")
    told = trms("run", "--from", old, "controller=pid", *QUICK, "out=second").stderr
    assert "newer than that run, and at their default: sim.scene_every" in told
    # what was typed is no default of the program
    logged["plant"]["parameters"] = {}
    other = rewritten("other.mcap")
    told = trms("run", "--from", other, "controller=pid", code=2).said
    assert "option files have changed" in told and re.search(r"plant\.parameters", told)
    assert json.loads(log.run["choices"])["controller"] == "lqr"
