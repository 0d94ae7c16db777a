"""``trms run controller=open_loop``: every kind of signal as a command, and what is said of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from trms_cli.cli import main
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.read import read_recording

QUICK = (
    "controller=open_loop",
    "observer=full_state",
    "plant=ideal",
    "picture=false",
)
#: Every signal that needs no file; a run with each is played to the rig.
KINDS = (
    "constant",
    "step",
    "ramp",
    "square",
    "sine",
    "sawtooth",
    "chirp",
    "prbs",
    "multilevel",
    "multisine",
    "schedule",
    "sum",
)


def run(folder: Path, *overrides: str) -> Path:
    assert main(["run", *QUICK, f"out={folder}", *overrides]) == 0
    return folder


def command(folder: Path, name: str) -> np.ndarray:
    return read_log(folder / "run.mcap").tables["/command"].columns[name]


@pytest.mark.parametrize("kind", KINDS)
def test_every_signal_is_played_as_it_is(kind, tmp_path):
    from trms_cli.composition.composer import compose
    from trms_cli.core.plugins import build

    overrides = (f"signal@controller.u_v={kind}", "sim.duration=6", f"out={tmp_path / 'run'}")
    run(tmp_path / "run", *overrides[:2])
    node = compose([*QUICK, *overrides]).config["controller"]["u_v"]
    signal = build(node, "controller.u_v")
    expected = signal.sample(np.arange(300) * 0.02)
    np.testing.assert_allclose(command(tmp_path / "run", "u_v"), expected, atol=1e-12)


def test_all_kinds_of_signals_are_tried_here():
    from trms_cli.composition.catalogue import read_groups

    assert {*KINDS, "from_csv"} == set(read_groups()["signal"])


def test_a_csv_of_commands_is_played(tmp_path):
    table = tmp_path / "commands.csv"
    table.write_text("t[s],u_v[V],u_h[mV]\n0,0.5,0\n1,1.0,250\n2,-0.5,-250\n")
    run(
        tmp_path / "run",
        "sim.duration=3",
        "signal@controller.u_v=from_csv",
        f"controller.u_v.file={table}",
        "controller.u_v.column=u_v",
        "signal@controller.u_h=from_csv",
        f"controller.u_h.file={table}",
        "controller.u_h.column=u_h",
    )
    assert command(tmp_path / "run", "u_v")[[0, 49, 50, 99, 100, 149]].tolist() == [
        0.5, 0.5, 1.0, 1.0, -0.5, -0.5,
    ]  # fmt: skip
    assert command(tmp_path / "run", "u_h")[[0, 60, 149]] == pytest.approx([0, 0.25, -0.25])


def test_no_tracking_is_scored_and_the_log_says_that_the_loop_was_open(tmp_path, capsys):
    folder = run(tmp_path / "run", "sim.duration=2")
    printed = capsys.readouterr().out
    assert "tracking  " not in printed and "ref " not in printed and "ref=" not in printed
    score = json.loads((folder / "score.json").read_text())
    assert score["channels"] == {}
    log = read_log(folder / "run.mcap")
    assert "/reference" not in log.tables or not len(log.tables["/reference"])
    assert read_recording(folder / "run.mcap").metadata["loop"] == "open"


def test_around_an_operating_point_the_model_stays_there(tmp_path):
    folder = run(
        tmp_path / "run",
        "sim.duration=2",
        "controller.operating_point={alpha_v: -0.2}",
        "signal@controller.u_v=constant",
        "signal@controller.u_h=constant",
        "model=newtonian_vertical",
    )
    # 1.06 V holds -0.2 rad: the table of equilibria gives -0.231 at 1.0 and -0.124 at 1.2 V.
    assert 1.0 < command(folder, "u_v")[0] < 1.2


def test_what_is_beyond_the_limits_is_cut_and_said(tmp_path):
    folder = run(tmp_path / "run", "sim.duration=1", "controller.u_v.amplitude=4")
    assert np.abs(command(folder, "u_v")).max() == 2.5
    log = read_log(folder / "run.mcap")
    assert any("u_v cut from" in str(m) for m in log.tables["/controller"].columns["message"])


def test_a_point_at_which_nothing_rests_is_refused(tmp_path, capsys):
    code = main(["run", *QUICK, f"out={tmp_path}/x", "controller.operating_point={alpha_v: 1.4}"])
    assert code == 2
    assert "nearest point at which it rests" in capsys.readouterr().err
    code = main(["run", *QUICK, f"out={tmp_path}/x", "controller.operating_point={alpha: 0}"])
    assert code == 2
    assert "alpha_v" in capsys.readouterr().err


def test_a_reference_that_nobody_follows_is_told(trms):
    quick = ("run", "controller=open_loop", "sim.duration=1", "picture=false")
    told = trms(*quick, "ref=sine", "signal@ref.alpha_v=square", "ref.alpha_h.amplitude=0.1")
    assert told.returncode == 0, told.stderr
    words = "follows no reference; of no effect: ref, signal@ref.alpha_v, ref.alpha_h.amplitude"
    assert words in " ".join(told.stdout.split())
    assert "follows no reference" not in trms(*quick).stdout
