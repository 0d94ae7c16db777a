"""``trms allow`` and ``--allow``, as a person types them, and who tells of them."""

import json
import shutil
from pathlib import Path

import pytest

from trms_cli.cli import COMMANDS, load_command

EXAMPLE = Path(__file__).parents[2] / "docs" / "example_plugin"


@pytest.fixture
def configs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRMS_ALLOW", "")
    shutil.copytree(EXAMPLE, tmp_path / "lab", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "lab" / "configs"


def test_allowed_listed_and_removed(trms, configs: Path) -> None:
    assert "no package but trms itself" in trms("allow").stdout
    words = ("run", "--config-dir", "lab/configs", "controller=my_cascade", "sim.duration=0.2")
    refused = trms(*words, "picture=false", code=2)
    assert "trms allow my_lab --config-dir" in refused.stderr
    trms("allow", "my_lab", "--config-dir", "lab/configs")
    listed = json.loads(trms("allow", "--json").stdout)
    assert listed["schema"] == "trms.allowed/1"
    assert listed["packages"] == {"my_lab": str(configs.parent)}
    trms(*words, "picture=false", "out=one")
    trms("allow", "--remove", "my_lab")
    trms(*words, "picture=false", "out=two", code=2)
    trms(*words, "picture=false", "out=two", "--allow", "my_lab")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nothing_of_this_name",), "no package 'nothing_of_this_name' is installed"),
        (("my_lab.cascade",), "named without what is in it: my_lab"),
        (("os",), "a part of Python"),
        (("other", "--config-dir", "lab/configs"), "there is no package 'other' in"),
        (("--remove", "my_lab"), "'my_lab' is not allowed"),
        (("--remove",), "no package named"),
        (("--everything",), "unknown option '--everything'"),
    ],
)
def test_what_cannot_be_allowed_is_told(trms, refused, configs: Path, words, said: str) -> None:
    refused("allow", *words, words=said)
    assert "no package but trms itself" in trms("allow").stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_composes_tells_allow(name: str) -> None:
    command = load_command(name)
    if hasattr(command, "COMPOSES") or "--config-dir" in command.HELP:
        assert "--allow" in command.HELP or name in ("allow", "list"), name
