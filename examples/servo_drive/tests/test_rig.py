"""The model says what it should, the driver speaks its words, the loop holds the rig."""

import json
from pathlib import Path

import numpy as np
import pytest

from servo_drive import driver
from servo_drive.model import ServoDrive
from trms_cli.cli import main
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import discretise

RIG = Path(__file__).parents[1]


@pytest.fixture
def trms(monkeypatch, tmp_path):
    """Call the program in the rig's folder; what it writes goes elsewhere."""
    monkeypatch.chdir(RIG)
    monkeypatch.setenv("TRMS_ALLOW", "servo_drive")
    return lambda *words: main([*words, f"out={tmp_path / 'out'}"])


def test_the_model_stays_at_rest():
    model = ServoDrive()
    step = BufferedFunction(discretise(model, 0.02, 4).step)
    rest, nothing = model.rest(), np.zeros(model.n_w)
    after = step.evaluate(rest, np.zeros(model.n_u), model.parameters.values, nothing)[0]
    assert after.ravel() == pytest.approx(rest, abs=1e-12)


def test_the_driver_reads_and_writes_what_it_is_wired_for():
    driver.open()
    readings = driver.read()
    driver.write({"drive": 0.0})
    driver.close()
    assert set(readings) == {"encoder"}
    assert all(np.isfinite(value) for value in readings.values())


def test_the_loop_follows_its_reference(trms, tmp_path):
    assert trms("run", "sim.duration=10", "picture=false") == 0
    channels = json.loads((tmp_path / "out" / "score.json").read_text())["channels"]
    for name in ServoDrive().controlled:
        assert channels[name]["rmse"] < 0.05
