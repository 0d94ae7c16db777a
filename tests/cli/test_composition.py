"""Composing an experiment from the command line: what works, and what is answered and how."""

import functools
import json
import logging
import os
import shutil
from pathlib import Path

import pytest
import yaml

from tests.program import loaded_by
from trms_cli.cli import COMMANDS, load_command, main
from trms_cli.commands.execution import execute
from trms_cli.commands.plain_options import as_options
from trms_cli.composition.composer import compose
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build

LATE = {"_target_": "own_lab_plugins.Own", "gain": 0.1}
SINE = "trms_cli.references.sine.Sine"
CONSTANT = {"_target_": "trms_cli.references.constant.Constant", "offset": 0.0}
WHAT_WORKS = [
    # typed, values by their keys
    (["seed=3", "sim.duration=1e1"], {"seed": 3, "sim.duration": 10.0, "sim.sample_time": 0.02}),
    ([], {"controller.gain": 1.5, "effect": {}}),
    (["effect=late"], {"effect": {"late": LATE}}),
    (["effect=[late]"], {"effect": {"late": LATE}}),
    (
        ["effect=[sticky,late]", "effect.sticky.gain=0.3"],
        {"effect": {"sticky": LATE | {"gain": 0.3}, "late": LATE}},
    ),
    # the first run of a sweep
    (["-m", "seed=5,6", "effect=late,sticky"], {"seed": 5, "effect": {"late": LATE}}),
    (["-m", "effect=[],late,[late,sticky]"], {"effect": {}}),
    # open mappings need no plus, also beside other overrides
    (
        ["plant.parameters.k_g=0.05", "model.parameters.k_g=0.1"],
        {"plant.parameters": {"k_g": 0.05}, "model.parameters": {"k_g": 0.1}},
    ),
    *(
        (["effect=late", word, "controller.parameters.b=1.0"], {"controller.parameters.b": 1.0})
        for word in ("controller.parameters={a: 2.0}", "effect=late", "effect.late.gain=1")
    ),
    (["experiment=short"], {"sim.duration": 3.0}),
    # a nested choice keeps what it knows of what was set for another, and drops the rest
    (
        ["ref=square", "signal@ref.alpha_h=sine"],
        {"ref.alpha_h._target_": SINE, "ref.alpha_h.amplitude": 0.5},
    ),
    (
        ["ref=square", "signal@ref.alpha_v=constant"],
        {"ref.alpha_v": CONSTANT, "ref.alpha_h.amplitude": 0.5},
    ),
    # and needs no file of the one it replaces
    (
        ["ref=from_csv", "signal@ref.alpha_h=constant", "ref.alpha_v.file=r.csv"],
        {"ref.alpha_h": CONSTANT, "ref.alpha_v.file": "r.csv"},
    ),
    (["out=runs/a=b (1), c"], {"out": "runs/a=b (1), c"}),
    (["ref=square", "ref=own", "seed=1", "seed=2"], {"ref.gain": 1.5, "seed": 2}),
]


@pytest.fixture
def shown(trms, own):
    """The configuration that the program shows of one's own options with more."""
    return lambda *more: yaml.safe_load(trms("run", *own, *more, "--cfg", "job").stdout)


