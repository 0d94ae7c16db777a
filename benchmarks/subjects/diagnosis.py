"""A diagnosis of a rig with friction: against its limits, and how it grows with the recording."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from benchmarks.document import LIMIT, Column, Table
from benchmarks.options import Options

TITLE = "trms diagnose: a rig with friction, four channels at 50 Hz, two threads"
#: s. The default on 120 s, and ``effort=quick`` for the online watch.
LIMIT_NORMAL, LIMIT_QUICK = 30.0, 8.0
#: Twice the recording takes at most so many times as long.
LIMIT_GROWTH = 2.2
#: MiB. Of the process, its libraries included.
LIMIT_MEMORY = 1024.0
_RUN = (
    *("run", "controller=open_loop", "observer=full_state", "picture=false"),
    *("signal@controller.u_v=multilevel", "controller.u_v.amplitude=0.5"),
    *("controller.u_v.offset=0.9", "signal@controller.u_h=multilevel"),
    *("controller.u_h.amplitude=0.8", "plant.prior_seed=3", "effect=yaw_coulomb_friction"),
)


#: The friction of the rig is no suspect: more is tried where nothing explains the gap.
_UNKNOWN = 'candidates=[all,"!yaw_coulomb_friction","!yaw_stribeck_friction"]'


def run(options: Options) -> list[Table]:
    """Each diagnosis in a process of its own; the first, which compiles, is not counted."""
    lengths = (30.0,) if options.quick else (60.0, 120.0, 240.0)
    table = Table(
        "diagnosis",
        TITLE,
        [
            Column("case", "recording"),
            Column("time", "time", "s"),
            Column("growth", "× half of it"),
            Column("memory", "memory", "MiB"),
            *LIMIT,
        ],
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        recordings = {seconds: _recording(folder, seconds) for seconds in lengths}
        first = [recordings[lengths[0]]]
        _diagnosis(folder, first)  # compiles
        times: dict[float, float] = {}
        for seconds, recording in recordings.items():
            times[seconds], memory = _diagnosis(folder, [recording])
            half = times.get(seconds / 2)
            growth = None if half is None else times[seconds] / half
            cells = {"case": f"{seconds:g} s", "growth": growth, "memory": memory}
            if seconds == 120.0:
                table.add_limited("time", times[seconds], LIMIT_NORMAL, **cells)
                table.add_limited("memory", memory, LIMIT_MEMORY, case=f"{seconds:g} s, memory")
            elif growth is not None:
                del cells["growth"]
                table.add_limited("growth", growth, LIMIT_GROWTH, time=times[seconds], **cells)
            else:
                table.add(time=times[seconds], **cells)
        longest = recordings[lengths[-1] if options.quick else 120.0]
        _diagnosis(folder, [longest], _UNKNOWN)  # compiles what other suspects need
        unknown, _ = _diagnosis(folder, [longest], _UNKNOWN)
        table.add_limited("time", unknown, LIMIT_NORMAL, case="120 s, no suspect is the cause")
        quick, _ = _diagnosis(folder, [longest], "effort=quick")
        table.add_limited("time", quick, LIMIT_QUICK, case="120 s, effort=quick")
    return [table]


def _recording(folder: Path, seconds: float) -> Path:
    out = folder / f"rig_{seconds:g}"
    _trms([*_RUN, f"sim.duration={seconds:g}", f"out={out}"])
    return out / "run.mcap"


def _diagnosis(folder: Path, recordings: Sequence[Path], *words: str) -> tuple[float, float]:
    """Time in s from the shell's view, and memory in MiB."""
    out = Path(tempfile.mkdtemp(dir=folder)) / "diagnosis"
    real = f"real=[{','.join(map(str, recordings))}]"
    begin = perf_counter()
    memory = _trms(["diagnose", real, f"out={out}", "jobs=2", *words])
    spent = perf_counter() - begin
    document = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["schema"] == "trms.diagnosis/1"
    return spent, memory


def _trms(words: Sequence[str]) -> float:
    """Run a command; its largest memory, MiB."""
    process = subprocess.Popen(
        [sys.executable, "-m", "trms_cli", *words], stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"trms {' '.join(words)} failed")
    return usage.ru_maxrss / 1024
