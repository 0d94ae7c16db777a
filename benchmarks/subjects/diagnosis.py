"""A diagnosis of a rig with friction: against its limits, and how it grows with the recording."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter

from benchmarks.document import LIMIT, Column, Table
from benchmarks.options import Options

TITLE = "trms diagnose: a rig with friction, four channels at 50 Hz, two threads"
#: s. The default on 120 s, and ``effort=quick`` for the online watch.
LIMIT_NORMAL, LIMIT_QUICK = 30.0, 8.0
#: s. The first diagnosis ever, which compiles each effect's equations.
LIMIT_FIRST = 60.0
#: Twice the recording, or two of them, take at most so many times as long.
LIMIT_GROWTH = 2.2
#: MiB. Of the process, its libraries included.
LIMIT_MEMORY = 1024.0
_RUN = (
    *("run", "controller=open_loop", "observer=full_state", "picture=false"),
    *("signal@controller.u_v=multilevel", "controller.u_v.amplitude=0.5"),
    *("controller.u_v.offset=0.9", "signal@controller.u_h=multilevel"),
    *("controller.u_h.amplitude=0.8", "plant.prior_seed=3"),
)


#: The friction of the rig is no suspect: more is tried where nothing explains the gap.
_UNKNOWN = 'candidates=[all,"!yaw_coulomb_friction","!yaw_stribeck_friction"]'


def run(options: Options) -> list[Table]:
    """Each diagnosis in a process of its own; the first, which compiles, has a row of its own."""
    lengths = (30.0,) if options.quick else (60.0, 120.0, 240.0)
    table = Table(
        "diagnosis",
        TITLE,
        [
            Column("case", "recording"),
            Column("time", "time", "s"),
            Column("growth", "× a half, or one"),
            Column("memory", "memory", "MiB"),
            *LIMIT,
        ],
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        recordings = {seconds: _recording(folder, seconds) for seconds in lengths}
        longest = recordings[lengths[-1] if options.quick else 120.0]
        cold = {**os.environ, "TRMS_CACHE": str(folder / "cache")}
        first, _ = _diagnosis(folder, [longest], environment=cold)
        table.add_limited("time", first, LIMIT_FIRST, case="120 s, first use")
        shortest = recordings[lengths[0]]
        _diagnosis(folder, [shortest])  # compiles where it was never done
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
        two, memory = _diagnosis(folder, [shortest, _recording(folder, lengths[0], seed=7)])
        growth = two / times[lengths[0]]
        cells = {"case": f"two of {lengths[0]:g} s", "memory": memory}
        table.add_limited("growth", growth, LIMIT_GROWTH, time=two, **cells)
        _diagnosis(folder, [longest], _UNKNOWN)  # compiles what other suspects need
        unknown, _ = _diagnosis(folder, [longest], _UNKNOWN)
        table.add_limited("time", unknown, LIMIT_NORMAL, case="120 s, no suspect is the cause")
        quick, _ = _diagnosis(folder, [longest], "effort=quick")
        table.add_limited("time", quick, LIMIT_QUICK, case="120 s, effort=quick")
        reference_recordings = [
            _recording(folder, lengths[0], seed=s, effect=False) for s in (8, 9)
        ]
        words = f"against=[{','.join(map(str, reference_recordings))}]"
        _diagnosis(folder, [longest], words)  # compiles
        compared, _ = _diagnosis(folder, [longest], words)
        case = f"120 s, against two of {lengths[0]:g} s"
        table.add_limited("time", compared, LIMIT_NORMAL, case=case)
    return [table]


def _recording(folder: Path, seconds: float, seed: int = 3, effect: bool = True) -> Path:
    """A rig, with friction or before it had any, driven by commands of that seed."""
    out = folder / f"rig_{seconds:g}_{seed}"
    words = [f"controller.u_h.seed={seed}", f"sim.duration={seconds:g}", f"out={out}"]
    _trms([*_RUN, *(["effect=yaw_coulomb_friction"] if effect else []), *words])
    return out / "run.mcap"


def _diagnosis(
    folder: Path,
    recordings: Sequence[Path],
    *words: str,
    environment: Mapping[str, str] | None = None,
) -> tuple[float, float]:
    """Time in s from the shell's view, and memory in MiB."""
    out = Path(tempfile.mkdtemp(dir=folder)) / "diagnosis"
    real = f"real=[{','.join(map(str, recordings))}]"
    begin = perf_counter()
    memory = _trms(["diagnose", real, f"out={out}", "jobs=2", *words], environment)
    spent = perf_counter() - begin
    document = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["schema"] == "trms.diagnosis/1"
    return spent, memory


def _trms(words: Sequence[str], environment: Mapping[str, str] | None = None) -> float:
    """Run a command; its largest memory, MiB."""
    process = subprocess.Popen(
        [sys.executable, "-m", "trms_cli", *words], stdout=subprocess.DEVNULL, env=environment
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"trms {' '.join(words)} failed")
    return usage.ru_maxrss / 1024