class TestWhatWorks:
    """Overrides, own folders, and the forms that are ours."""

    @pytest.mark.parametrize(("typed", "expected"), WHAT_WORKS, ids=lambda v: " ".join(v))
    def test_is_one_screen_of_yaml_and_nothing_on_disk(self, shown, tmp_path, typed, expected):
        before = sorted(tmp_path.rglob("*"))
        config = shown(*typed)
        for key, value in expected.items():
            found = functools.reduce(dict.__getitem__, key.split("."), config)
            assert json.dumps(found) == json.dumps(value)  # in this order
        assert sorted(tmp_path.rglob("*")) == before

    def test_a_nested_choice_keeps_what_was_typed(self, shown):
        constant = ("ref=square", "signal@ref.alpha_v=constant")
        assert build(shown(*constant)["ref"], "ref").alpha_v.offset == 0.0
        with pytest.raises(ConfigurationError, match="unknown key 'amplitude'"):
            build(shown(*constant, "ref.alpha_v.amplitude=0.3")["ref"], "ref")

    def test_a_sweep_drops_what_was_set_for_another(self, trms):
        words = ("ref=square", "signal@ref.alpha_v=constant,sine", "sim.duration=0.2")
        trms("run", "-m", *words, "launcher.workers=0", "picture=false", "out=o")

    def test_two_folders(self, shown, tmp_path):
        other = tmp_path / "other" / "controller" / "theirs.yaml"
        other.parent.mkdir(parents=True)
        other.write_text("# theirs\n_target_: nowhere.Theirs\n")
        config = shown("--config-dir", str(other.parent.parent), "controller=theirs")
        assert config["controller"]["_target_"] == "nowhere.Theirs"

    def test_an_own_option_hides_a_built_in_namesake(self, shown, lab):
        (lab / "model" / "newtonian.yaml").write_text("# mine\n_target_: own_lab_plugins.Own\n")
        assert shown("model=newtonian")["model"]["_target_"] == "own_lab_plugins.Own"


class TestInThisProcess:
    """`compose` as commands use it."""

    def test_what_it_tells_is_the_same_again_and_the_process_as_it_was(self, own):
        before = os.getcwd(), list(logging.getLogger().handlers)
        composition = compose([*own, "effect=late", "seed=1"])
        assert composition.choices["controller"] == "own"
        assert composition.choices["effect"] == ["late"]
        assert composition.overrides[-2:] == ("effect=late", "seed=1")
        assert yaml.safe_load(composition.yaml) == composition.config
        assert compose([*own, "effect=late", "seed=1"]) == composition
        assert (os.getcwd(), list(logging.getLogger().handlers)) == before
        assert execute(own, "run", lambda composition: 7) == 7

    def test_a_plugin_beside_the_folder_is_importable_and_its_keys_are_checked(self, own):
        plugin = build(compose([*own, "controller.gain=2.0"]).config["controller"], "controller")
        assert type(plugin).__name__ == "Own" and plugin.gain == 2.0
        node = compose([*own, "+controller.gian=2.0"]).config["controller"]
        with pytest.raises(ConfigurationError, match=r"did you mean gain\?"):
            build(node, "controller")

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
    ("hydra/launcher=basic", "hydra/launcher", "are not taken"),
    ("+hydra.x=1", "hydra.x", "are not taken"),
    ("--multrun", "unknown option '--multrun'", "did you mean --multirun?"),
    ("--config-dir=/nowhere/at/all", "does not exist"),
    ("--config-dir=.", "holds no group"),
    ("--config-dir=", "no folder given"),
    ("--cfg=hydra", "'hydra' cannot be shown", "--cfg job"),
]


@pytest.mark.parametrize("case", BAD_INPUT, ids=lambda case: case[0])
def test_bad_input_is_answered_on_one_screen(refused, own, tmp_path, case):
    (tmp_path / "empty").mkdir()
    typed, *words = case
    typed = typed.replace("--config-dir=.", "--config-dir=empty")
    refused("run", *own, typed, "--cfg", "job", words=words)


@pytest.mark.parametrize(
    ("choice", "text", "words"),
    [
        ("controller=own", "# mine\na: [1\nb: 2\n", ["own.yaml, line 3", "not valid YAML"]),
        ("controller=own", "a: ${nope.x}\n", ["controller.a", "nope.x"]),
        ("controller=own", "a: ???\n", ["controller.a must be given", "controller.a=…"]),
        ("controller=own", "defaults:\n  - /signal@s: none\n", ["signal has no option 'none'"]),
        ("experiment=short", "# @package _global_\nsmi: {a: 1}\n", ["did you mean sim?"]),
    ],
)
def test_a_broken_yaml_of_the_user_s(refused, own, lab, choice, text, words):
    (lab / f"{choice.replace('=', '/')}.yaml").write_text(text)
    refused("run", *own, choice, words=words)


