"""A sweep of very many recorded runs: resumed, listed, filtered, compared, reported."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.document import LIMIT, Column, Table
from benchmarks.hollow_sweep import hollow_sweep
from benchmarks.options import Options

TITLE = "a sweep of recorded runs, hollow: their words without samples"
#: s of an answer, and MiB that it may take.
LIMIT_S, LIMIT_MIB = 10.0, 1024.0
#: Two sizes, for the slope between them.
_COUNTS = (20_000, 100_000)
#: What is asked; the first reads every log into the index, once, and has no limit.
_QUESTIONS: dict[str, tuple[str, ...]] = {
    "first listing: every log is read": ("runs", "--in", "{}", "--limit", "40"),
    "listed": ("runs", "--in", "{}", "--limit", "40"),
    "filtered": ("runs", "rmse_yaw < 0.2 and controller == 'lqr'", "--in", "{}", "--limit", "40"),
    "compared": ("compare", "{}"),
    "compared, as a document": ("compare", "{}", "--json"),
    "status": ("sweep", "status", "{}"),
    "resumed": ("sweep", "resume", "{}"),
    "reported": ("report", "{}", "--force"),
}


def run(options: Options) -> list[Table]:
    """Each question in a process of its own, on two sizes of a sweep."""
    table = Table(
        "scale",
        TITLE,
        [
            Column("question", "question"),
            Column("runs", "runs"),
            Column("time", "time", "s"),
            Column("processor", "processor", "s"),
            Column("slope", "processor a run", "µs"),
            Column("memory", "memory", "MiB"),
            *LIMIT,
        ],
    )
    for count in (200, 400) if options.quick else _COUNTS:
        # beside the document and not in memory: 100 000 runs take 3 GB of the disk
        options.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=options.out) as scratch:
            place = Path(scratch).resolve()
            runs = hollow_sweep(place / "sweep", count)
            for number, (question, words) in enumerate(_QUESTIONS.items()):
                taken, processor, memory = _ask(place, [w.format(place / "sweep") for w in words])
                cells: dict[str, Any] = {
                    "question": question,
                    "runs": runs,
                    "processor": processor,
                    "slope": 1e6 * processor / runs,
                    "memory": memory,
                }
                if number == 0:
                    table.add(time=taken, **cells)
                else:
                    table.add_limited("time", taken, LIMIT_S, **cells)
                    table.rows[-1]["met"] = taken <= LIMIT_S and memory <= LIMIT_MIB
    table.notes.append(
        f"Limits: {LIMIT_S:g} s an answer by the clock, and {LIMIT_MIB:g} MiB of memory, "
        "which is at least that of this process, from which the others are begun."
    )
    return [table]


def _ask(place: Path, words: list[str]) -> tuple[float, float, float]:
    """Time by the clock and of the processor, s, and the most memory, MiB, of a command."""
    environment = {**os.environ, "TRMS_RUNS": str(place / "index")}
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "trms_cli", *words], stdout=subprocess.DEVNULL, env=environment
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    taken = time.perf_counter() - begin
    if process.returncode not in (0, 1):  # 1: runs of the sweep have failed
        raise RuntimeError(f"{' '.join(words)} ended with {process.returncode}")
    return taken, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024
