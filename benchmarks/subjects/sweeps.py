"""What the engine of sweeps costs a run, and how well it uses several cores."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.document import LIMIT, Column, Table
from benchmarks.options import Options

TITLE = "sweeps: runs of 60 s with pid, scored and logged, after warming up"
#: ms that the engine may add to a run, in this process and with a worker.
LIMIT_MS = 10.0
#: ms between two runs that end, two workers: a thousand in a minute.
LIMIT_RUN = 60.0
#: Least share of two cores that two workers use, as its reciprocal.
LIMIT_CORES = 1 / 0.85
_RUNS = 60
_WORDS = ("controller=pid", "picture=false", "sim.scene_every=0", "sim.estimate_every=10")


def run(options: Options) -> list[Table]:
    """The same runs in a plain loop, by the engine in this process, and by its workers."""
    table = Table(
        "sweeps",
        TITLE,
        [
            Column("way", "way"),
            Column("run_ms", "a run", "ms"),
            Column("of_loop", "of the loop's", "", 3),
            Column("overhead_ms", "engine", "ms"),
            Column("speedup", "speed-up", "", 3),
            *LIMIT,
            Column("remark", ""),
        ],
    )
    count = 6 if options.quick else _RUNS
    words = [*_WORDS, f"sim.duration={options.duration(60.0):g}"]
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        before = os.environ.get("TRMS_RUNS")
        os.environ["TRMS_RUNS"] = "off"
        try:
            _loop(place / "warm", words, 3)
            loop = _loop(place / "loop", words, count)
            table.add(way="plain loop in one process", run_ms=1e3 * loop, of_loop=1.0)
            here = _engine(place / "here", words, count, 0)
            _add(table, "engine in this process", here, loop, LIMIT_MS)
            one = _engine(place / "one", words, count, 1)
            _add(table, "engine, 1 worker", one, loop, LIMIT_MS)
            two = _engine(place / "two", words, 2 * count, 2)
            table.add_limited(
                "of_loop",
                2 * two / one,
                LIMIT_CORES,
                way="engine, 2 workers: of half the time of 1",
                run_ms=1e3 * two,
                speedup=one / two,
            )
            table.add_limited(
                "run_ms",
                1e3 * two,
                LIMIT_RUN,
                way="engine, 2 workers: a thousand in a minute",
            )
        finally:
            if before is None:
                del os.environ["TRMS_RUNS"]
            else:
                os.environ["TRMS_RUNS"] = before
    table.notes += [
        "engine: composing, the claim, status.json twice, dispatch and result, above what the loop "
        "takes; the loop composes each run by what the engine uses, and asks git for nothing.",
        f"2 workers on {os.cpu_count()} cores; start-up of workers and their first runs left out.",
    ]
    return [table]


def _add(table: Table, way: str, seconds: float, loop: float, limit: float) -> None:
    table.add_limited(
        "overhead_ms",
        1e3 * (seconds - loop),
        limit,
        way=way,
        run_ms=1e3 * seconds,
        of_loop=seconds / loop,
    )


def _loop(place: Path, words: list[str], count: int) -> float:
    """Time of a run in a plain loop, s."""
    from trms_cli.commands.run import perform
    from trms_cli.composition.composer import composer_of
    from trms_cli.library.tasks.git_revision import known_revision

    composer = composer_of("run", ())
    begin = time.perf_counter()
    for number in range(count):
        composition = composer.compose([*words, f"seed={number}"], number)
        folder = place / str(number)
        folder.mkdir(parents=True)
        composition.config["out"] = str(folder)
        with contextlib.redirect_stdout(io.StringIO()), known_revision(""):
            perform(composition)
    return (time.perf_counter() - begin) / count


def _engine(place: Path, words: list[str], count: int, workers: int) -> float:
    """Time between two runs that end, once every worker is warm, s."""
    from trms_cli.commands.run import perform
    from trms_cli.library.tasks.sweep import make_sweep

    warm = 3 * max(1, workers)
    ends: list[float] = []
    tell: Callable[[Any, Any], None] = lambda progress, result: (  # noqa: E731
        ends.append(time.perf_counter()) if result is not None else None
    )
    swept = make_sweep(
        [*words, f"seed=range({count + warm})", f"launcher.workers={workers}", f"out={place}"],
        "run",
        perform,
        tell=tell,
    )
    assert swept.all_done, swept.counts
    return (ends[-1] - ends[warm - 1]) / (len(ends) - warm)
