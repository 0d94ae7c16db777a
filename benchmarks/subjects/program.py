"""The program as a person meets it: whole processes, start-up included."""

from __future__ import annotations

import math
import os
import resource
import subprocess
import sys
import sysconfig
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.document import LIMIT, Column, Table, Value
from benchmarks.options import Options
from trms_cli.core.threads import ONE_THREAD

TITLE = "whole processes, warm caches but for the first run"
#: s, of wall time.
LIMIT_HELP, LIMIT_FIRST_SAMPLE, LIMIT_RUN, LIMIT_FIRST_RUN = 0.2, 1.0, 1.0, 10.0
_REPEATS = 7
#: Settings of test machines and of this benchmark that a person's shell does not have; without
#: byte code beside the modules every start would compile them.
_NOT_A_PERSONS = (
    *ONE_THREAD,
    *("PYTHONDONTWRITEBYTECODE", "PYTHONUNBUFFERED"),
)
#: Where caches lie, other than in the home.
_CACHES = ("TRMS_CACHE", "TRMS_RUNS", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR")

_PID = ("run", "controller=pid", "ref=square", "sim.sample_time=0.01", "sim.duration=60")
_MPC = ("run", "controller=newton_mpc", "ref=square")


def run(options: Options) -> list[Table]:
    """Each command several times; the first, which fills caches, does not count."""
    table = Table(
        "program",
        TITLE,
        [
            Column("command", "command"),
            Column("median", "median", "s"),
            Column("fastest", "fastest", "s"),
            Column("slowest", "slowest", "s"),
            Column("processor", "processor", "s"),
            *LIMIT,
            Column("remark", ""),
        ],
    )
    repeats = 1 if options.quick else _REPEATS
    environment = dict(os.environ)
    for name in _NOT_A_PERSONS:
        environment.pop(name, None)
    with tempfile.TemporaryDirectory() as scratch:
        place = _Place(Path(scratch), environment)
        python = [sys.executable, "-c", "pass"]
        _add(table, "python -c pass, for comparison", None, place.repeated(python, repeats))
        trms = _program()
        _add(table, "trms --help", LIMIT_HELP, place.repeated([*trms, "--help"], repeats))
        _add(table, "trms list", None, place.repeated([*trms, "list"], repeats))
        times = place.repeated([*trms, *_MPC, "sim.duration=1"], repeats, first_sample=True)
        _add(table, "trms run: to the first sample", LIMIT_FIRST_SAMPLE, times)
        for name, more, limit in (
            ("60 s with pid at 100 Hz, picture=false", ("picture=false",), LIMIT_RUN),
            ("the same with its picture", (), None),
            ("the same with the full state", ("picture=false", "observer=full_state"), None),
        ):
            times = place.repeated([*trms, *_PID, *more], repeats, new_folder=True)
            _add(table, name, limit, times)
        times = place.repeated([*trms, *_MPC], repeats, new_folder=True)
        _add(table, "the default run of 80 s, newton_mpc", None, times)
        times = place.repeated([*trms, *_MPC], repeats, new_folder=True, new_home=True)
        _add(table, "the same as the first run of a user, nothing compiled", LIMIT_FIRST_RUN, times)
    table.notes += [
        "processor: time on the processor, which a busy machine hardly changes; limits are on the "
        "median wall time.",
        "first run: in an empty home, without compiled functions and drawing's list of fonts.",
        "first sample: wall-clock stamp of the log's first sample after the start of the process.",
    ]
    return [table]


def _program() -> list[str]:
    installed = Path(sysconfig.get_path("scripts")) / "trms"
    return [str(installed)] if installed.exists() else [sys.executable, "-m", "trms_cli"]


@dataclass
class _Times:
    """Wall times and median processor time of a command, s; empty when it failed."""

    wall: np.ndarray = field(default_factory=lambda: np.zeros(0))
    processor: float = math.nan
    remark: str = ""


class _Place:
    """A scratch folder in which commands run."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder, self.environment, self._count = folder, environment, 0

    def repeated(
        self,
        command: list[str],
        repeats: int,
        *,
        first_sample: bool = False,
        new_folder: bool = False,
        new_home: bool = False,
    ) -> _Times:
        """Run; the first time does not count. With a new home each is a user's first."""
        times, processor = [], []
        for _ in range(repeats + 1):
            self._count += 1
            out = self.folder / str(self._count)
            folder = [f"out={out}"] if new_folder or first_sample else []
            environment = dict(self.environment)
            if new_home:
                environment = {k: v for k, v in environment.items() if k not in _CACHES}
                environment["HOME"] = str(self.folder / f"home-{self._count}")
            began = time.time_ns()
            used = _children()
            begin = time.perf_counter()
            process = subprocess.run(
                [*command, *folder],
                cwd=self.folder,
                env=environment,
                capture_output=True,
                text=True,
            )
            spent = time.perf_counter() - begin
            processor.append(_children() - used)
            if process.returncode != 0:
                words = (process.stderr or process.stdout).strip().splitlines()
                return _Times(remark=words[0] if words else f"exit code {process.returncode}")
            times.append((_first_stamp(out / "run.mcap") - began) * 1e-9 if first_sample else spent)
        return _Times(np.array(times[1:]), float(np.median(processor[1:])))


def _first_stamp(log: Path) -> int:
    """Wall clock of the log's first sample, ns."""
    from mcap.reader import make_reader

    with log.open("rb") as stream:
        return min(
            message.publish_time for _, _, message in make_reader(stream).iter_messages(end_time=1)
        )


def _children() -> float:
    """Processor time of the processes that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _add(table: Table, command: str, limit: float | None, times: _Times) -> None:
    if not len(times.wall):
        table.add(command=command, remark=times.remark)
        return
    cells: dict[str, Value] = {
        "command": command,
        "fastest": float(times.wall.min()),
        "slowest": float(times.wall.max()),
        "processor": times.processor,
    }
    median = float(np.median(times.wall))
    if limit is None:
        table.add(median=median, **cells)
    else:
        table.add_limited("median", median, limit, **cells)
