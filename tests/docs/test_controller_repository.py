"""The template of a repository with one's own controller: its steps are run as its CI would."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

DOCS = Path(__file__).parents[2] / "docs"
TEMPLATE = DOCS / "templates" / "controller-repository"


@pytest.fixture(scope="module")
def repository(tmp_path_factory) -> Path:
    """The template with the example plugin in it, short runs, and baselines of today."""
    folder = tmp_path_factory.mktemp("repository") / "mine"
    shutil.copytree(DOCS / "example_plugin", folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(TEMPLATE, folder, dirs_exist_ok=True)
    script = folder / "tracking.sh"
    text = script.read_text(encoding="utf-8")
    assert "duration=40 " in text
    script.write_text(text.replace("duration=40 ", "duration=4 "), encoding="utf-8")
    done = bash("./tracking.sh --update first", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (folder / "tracking" / "square.json").is_file()
    return folder


def bash(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a step of the workflow, where `pip install` would have put both packages."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    outside = os.environ | {"PATH": path, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        ["bash", "-e", "-c", command], cwd=folder, env=outside, capture_output=True, text=True
    )


def steps() -> list[str]:
    """What the workflow runs, but for the installation."""
    workflow = yaml.safe_load((TEMPLATE / ".github/workflows/tracking.yml").read_text("utf-8"))
    runs = [step["run"] for step in workflow["jobs"]["tracking"]["steps"] if "run" in step]
    assert runs[0] == "pip install trms-cli ."
    return runs[1:]


@pytest.mark.slow
def test_the_steps_pass_where_nothing_has_changed(repository):
    for step in steps():
        done = bash(step, repository)
        assert done.returncode == 0, f"{step}\n{done.stdout}\n{done.stderr}"
    for reference in ("square", "sine"):
        assert (repository / "tracking" / "runs" / reference / "report.html").is_file()


@pytest.mark.slow
def test_a_worse_controller_fails(repository, tmp_path):
    changed = shutil.copytree(repository, tmp_path / "mine")
    option = changed / "configs" / "controller" / "my_cascade.yaml"
    before = option.read_text(encoding="utf-8")
    assert "steady_thrust: 0.62 " in before
    option.write_text(before.replace("steady_thrust: 0.62 ", "steady_thrust: 0.3 "))
    done = bash("./tracking.sh", changed)
    assert done.returncode == 1 and "worse" in done.stdout + done.stderr


def test_a_baseline_that_is_missing_is_told(repository, tmp_path):
    changed = shutil.copytree(repository, tmp_path / "mine")
    (changed / "tracking" / "sine.json").unlink()
    done = bash("sed 's/^references=.*/references=(sine)/' tracking.sh | bash -s", changed)
    assert done.returncode == 2 and './tracking.sh --update "why"' in done.stderr


def test_an_update_wants_a_reason(repository):
    done = bash("./tracking.sh --update", repository)
    assert done.returncode != 0 and "say why" in done.stderr
