"""``out=DIR`` and ``--out DIR`` mean one thing for every command; ``--KEY VALUE`` is answered."""

from __future__ import annotations

import pytest
import yaml

from trms_cli.cli import COMMANDS, load_command, main
from trms_cli.commands.plain_options import as_options
from trms_cli.composition.composer import compose
from trms_cli.core.errors import ConfigurationError

#: What each composing command cannot do without.
NEEDED = {
    "run": [],
    "excite": [],
    "stability": [],
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
    "doctor": ["json=true"],
}
NEITHER = {"blind", "sweep", "completion", "help"}  # these have words of their own


def test_every_command_is_looked_at():
    assert {*NEEDED, *PLAIN, *NEITHER} == {*COMMANDS}
    assert {name for name in COMMANDS if hasattr(load_command(name), "COMPOSES")} - {"sweep"} == {
        *NEEDED
    }


@pytest.mark.parametrize("spelling", [["--out", "a b=c"], ["--out=a b=c"], ["out=a b=c"]])
@pytest.mark.parametrize("command", NEEDED)
def test_composing_commands_take_out_as_an_option(command, spelling, capsys):
    assert main([command, *NEEDED[command], *spelling, "--cfg", "job"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["out"] == "a b=c"


@pytest.mark.parametrize("command", PLAIN)
def test_other_commands_take_their_options_as_keys(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))

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


class TestWordsOfOptions:
    """What is taken as an option, and what is not."""

    TAKES = {"out": True, "where": True, "json": False}  # noqa: RUF012

    @pytest.mark.parametrize(
        ("argv", "words"),
        [
            (["out=x"], ["--out=x"]),
            (["a.mcap", "json=true"], ["a.mcap", "--json"]),
            (["json=false"], []),
            (["json=maybe"], ["json=maybe"]),
            (["--where", "out=x"], ["--where", "out=x"]),
            (["--where=a=b", "out=x=y"], ["--where=a=b", "--out=x=y"]),
            (["controller=pid"], ["controller=pid"]),
        ],
    )
    def test_words(self, argv, words):
        assert as_options(argv, self.TAKES) == words

    def test_a_file_of_that_name_stays_one(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "out=x").touch()
        assert as_options(["out=x"], self.TAKES) == ["out=x"]


class TestKeysTypedAsOptions:
    """The corrected line is told whole."""

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
    def test_known_keys(self, primary, argv, line):
        with pytest.raises(ConfigurationError) as caught:
            compose(argv, primary)
        assert caught.value.where.startswith("--") and caught.value.exit_code == 2
        assert f"trms {line}" in caught.value.remedy.splitlines()[-1]

    def test_others_are_unknown(self):
        with pytest.raises(ConfigurationError, match="unknown option '--controler'"):
            compose(["--controler", "pid"])

    def test_out_without_a_folder(self):
        with pytest.raises(ConfigurationError, match="no folder given"):
            compose(["--out"])


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

    def test_without_the_commands(self):
        import subprocess
        import sys

        code = (
            "import sys; from trms_cli.composition.composer import compose;"
            "compose({'controller': 'pid'}, primary='run');"
            "assert not any(name.startswith('trms_cli.commands') for name in sys.modules)"
        )
        subprocess.run([sys.executable, "-c", code], check=True)

    def test_a_key_that_is_not_there(self):
        with pytest.raises(ConfigurationError, match="there is no key 'controler'"):
            compose({"controler": "pid"})

    def test_an_object_stands_in_it(self):
        from trms_cli.composition.given_object import given
        from trms_cli.core.plugins import build
        from trms_cli.references.constant import Constant

        signal = Constant(offset=0.2)
        composition = compose({"ref": {"alpha_h": signal}})
        with given([signal]):
            assert build(composition.config["ref"], "ref").alpha_h is signal