def test_a_model_files_parameters_can_be_overridden_and_the_rig_may_have_other_equations(
    tmp_path: Path,
) -> None:
    file = tmp_path / "a fit (1).yaml"
    file.write_text("name: fit\nmodel: newtonian\nparameters: {}\n")
    composition = compose([f"model={file}", "model.parameters.k_g=0.1"])
    assert composition.config["model"]["parameters"] == {"k_g": 0.1}
    assert composition.config["model"]["path"] == str(file)
    composition = compose(["model@plant.model=newtonian_full"])
    assert composition.config["plant"]["model"]["currents"] == "dynamic"
    assert composition.config["model"]["currents"] == "quasi_static"
    assert composition.choices["model@plant.model"] == "newtonian_full"


@pytest.fixture
def fit(tmp_path, monkeypatch):
    """A folder as a fit leaves it, in the present folder."""
    folder = tmp_path / "fit"
    folder.mkdir()
    (folder / "model.yaml").write_text("model: newtonian\n", encoding="utf-8")
    (folder / "identification.json").write_text("{}", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.mark.parametrize(
    ("primary", "more"),
    [("run", []), ("excite", []), ("identify", ["real=a.csv"]), ("validate", ["real=a.csv"])],
)
def test_every_command_takes_the_folder_of_a_fit(fit, primary, more):
    for typed in ("fit", "fit/", "'fit'", str(fit), "fit/model.yaml"):
        composition = compose([f"model={typed}", *more], primary)
        assert composition.choices["model"] == "from_file"
        assert composition.config["model"]["path"].endswith("fit/model.yaml")
    fit.rename("newtonian")  # an option is not hidden by a folder
    assert compose(["model=newtonian", *more], primary).choices["model"] == "newtonian"


@pytest.mark.parametrize(
    ("typed", "problem", "remedy"),
    [
        ("fit/identification.json", "not a model file", "did you mean model=fit/model.yaml"),
        ("rig.csv", "not a model file", "a model's YAML"),
        ("empty", "no model.yaml in the folder", "trms identify"),
        ("fti", "no option 'fti'", ""),
        ("nowhere.yaml", r"there is no file 'nowhere\.yaml'", ""),
    ],
)
def test_what_is_no_model_is_told(fit, typed, problem, remedy):
    fit.with_name("empty").mkdir()
    with pytest.raises(ConfigurationError, match=problem) as caught:
        compose([f"model={typed}"])
    assert remedy in caught.value.remedy


#: What each composing command cannot do without.
NEEDED = {
    "run": [],
    "excite": [],
    "stability": [],
    "investigate": [],
    "export-controller": [],
    "identify": ["real=rig.csv"],
    "validate": ["real=rig.csv"],
    "diagnose": ["real=rig.csv"],
}
#: A call of each other command that reads options, by an option of its own.
PLAIN = {
    "report": ["nothing.mcap", "out=page.html"],
    "plot": ["nothing.mcap", "out=figures"],
    "export": ["nothing.mcap", "out=table.csv"],
    "import": ["nothing.csv", "out=rig.mcap"],
    "runs": ["in=nowhere", "limit=3", "json=true"],
    "score": ["nothing.mcap", "baseline=before.json"],
    "compare": ["nothing.mcap", "sort=cost", "json=true"],
    "watch": ["nothing.mcap", "speed=2", "once=true"],
    "list": ["ref", "json=true"],
    "allow": ["json=true"],
    "init": ["my-rig", "example=cart_pole"],
    "doctor": ["json=true"],
    "serve": ["nowhere", "port=1"],
}
NEITHER = {"blind", "course", "rig", "sweep", "completion", "help"}  # these have words of their own


def test_every_command_is_looked_at():
    assert {*NEEDED, *PLAIN, *NEITHER} == {*COMMANDS}
    composing = {name for name in COMMANDS if hasattr(load_command(name), "COMPOSES")}
    assert composing - {"sweep"} == {*NEEDED}


@pytest.mark.parametrize("spelling", [["--out", "a b=c"], ["--out=a b=c"], ["out=a b=c"]])
@pytest.mark.parametrize("command", NEEDED)
def test_composing_commands_take_out_as_an_option(command, spelling, capsys):
    assert main([command, *NEEDED[command], *spelling, "--cfg", "job"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["out"] == "a b=c"


@pytest.mark.parametrize("command", PLAIN)
def test_other_commands_take_their_options_as_keys(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    # others write to the disk between two calls
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)

    def answer(argv):
        code = main([command, *argv])
        return code, *capsys.readouterr()

    words = PLAIN[command]
    dashed = [f"--{w}".removesuffix("=true") if "=" in w else w for w in words]
    assert answer(words) == answer(dashed)
    assert not any(w in text for w in words if "=" in w for text in answer(words)[1:])


@pytest.mark.parametrize("command", ["score", "compare", "runs", "watch", "list", "allow"])
def test_a_command_without_out_says_so(command, capsys):
    assert main([command, "nothing", "out=x"]) == 2
    assert "--out" in capsys.readouterr().err


#: What is taken as an option, and what is not.
@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["out=x"], ["--out=x"]),
        (["out=file"], ["out=file"]),  # there is a file of that name
        (["a.mcap", "json=true"], ["a.mcap", "--json"]),
        (["json=false"], []),
        (["json=maybe"], ["json=maybe"]),
        (["--where", "out=x"], ["--where", "out=x"]),
        (["--where=a=b", "out=x=y"], ["--where=a=b", "--out=x=y"]),
        (["controller=pid"], ["controller=pid"]),
    ],
)
def test_words_of_options(argv, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out=file").touch()
    assert as_options(argv, {"out": True, "where": True, "json": False}) == words


@pytest.mark.parametrize(
    ("primary", "argv", "line"),
    [
        ("run", ["--controller", "pid"], "run controller=pid"),
        ("run", ["--controller=pid", "seed=2"], "run controller=pid seed=2"),
        ("run", ["ref=sine", "--sim.duration", "20"], "run ref=sine sim.duration=20"),
        ("run", ["--controller.sample_time=0.05"], "run controller.sample_time=0.05"),
        ("run", ["--seed", "3", "--ref", "square"], "run seed=3 ref=square"),
        ("run", ["--effect", "--seed", "3"], "run effect=VALUE seed=3"),
        ("run", ["--out", "x y", "--seed", "3"], "run 'out=x y' seed=3"),
        ("run", ["--signal@ref.alpha_v", "sine"], "run signal@ref.alpha_v=sine"),
        ("run", ["-m", "--sampler", "sobol"], "run -m sampler=sobol"),
        ("identify", ["--real", "rig.csv"], "identify real=rig.csv"),
    ],
)
def test_a_key_typed_as_an_option_is_answered_with_the_corrected_line(primary, argv, line):
    with pytest.raises(ConfigurationError) as caught:
        compose(argv, primary)
    assert caught.value.where.startswith("--") and caught.value.exit_code == 2
    assert f"trms {line}" in caught.value.remedy.splitlines()[-1]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--controler", "pid"], "unknown option '--controler'"),
        (["--out"], "no folder given"),
        ({"controler": "pid"}, "there is no key 'controler'"),
    ],
)
def test_what_is_no_key_is_told(given, words):
    with pytest.raises(ConfigurationError, match=words):
        compose(given)


class TestMapping:
    """An experiment given as a mapping composes as it would be typed."""

    @pytest.mark.parametrize(
        ("given", "typed"),
        [
            ({"controller": "pid", "seed": 3}, ["controller=pid", "seed=3"]),
            ({"sim": {"duration": 20.5}, "out": "a b"}, ["sim.duration=20.5", "out=a b"]),
            (
                {
                    "effect": ["main_input_delay"],
                    "ref": {"square": {"alpha_v": {"amplitude": 0.2}}},
                },
                ["effect=[main_input_delay]", "ref=square", "ref.alpha_v.amplitude=0.2"],
            ),
        ],
    )
    def test_as_typed(self, given, typed):
        mine, theirs = compose(given), compose(typed)
        assert mine.config == theirs.config and mine.choices == theirs.choices

    def test_without_the_commands(self, tmp_path):
        code = "from trms_cli.composition.composer import compose; compose({'controller': 'pid'})"
        assert not any(name.startswith("trms_cli.commands") for name in loaded_by(code, tmp_path))
