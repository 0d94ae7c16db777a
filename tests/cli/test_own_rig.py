"""Plants of a user's own: what is wrong with one is told with its file and line; it is landed."""

import re
import shutil
from pathlib import Path

import pytest


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Words for a run with a plant of that module."""
    monkeypatch.setenv("TRMS_ALLOW", "own_rigs")
    options = tmp_path / "lab" / "configs" / "plant"
    options.mkdir(parents=True)
    shutil.copy(Path(__file__).with_name("own_rigs.py"), tmp_path / "lab")
    (options / "own.yaml").write_text(
        "# a rig of the user's\n_target_: own_rigs.Rig\nhow: ''  # what is wrong\nat: 0  # sample\n"
    )
    (options / "unfinished.yaml").write_text("# lacks things\n_target_: own_rigs.Unfinished\n")
    words = ["--config-dir", str(options.parent), "plant=own", "controller=open_loop"]
    words += [
        "signal@controller.u_v=constant",
        "controller.u_v.offset=0.6",
        "controller.u_h.amplitude=0",
    ]
    return ["run", *words, "sim.duration=0.2", "picture=false"]


def events(folder: Path) -> list[str]:
    """What was done to the rig."""
    return (folder / "rig.txt").read_text().splitlines()


def test_it_is_landed_at_the_end_and_knows_how_many_samples_that_takes(trms, rig, tmp_path):
    trms(*rig, "out=there")
    first, armed, *commands, disarmed, last = events(tmp_path)
    assert [first, armed, disarmed, last] == ["connect", "arm", "disarm", "close completed"]
    assert commands[:10] == ["0.600 0.000"] * 10
    # 1 V/s is 0.02 V a sample: 30 of them down to zero, which is said once more at the end
    ramp = [float(command.split()[0]) for command in commands[10:]]
    assert ramp == pytest.approx([0.6 - 0.02 * k for k in range(1, 31)] + [0.0], abs=1e-9)
    assert int((tmp_path / "samples.txt").read_text()) >= len(commands)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("list", "measure() returned [-0.62, 0.0]"),
        ("none", "measure() returned None"),
        ("length", "measure() returned array([-0.62]) (shape (1,), float64)"),
        ("text", "measure() returned 'level'"),
        ("whole", "measure() returned array([0, 0]) (shape (2,), int64)"),
    ],
)
def test_a_first_reading_that_is_none_is_told_with_the_line_of_measure(
    trms, rig, tmp_path, how, words
):
    source = (tmp_path / "lab" / "own_rigs.py").read_text().splitlines()
    line = 1 + next(i for i, text in enumerate(source) if "def measure" in text)
    shape = "a float array of shape (2,), in this order: alpha_v, alpha_h"
    said = trms(*rig, f"plant.how={how}", code=2).said
    for part in (words, f"own_rigs.py:{line}", shape):
        assert part in said
    assert events(tmp_path) == ["connect", "disarm", "close failed"]
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("init returns nothing", "init() returned None, which is no run of it"),
        ("list of limits", "input_limits is [-2.5, 2.5]"),
        ("names", "outputs is ('alpha_v', 'alpha_h')"),
        ("noise", "noise_sd has no alpha_h"),
        ("command", "first_command is [0.0, 0.0]"),
        ("state", "state is None"),
    ],
)
def test_a_run_without_what_the_loop_needs_is_refused_before_it_is_opened(
    trms, rig, tmp_path, how, words
):
    said = trms(*rig, f"plant.how={how}", code=2).said
    assert words in said
    assert how.startswith("init") or re.search(r"own_rigs\.py:\d+", said)
    assert not (tmp_path / "rig.txt").exists()


def test_attributes_that_are_missing_are_named_and_so_is_why_a_property_has_no_value(trms, rig):
    said = trms(*rig, "plant=unfinished", code=2).said
    assert "UnfinishedRun has no noise_sd, known_disturbances, advance" in said
    assert "'UnfinishedRun' object has no attribute 'tachos'" in said
    assert re.search(r"own_rigs\.py:\d+", said)


@pytest.mark.parametrize(
    ("how", "at", "words"),
    [
        ("init raises", 0, ["failed at the start: OSError: no such card", "in init"]),
        ("measure raises", 0, ["failed at the start: IndexError", "in measure"]),
        ("measure raises", 5, ["failed at 0.10 s: IndexError", "in measure", "there/run.mcap"]),
        ("advance raises", 5, ["failed at 0.10 s: RuntimeError: the cable is off", "in advance"]),
    ],
)
def test_an_exception_names_the_plant_its_line_and_the_time(trms, rig, tmp_path, how, at, words):
    said = trms(*rig, f"plant.how={how}", f"plant.at={at}", "out=there", code=1).said
    for part in ("the plant own_rigs.Rig", "own_rigs.py, line", *words):
        assert part in said
    if how != "init raises":
        assert events(tmp_path)[-1] == "close failed"


@pytest.mark.parametrize("how", ["list", "none", "length", "text"])
def test_a_later_reading_that_is_none_ends_the_run_in_words(trms, rig, tmp_path, how):
    said = trms(*rig, f"plant.how={how}", "plant.at=3", "out=there", code=1).said
    assert "measure() returned" in said and "alpha_v, alpha_h" in said
    assert events(tmp_path)[-1] == "close failed"
    assert events(tmp_path)[-3] == "0.000 0.000"  # landed all the same
