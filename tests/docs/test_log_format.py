"""The log format's page: its Python runs, and its topics are those of a log."""

import re
from pathlib import Path

import numpy as np
import pytest

from trms_cli.recordings.log_reader import read_log

PAGE = Path(__file__).resolve().parents[2] / "docs" / "log-format.md"


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """A short run with everything that a log may hold."""
    from trms_cli.cli import main

    folder = tmp_path_factory.mktemp("docs") / "there"
    words = ["controller=newton_mpc", "sim.duration=1", "picture=false", f"out={folder}"]
    push = "disturbance@plant.disturbances=yaw_push"
    words += [push, "plant.disturbances.yaw_push.known=true", "sim.prediction_every=4"]
    assert main(["run", *words]) == 0
    return folder


@pytest.fixture(scope="module")
def paced_log(tmp_path_factory) -> Path:
    """The log of a short run by the clock, with a landing."""
    from trms_cli.cli import main

    folder = tmp_path_factory.mktemp("docs") / "paced"
    words = ["controller=pid", "sim.duration=0.2", "sim.pace=real_time", f"out={folder}"]
    assert main(["run", *words, "plant.landing.after_run=true", "picture=false"]) == 0
    return folder / "run.mcap"


def test_its_python_runs(run_folder, monkeypatch, capsys):
    monkeypatch.chdir(run_folder)
    names: dict = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(block, names)
    assert len(capsys.readouterr().out.splitlines()) == 50
    assert np.isfinite(names["state"].columns["alpha_v"]).all()


def test_its_topics_and_fields_are_those_of_a_log(run_folder, paced_log):
    table = re.findall(r"^\| `(/[\w/]+)` \|(.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    described = dict(table)
    log = read_log(run_folder / "run.mcap")
    paced = read_log(paced_log)
    assert set(described) == set(log.tables) | set(paced.tables)
    for topic in ("/reference", "/command", "/measurement", "/controller", "/event"):
        for name in log.table(topic).columns:
            assert f"`{name}`" in described[topic], (topic, name)
    for name in paced.table("/timing").columns:
        assert f"`{name}`" in described["/timing"], name
    signals = [*paced.table("/command").columns, *paced.table("/measurement").columns]
    assert list(paced.table("/landing").columns) == signals


def test_measured_torques_and_predictions_are_as_it_says(run_folder):
    log = read_log(run_folder / "run.mcap")
    assert list(log.table("/disturbance").columns) == ["d_yaw_moment"]
    assert len(log.table("/disturbance")) == len(log.table("/measurement")) == 50
    assert "`d_yaw_moment`" in PAGE.read_text(encoding="utf-8")
    np.testing.assert_allclose(log.table("/prediction").time, [0.0, 0.4, 0.8])


def test_its_kinds_of_events_are_those_that_are_written():
    package = PAGE.parents[1] / "trms_cli"
    files = [*package.glob("simulation/*.py"), *package.glob("plants/*.py")]
    files.append(package / "recordings" / "for_model.py")
    source = "".join(file.read_text(encoding="utf-8") for file in files)
    text = PAGE.read_text("utf-8")
    table = text[text.index("| `kind` of an event") : text.index("## Times")]
    named = set(re.findall(r"`(\w+)`", "".join(re.findall(r"\n\|[^|]+\|", table)))) - {"kind"}
    assert {"outlier", "degraded_begin", "fault_injected", "solver"} <= named
    for kind in named:
        assert f'"{kind}"' in source, kind
