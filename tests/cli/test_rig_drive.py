"""``trms rig drive``: an exported controller in the place of the Python one, at the same rig."""

import re
import shutil

import pytest

from tests.cli.test_export_controller import SMALL, needs_compiler
from trms_cli import read_log
from trms_cli.cli import main
from trms_cli.core import trust
from trms_cli.core.compilation import compiler
from trms_cli.library.tasks.drive import run_words

#: V, and states' units: what the export promises (docs/export-controller.md).
EQUAL = 1e-9
EIGHT = "controller.prediction_horizon=8"
FAST = "picture=false"


@pytest.fixture(autouse=True)
def _nothing_allowed(monkeypatch):
    """Each test is a process of its own, as far as what may be compiled."""
    monkeypatch.setattr(trust, "_exports", set())


def exported_to(folder, *words):
    assert main(["export-controller", "newton_mpc", *words, f"out={folder}", "measure=false"]) == 0
    return folder


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Pitch alone, with its filter."""
    return exported_to(tmp_path_factory.mktemp("small") / "rig", *SMALL, "name=rig")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Both axes, with their filter."""
    return exported_to(tmp_path_factory.mktemp("whole") / "rig", EIGHT)


def assert_alike(one, other):
    """Commands in V, estimates as shares of the largest value that each has in the run."""
    for topic in ("/command", "/estimate"):
        mine, its = read_log(one)[topic], read_log(other)[topic]
        assert list(mine.columns) == list(its.columns) and len(mine) == len(its) > 0
        difference = (mine - its).abs().max()
        if topic == "/estimate":
            difference /= its.abs().max().where(lambda size: size > 0, 1.0)
        assert difference.max() <= EQUAL, difference


@needs_compiler
def test_it_commands_what_the_python_controller_commands(trms, whole, tmp_path):
    """A rig that differs, with noise, lost samples and outliers, in simulated time."""
    rig = ("plant=simulated", "sim.duration=12", "plant.prior_seed=3", "seed=5", FAST)
    faults = "fault=[dropped_samples,yaw_outliers,main_tacho_frozen]"
    trms("rig", "drive", "--exported", str(whole), *rig, faults, "out=c")
    trms("run", EIGHT, *rig, faults, "out=python")
    assert_alike(tmp_path / "c", tmp_path / "python")
    mine, its = (read_log(tmp_path / name) for name in ("c", "python"))
    for column in ("status", "iterations", "fallback"):
        assert (mine["/controller"][column] == its["/controller"][column]).all(), column
    assert mine.choices["controller"] == mine.choices["observer"] == "exported"


@needs_compiler
def test_without_an_observer_another_one_estimates_and_the_model_is_the_exported_one(
    trms, tmp_path
):
    alone = exported_to(tmp_path / "alone", *SMALL, "observer=full_state")
    rig = ("plant=simulated", "sim.duration=3", FAST)
    trms("rig", "drive", "--exported", str(alone), *rig, "out=c")
    model = "model=newtonian_vertical"
    trms("run", EIGHT, model, *rig, "observer=ukf", "out=python")
    assert_alike(tmp_path / "c", tmp_path / "python")
    trms("rig", "drive", "--exported", str(alone), *rig, "observer=exported", "out=x", code=2)


@needs_compiler
def test_a_reference_out_of_reach_and_a_landing_are_as_in_python(trms, small, tmp_path):
    rig = ("plant=simulated", "model=newtonian_vertical", "sim.duration=8", FAST)
    for more in (
        ["ref.alpha_v.amplitude=1.2"],
        ["fault=pitch_encoder_dead"],
        ["controller.delay=one_sample"],
    ):
        for folder in ("c", "python"):
            shutil.rmtree(tmp_path / folder, ignore_errors=True)
        trms("rig", "drive", "--exported", str(small), *rig, *more, "out=c", code=None)
        trms("run", EIGHT, *rig, *more, "out=python", code=None)
        assert_alike(tmp_path / "c", tmp_path / "python")
        mine, its = (read_log(tmp_path / name)["/controller"] for name in ("c", "python"))
        assert (mine["message"] == its["message"]).all()
        assert (mine["mode"] == its["mode"]).all()


