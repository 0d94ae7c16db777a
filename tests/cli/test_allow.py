"""``trms allow`` and ``--allow``, as a person types them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "docs" / "example_plugin"


@pytest.fixture
def configs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRMS_ALLOW", "")
    shutil.copytree(EXAMPLE, tmp_path / "lab", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "lab" / "configs"


def test_allowed_listed_and_removed(trms, configs: Path) -> None:
    assert "no package but trms itself" in trms("allow").stdout
    words = ("run", "--config-dir", "lab/configs", "controller=my_cascade", "sim.duration=0.2")
    refused = trms(*words, "picture=false")
    assert refused.returncode == 2
    assert "trms allow my_lab --config-dir" in refused.stderr
    assert trms("allow", "my_lab", "--config-dir", "lab/configs").returncode == 0
    listed = json.loads(trms("allow", "--json").stdout)
    assert listed["schema"] == "trms.allowed/1"
    assert listed["packages"] == {"my_lab": str(configs.parent)}
    assert trms(*words, "picture=false", "out=one").returncode == 0
    assert trms("allow", "--remove", "my_lab").returncode == 0
    assert trms(*words, "picture=false", "out=two").returncode == 2
    once = trms(*words, "picture=false", "out=two", "--allow", "my_lab")
    assert once.returncode == 0, once.stderr


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
def test_what_cannot_be_allowed_is_told(trms, configs: Path, words, said: str) -> None:
    done = trms("allow", *words)
    assert done.returncode == 2 and said in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert "no package but trms itself" in trms("allow").stdout
