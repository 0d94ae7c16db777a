"""``make rig`` in short: two processes, one wire; judged by order and landing, not by the clock."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.rig.__main__ import what_went_wrong
from trms_cli import read_log
from trms_cli.cli import main
from trms_cli.core.compilation import compiler

#: What keeps a machine that is busy with other tests from landing the rig.
PATIENT = ("--watchdog", "5", "plant.lost_after=20", "sim.late.land_after=null", "picture=false")


def demonstrated(folder: Path, *argv: str) -> str:
    command = [sys.executable, "-m", "experiments.rig", "--duration", "2", *argv, *PATIENT]
    done = subprocess.run(
        [*command, "--out", str(folder)], capture_output=True, text=True, timeout=400
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_rig_is_driven_watched_and_landed(tmp_path: Path) -> None:
    told = demonstrated(tmp_path / "demo", "controller=pid")
    assert told.splitlines()[-1] == f"driven and landed: {tmp_path / 'demo'}"
    assert "s of 2 |" in told  # of `trms watch`
    log = read_log(tmp_path / "demo" / "run")
    assert log.outcome == "completed" and log.choices["plant"] == "udp"
    assert (log["/landing"].filter(like="u_").iloc[-1] == 0.0).all()
    score = json.loads((tmp_path / "demo" / "run" / "score.json").read_text())
    assert score["complete"] and score["duration_s"] == pytest.approx(2.0, abs=0.1)
    truth = (tmp_path / "demo" / "truth.csv").read_text().splitlines()
    assert truth[0].startswith("t[s],u_v[V],u_h[V]") and len(truth) > 100
    command = [sys.executable, "-m", "experiments.rig", "--out", str(tmp_path / "demo")]
    assert subprocess.run(command, capture_output=True).returncode == 2  # nothing is written over


@pytest.mark.slow
@pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
def test_an_exported_controller_drives_it_as_well(tmp_path: Path) -> None:
    export = tmp_path / "c"
    assert main(["export-controller", "newton_mpc", f"out={export}", "measure=false"]) == 0
    demonstrated(tmp_path / "demo", "--exported", str(export))
    assert read_log(tmp_path / "demo" / "run").choices["controller"] == "exported"


GOOD = (
    "    0.000 s  a rig is served: trms run plant=udp plant.host=127.0.0.1 plant.port=1",
    "    1.000 s  connected (session 0000abcd)",
    "    2.000 s  armed",
    "    9.000 s  disarmed",
    "    9.500 s  ended; 350 commands applied, 2 frames refused; u_v 0 V, u_h 0 V",
)


@pytest.mark.parametrize(
    ("lines", "code", "told"),
    [
        (GOOD, 0, []),
        (GOOD, 2, ["the run ended with 2"]),
        (GOOD[:2] + GOOD[3:], 0, ["the rig saw connected, disarmed, ended"]),
        (
            (*GOOD[:3], "    4.000 s  watchdog: no command for 0.5 s, safe command", *GOOD[3:]),
            0,
            ["watchdog: no command for 0.5 s, safe command"],
        ),
        (
            (*GOOD[:4], GOOD[4].replace("u_v 0 V", "u_v 1.2 V")),
            0,
            ["it was not driven, or not left at 0 V"],
        ),
        ((), 2, ["the rig saw nothing", "it was not driven, or not left at 0 V"]),
    ],
)
def test_what_is_judged(lines: tuple[str, ...], code: int, told: list[str]) -> None:
    problems = what_went_wrong(lines, code)
    assert problems[: len(told)] == told and bool(problems) == bool(told)