@pytest.mark.slow
@needs_compiler
def test_over_a_wire_it_connects_arms_drives_lands_and_disarms(trms, started, whole, tmp_path):
    """By the clock: order and landing alone; how fast this machine is has no say."""
    rig = started("rig", "serve", "port=0", "watchdog=2.0", "duration=300")
    address = re.search(r"plant=udp (\S+ \S+)", rig.stdout.readline())[1]
    patient = ("plant.lost_after=10", "plant.watchdog=2.0", "sim.late.land_after=null")
    words = (*address.split(), "plant.arm=true", *patient, "sim.duration=2", FAST, "out=c")
    trms("rig", "drive", "--exported", str(whole), *words)
    rig.terminate()
    lines, _ = rig.communicate(timeout=60)
    told = [line.split("s  ")[1].split(" (")[0] for line in lines.splitlines()]
    assert told[:3] == ["connected", "armed", "disarmed"]
    assert re.search(r"ended; [1-9]\d* commands applied.*; u_v 0 V, u_h 0 V", told[-1])
    log = read_log(tmp_path / "c")
    assert log.outcome == "completed" and log.choices["controller"] == "exported"
    assert len(log["/command"]) == 100
    landing = log["/landing"]
    last = landing[[name for name in landing.columns if name.startswith("u_")]].iloc[-1]
    assert (last == 0.0).all()


@needs_compiler
def test_its_log_is_a_run_like_any_other(trms, small, tmp_path):
    rig = ("plant=simulated", "sim.duration=1", FAST)
    trms("rig", "drive", "--exported", str(small), *rig, "out=c")
    trms("run", "--from", "c", "controller=pid", "observer=ekf", "out=pid")
    assert read_log(tmp_path / "pid").choices["model"] == "newtonian_vertical"
    trms("rig", "drive", "--exported", str(small), "--from", "pid", "out=back")
    back, first = (read_log(tmp_path / name)["/command"] for name in ("back", "c"))
    assert (back == first).all(axis=None)


def test_the_loop_is_that_of_the_export(tmp_path):
    """Model, sample time and delay come with it, unless something else is typed."""
    words = ("controller.delay=one_sample", "sim.sample_time=0.05", "controller.sample_time=0.1")
    folder = exported_to(tmp_path / "rig", *SMALL, *words)
    own = run_words(folder, ["seed=2"])
    assert own == [
        *("plant=udp", "controller=exported", f'controller.folder="{folder}"'),
        *("controller.delay=one_sample", "observer=exported", "sim.sample_time=0.05"),
        *("model=newtonian_vertical", "seed=2"),
    ]
    typed = ["plant=serial", "model=tras", "observer=ekf", "controller.delay=none"]
    assert run_words(folder, typed)[2:] == typed
    assert trust._exports == {folder}


def test_only_what_is_typed_runs(refused, small, tmp_path, monkeypatch):
    """A configuration or a log that names a folder of C compiles nothing."""
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "settings" / "cache"))
    for words in (
        ["controller=exported", f"controller.folder={small}"],
        ["observer=exported", f"observer.folder={small}"],
        ["controller=exported", "controller.folder=."],
    ):
        refused("run", "model=newtonian_vertical", *words, words=["C source", "trms rig drive"])
    assert not list((tmp_path / "settings").rglob("exported_*"))
    refused("run", "observer=exported", words="no folder of an export given")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "no folder given"),
        (["--exported"], "no folder given"),
        (["--exported", "x", "--exported", "y"], "given twice"),
        (["--exported", "nowhere"], "does not exist"),
        (["--exported", "."], "holds no exported controller"),
        (["--exported", "nowhere", "-m"], "one run at a time"),
    ],
)
def test_what_is_no_export_is_refused(refused, words, told):
    refused("rig", "drive", *words, words=told)


@needs_compiler
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["model=newtonian"], "the states of model 'newtonian' are"),
        (["sim.sample_time=0.05"], "0.05 s, and the source was exported for 0.02 s"),
        (["plant.sensors.channels=[alpha_v]"], "the exported observer takes alpha_v, omega_v"),
    ],
)
def test_a_rig_that_does_not_fit_is_refused(refused, small, words, told):
    refused("rig", "drive", "--exported", str(small), "plant=simulated", *words, words=told)


def test_without_a_compiler_and_with_a_source_that_is_spoilt(refused, small, tmp_path, monkeypatch):
    folder = shutil.copytree(small, tmp_path / "settings" / "spoilt")
    words = ("rig", "drive", "--exported", str(folder), "plant=simulated", "sim.duration=1")
    if compiler() is not None:
        with (folder / "rig.c").open("a") as source:
            source.write("no C\n")
        refused(*words, words=["does not compile", "check"])
    compiler.cache_clear()
    monkeypatch.setenv("TRMS_COMPILE", "0")
    try:
        refused(*words, words=["no C compiler", "trms doctor"])
    finally:
        compiler.cache_clear()
    (folder / "rig.c").unlink()
    refused(*words, words="rig.c is missing")


@needs_compiler
def test_what_a_former_version_exported_is_refused_in_words(refused, small, tmp_path):
    folder = shutil.copytree(small, tmp_path / "former")
    source = (folder / "rig.c").read_text()
    (folder / "rig.c").write_text(source.replace("rig_start(", "rig_init_with("))
    words = ("rig", "drive", "--exported", str(folder), "plant=simulated", "sim.duration=1")
    refused(*words, words=["a former version", "export it again"])
