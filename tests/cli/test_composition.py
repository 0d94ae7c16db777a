"""Composing an experiment from the command line: what works, and what is answered and how."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import yaml

from trms_cli.commands.execution import execute
from trms_cli.composition.composer import Composition, compose
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build


def _shown(trms, *argv: str) -> dict:
    result = trms("run", *argv, "--cfg", "job")
    assert result.returncode == 0, result.stderr
    return yaml.safe_load(result.stdout)


class TestWhatWorks:
    """Overrides, own folders, and the forms that are ours."""

    def test_defaults_and_values(self, trms, own):
        config = _shown(trms, *own, "seed=3", "sim.duration=1e1")
        assert config["seed"] == 3
        assert config["sim"]["duration"] == 10.0
        assert config["sim"]["sample_time"] == 0.02
        assert config["controller"]["gain"] == 1.5
        assert config["effect"] == {}

    def test_one_screen_of_plain_yaml_and_nothing_on_disk(self, trms, own, tmp_path):
        before = sorted(tmp_path.rglob("*"))
        _shown(trms, *own)
        assert sorted(tmp_path.rglob("*")) == before

    @pytest.mark.parametrize("choice", ["effect=late", "effect=[late]"])
    def test_one_effect(self, trms, own, choice):
        assert set(_shown(trms, *own, choice)["effect"]) == {"late"}

    def test_a_sweep_over_lists_and_single_names(self, trms, own):
        result = trms("run", *own, "-m", "effect=[],late,[late,sticky]", "--cfg", "job")
        assert result.returncode == 0, result.stderr
        assert yaml.safe_load(result.stdout)["effect"] == {}

    def test_several_effects_with_their_sizes(self, trms, own):
        effects = _shown(trms, *own, "effect=[sticky,late]", "effect.sticky.gain=0.3")["effect"]
        assert list(effects) == ["sticky", "late"]
        assert effects["sticky"]["gain"] == 0.3

    def test_open_mappings_need_no_plus(self, trms, own):
        config = _shown(trms, *own, "plant.parameters.k_g=0.05", "model.parameters.k_g=0.1")
        assert config["plant"]["parameters"] == {"k_g": 0.05}
        assert config["model"]["parameters"] == {"k_g": 0.1}

    @pytest.mark.parametrize(
        "typed", ["controller.parameters={a: 2.0}", "effect=late", "effect.late.gain=1"]
    )
    def test_open_mappings_beside_other_overrides(self, trms, own, typed):
        config = _shown(trms, *own, "effect=late", typed, "controller.parameters.b=1.0")
        assert config["controller"]["parameters"]["b"] == 1.0

    def test_an_experiment_chooses_and_sets(self, trms, own):
        assert _shown(trms, *own, "experiment=short")["sim"]["duration"] == 3.0

    def test_a_nested_choice(self, trms, own):
        choices = [word for word in own if word != "ref=own"]
        config = _shown(trms, *choices, "ref=square", "signal@ref.alpha_v=sine")
        assert config["ref"]["alpha_v"]["_target_"].endswith("Sine")

    def test_a_nested_choice_drops_what_was_set_for_another(self, trms, own):
        choices = [word for word in own if word != "ref=own"]
        ref = _shown(trms, *choices, "ref=square", "signal@ref.alpha_v=constant")["ref"]
        assert ref["alpha_v"].keys() == {"_target_", "offset"}
        assert ref["alpha_h"]["amplitude"] == 0.5
        assert build(ref, "ref").alpha_v.offset == 0.0

    def test_a_nested_choice_keeps_what_it_knows_and_what_was_typed(self, trms, own):
        choices = [*(word for word in own if word != "ref=own"), "ref=square"]
        sine = _shown(trms, *choices, "signal@ref.alpha_h=sine")["ref"]["alpha_h"]
        assert sine["amplitude"] == 0.5
        typed = _shown(trms, *choices, "signal@ref.alpha_v=constant", "ref.alpha_v.amplitude=0.3")[
            "ref"
        ]
        with pytest.raises(ConfigurationError, match="unknown key 'amplitude'"):
            build(typed, "ref")

    def test_a_nested_choice_needs_no_file_of_the_one_it_replaces(self, trms, own):
        choices = [*(word for word in own if word != "ref=own"), "ref=from_csv"]
        words = ["signal@ref.alpha_h=constant", "ref.alpha_v.file=r.csv"]
        ref = _shown(trms, *choices, *words)["ref"]
        assert "file" not in ref["alpha_h"] and ref["alpha_v"]["file"] == "r.csv"

    def test_a_sweep_drops_what_was_set_for_another(self, trms, own):
        words = ["-m", "ref=square", "signal@ref.alpha_v=constant,sine", "sim.duration=0.2"]
        result = trms("run", *words, "picture=false", "out=o")
        assert result.returncode == 0, result.stderr

    def test_paths_need_no_quotes(self, trms, own):
        assert _shown(trms, *own, "out=runs/a=b (1), c")["out"] == "runs/a=b (1), c"

    def test_the_last_of_two_choices_counts(self, trms, own):
        assert _shown(trms, *own, "ref=square", "ref=own", "seed=1", "seed=2")["seed"] == 2

    def test_two_folders(self, trms, own, tmp_path):
        other = tmp_path / "other" / "controller" / "theirs.yaml"
        other.parent.mkdir(parents=True)
        other.write_text("# theirs\n_target_: nowhere.Theirs\n")
        words = [word for word in own if word != "controller=own"]
        config = _shown(trms, *words, "--config-dir", str(other.parent.parent), "controller=theirs")
        assert config["controller"]["_target_"] == "nowhere.Theirs"

    def test_an_own_option_hides_a_built_in_namesake(self, trms, own, lab):
        (lab / "model" / "newtonian.yaml").write_text("# mine\n_target_: own_lab_plugins.Own\n")
        words = [word for word in own if word != "model=own"]
        assert _shown(trms, *words)["model"]["_target_"] == "own_lab_plugins.Own"


class TestInThisProcess:
    """`compose` as commands use it."""

    def test_what_it_tells(self, own):
        composition = compose([*own, "effect=late", "seed=1"])
        assert composition.choices["controller"] == "own"
        assert composition.choices["effect"] == ["late"]
        assert composition.overrides[-2:] == ("effect=late", "seed=1")
        assert yaml.safe_load(composition.yaml) == composition.config

    def test_a_second_composition_equals_the_first(self, own):
        assert compose(own) == compose(own)

    def test_a_plugin_beside_the_folder_is_importable(self, own):
        plugin = build(compose([*own, "controller.gain=2.0"]).config["controller"], "controller")
        assert type(plugin).__name__ == "Own"
        assert plugin.gain == 2.0

    def test_a_misspelt_key_behind_a_plus_is_found_when_the_plugin_is_built(self, own):
        node = compose([*own, "+controller.gian=2.0"]).config["controller"]
        with pytest.raises(ConfigurationError, match=r"did you mean gain\?"):
            build(node, "controller")

    def test_the_working_directory_and_logging_stay(self, own):
        import logging

        before = os.getcwd(), list(logging.getLogger().handlers)
        compose(own)
        assert (os.getcwd(), list(logging.getLogger().handlers)) == before

    def test_a_model_from_a_file(self, own, lab, tmp_path):
        fitted = tmp_path / "a fit (1).yaml"
        fitted.write_text("k_g: 0.1\n")
        (lab / "model" / "from_file.yaml").write_text(
            "# a fitted model\n_target_: own_lab_plugins.FromFile\npath: ???  # its file\n"
        )
        words = [word for word in own if word != "model=own"]
        composition = compose([*words, f"model={fitted}"])
        assert composition.choices["model"] == "from_file"
        assert composition.config["model"]["path"] == str(fitted)

    def test_a_model_file_that_is_not_there(self, own, lab):
        (lab / "model" / "from_file.yaml").write_text("# a\n_target_: a.B\npath: ???  # its file\n")
        with pytest.raises(ConfigurationError, match=r"there is no file 'nowhere\.yaml'"):
            compose([*own, "model=nowhere.yaml"])

    def test_the_exit_code_is_the_task_s(self, own):
        assert execute(own, "run", lambda composition: 7) == 7

    def test_a_folder_is_new_or_empty(self, own, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        composition = compose(own)
        first, second = composition.folder("run"), composition.folder("run")
        assert first != second
        assert first.is_dir()
        assert first.parent.parent == Path("outputs")
        (first / "log").touch()
        with pytest.raises(Exception, match="not empty"):
            compose([*own, f"out={first}"]).folder("run")


BAD_INPUT = [
    # typed, words that the one screen must hold
    ("contoller=pid", "contoller", "did you mean controller?"),
    ("+contoller=pid", "contoller", "did you mean controller?"),
    ("++foo.bar=1", "foo", "allowed: controller"),
    ("controller=onw", "controller has no option 'onw'", "did you mean own?"),
    ("controller=", "controller= names nothing", "allowed:"),
    ("controller=null", "null", "allowed:"),
    ("~controller", "cannot be left out"),
    ("controller=[own]", "[own]", "did you mean own?"),
    ("controller.horizn=3", "controller.horizn", "given: 3", "did you mean horizon?"),
    ("controller.weights.alpha_q=1", "controller.weights.alpha_q", "did you mean alpha_v?"),
    ("controller.weights={alpha_q: 1}", "controller.weights", "allowed: alpha_v"),
    ("controller.gain.x=1", "controller.gain", "single value"),
    ("sim.duratoin=3", "sim.duratoin", "given: 3", "did you mean duration?"),
    ("+sim.duratoin=3", "sim.duratoin", "given: 3", "did you mean duration?"),
    ("++sim.duratoin=3", "sim.duratoin", "given: 3", "did you mean duration?"),
    ("sim=3", "sim", "sim.duration=…"),
    ("~sim", "sim", "sim.duration=…"),
    ("seed.x=2", "seed is a single value"),
    ("seed=1,2", "alternatives", "add -m"),
    ("seed=[1", "cannot read 'seed=[1'", "KEY=VALUE"),
    ("seed='1", "cannot read", "KEY=VALUE"),
    ("own", "'own' is no override", "did you mean controller=own?"),
    ("=3", "names no key"),
    ("effect=[lat]", "effect has no option 'lat'", "did you mean late?"),
    ("effect=sticky,late", "alternatives", "'effect=[sticky,late]'"),
    ("effect.late.gain=1", "effect 'late' is not chosen", "'effect=[late]'"),
    ("controller=own.yaml", "takes a name", "own"),
    ("signal=sine", "signal@PLACE=OPTION"),
    ("signal@ref.alpha_v=sien", "signal has no option 'sien'", "did you mean sine?"),
    ("signal@ref.alpha_v=sine", "signal@ref.alpha_v", "nothing is chosen"),
    ("sgnal@ref.alpha_v=sine", "there is no group 'sgnal'", "did you mean signal?"),
    ("experiment=shrt", "experiment has no option 'shrt'", "did you mean short?"),
    ("hydra.run.dir=x", "hydra.run.dir", "are not taken"),
    ("--multrun", "unknown option '--multrun'", "did you mean --multirun?"),
    ("--config-dir=/nowhere/at/all", "does not exist"),
    ("--config-dir=.", "holds no group"),
    ("--config-dir=", "no folder given"),
    ("--cfg=hydra", "'hydra' cannot be shown", "--cfg job"),
]


@pytest.mark.parametrize("case", BAD_INPUT, ids=lambda case: case[0])
def test_bad_input_is_answered_on_one_screen(trms, own, tmp_path, case):
    (tmp_path / "empty").mkdir()
    typed, *expected = case
    typed = typed.replace("--config-dir=.", "--config-dir=empty")
    result = trms("run", *own, typed, "--cfg", "job")
    assert result.returncode == 2, result.stdout
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert len(result.stderr.splitlines()) <= 20
    message = " ".join(result.stderr.split())
    for words in expected:
        assert words in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: [1\nb: 2\n", ["own.yaml, line 3", "not valid YAML"]),
        ("a: ${nope.x}\n", ["controller.a", "nope.x"]),
        ("a: ???\n", ["controller.a must be given", "controller.a=…"]),
        ("defaults:\n  - /signal@s: nothing\n", ["signal has no option 'nothing'"]),
    ],
)
def test_a_broken_yaml_of_the_user_s(trms, own, lab, text, words):
    (lab / "controller" / "own.yaml").write_text(f"# broken\n{text}")
    result = trms("run", *own)
    assert result.returncode == 2
    for part in words:
        assert part in " ".join(result.stderr.split())


def test_an_experiment_with_a_key_that_is_not_there(trms, own, lab):
    (lab / "experiment" / "wrong.yaml").write_text("# @package _global_\n# wrong\nsmi: {a: 1}\n")
    result = trms("run", *own, "experiment=wrong")
    assert result.returncode == 2
    assert "did you mean sim?" in result.stderr


class TestSweep:
    """``-m``, its runs in this process; more in ``test_sweep.py``."""

    @staticmethod
    def task(composition: Composition) -> int:
        if composition.config["seed"] == 2:
            raise ConfigurationError("two is bad", where="seed", remedy="take three")
        if composition.config["seed"] == 3:
            raise ZeroDivisionError("oops")
        file = composition.folder("run") / "seen.yaml"
        file.write_text(composition.yaml, encoding="utf-8")
        return 0

    @staticmethod
    def status(folder: Path) -> dict:
        return yaml.safe_load((folder / "status.json").read_text(encoding="utf-8"))

    def test_each_job_has_its_numbered_folder_and_status(self, own, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        here = "launcher.workers=0"
        argv = [*own, "-m", "seed=1,2,3", "effect=late,sticky", "out=swept", here]
        assert execute(argv, "run", self.task) == 1
        states = [self.status(tmp_path / "swept" / str(job))["state"] for job in range(6)]
        assert states == ["done"] * 2 + ["failed"] * 4
        seen = yaml.safe_load((tmp_path / "swept" / "1" / "seen.yaml").read_text())
        assert list(seen["effect"]) == ["sticky"]
        assert seen["out"] == str(tmp_path / "swept" / "1")
        error = self.status(tmp_path / "swept" / "2")["error"]
        told = {"problem": "two is bad", "where": "seed", "remedy": "take three"}
        assert error == told | {"type": "ConfigurationError"}
        assert "ZeroDivisionError" in self.status(tmp_path / "swept" / "5")["error"]["trace"]
        output = capsys.readouterr()
        assert "2 of 6 runs done" in output.out
        assert output.out.count("two is bad") == 1 and "2×" in output.out
        assert not list(tmp_path.rglob(".hydra"))

    def test_the_configuration_of_the_first_job(self, trms, own):
        config = _shown(trms, *own, "-m", "seed=5,6", "effect=late,sticky")
        assert config["seed"] == 5
        assert set(config["effect"]) == {"late"}

    def test_all_done(self, own, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert execute([*own, "-m", "seed=1,4", "launcher.workers=0"], "run", self.task) == 0

    @pytest.mark.parametrize(
        ("words", "hint"),
        [
            (["seed=1,2", "controller.horizn=3"], r"did you mean horizon\?"),
            (["controller=own,onw"], r"did you mean own\?"),
            (["seed=1,4", "hydra/launcher=nope"], "hydra/launcher"),
            (["seed=interval(0,1)"], "range of numbers"),
        ],
    )
    def test_bad_input_starts_no_job(self, own, tmp_path, monkeypatch, words, hint):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ConfigurationError, match=hint):
            execute([*own, "-m", *words], "run", self.task)
        assert not list(tmp_path.rglob("status.json"))


def test_a_model_files_parameters_can_be_overridden(tmp_path: Path) -> None:
    file = tmp_path / "fit.yaml"
    file.write_text("name: fit\nmodel: newtonian\nparameters: {}\n")
    composition = compose([f"model={file}", "model.parameters.k_g=0.1"])
    assert composition.config["model"]["parameters"] == {"k_g": 0.1}


def test_the_rig_may_have_other_equations_than_the_model() -> None:
    composition = compose(["model@plant.model=newtonian_full"])
    assert composition.config["plant"]["model"]["currents"] == "dynamic"
    assert composition.config["model"]["currents"] == "quasi_static"
    assert composition.choices["model@plant.model"] == "newtonian_full"
