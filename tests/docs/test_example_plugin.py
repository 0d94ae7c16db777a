"""The example package of the docs, through the installed program: nothing of ours is touched."""

import json
import shutil
from pathlib import Path

import pytest

from tests.program import Program

EXAMPLE = Path(__file__).parents[2] / "docs" / "example_plugin"


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    """The example, copied to where a user would have it."""
    shutil.copytree(EXAMPLE, tmp_path / "lab", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "lab" / "configs"


@pytest.mark.parametrize("rig", [[], ["experiment=ideal_rig"], ["experiment=disturbed_rig"]])
def test_it_holds_the_rig(trms: Program, configs: Path, tmp_path: Path, rig: list[str]) -> None:
    words = ("controller=my_cascade", "ref=constant", "sim.duration=40", "picture=false")
    done = trms("run", "--config-dir", str(configs), *words, *rig, "out=run")
    assert "my_cascade" in done.stdout
    score = json.loads((tmp_path / "run" / "score.json").read_text())
    assert score["solver"]["failures"] == 0
    for channel in score["channels"].values():
        # under friction and a push yaw comes back slowly
        assert channel["steady_state_error"] < (0.05 if "disturbed" in str(rig) else 0.005)


def test_it_is_listed_like_ours(trms: Program, configs: Path) -> None:
    listed = trms("list", "--config-dir", str(configs), "controller").stdout
    assert "my_cascade" in listed and "Cascade of angle, thrust and rotor speed" in listed
    keys = trms("list", "--config-dir", str(configs), "controller", "my_cascade")
    assert "speed_gain" in keys.stdout


def test_its_run_is_repeated_from_the_log(trms: Program, configs: Path, tmp_path: Path) -> None:
    words = ["controller=my_cascade", "sim.duration=5", "picture=false"]
    trms("run", "--config-dir", str(configs), *words, "out=first")
    trms("run", "--from", "first/run.mcap", "out=again")
    scores = [json.loads((tmp_path / d / "score.json").read_text()) for d in ("first", "again")]
    assert scores[0]["channels"] == scores[1]["channels"]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("controller.pitch.derivitive=1", "derivative"),
        ("controller.yaw.speed_gain=-1", "controller.yaw.speed_gain"),
        ("controller.pitch.integral=slow", "controller.pitch.integral"),
    ],
)
def test_its_keys_are_checked_like_ours(
    trms: Program, configs: Path, override: str, words: str
) -> None:
    done = trms("run", "--config-dir", str(configs), "controller=my_cascade", override, code=2)
    assert words in done.stderr
