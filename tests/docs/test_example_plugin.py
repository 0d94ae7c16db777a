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
