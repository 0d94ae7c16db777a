"""Runs of the tournament in worker processes: each once, none lost.

A worker composes a part of the configuration (an entrant, a reference, a rig) once and joins the
parts for each run, since composing costs as much as a short run; a test holds the joined
configuration equal to the composed one. Runs keep no log unless asked: the score says it all.

Before a run starts it leaves a ``status.json`` that says so. If its worker dies (a crash in
compiled code, no memory), the pool dies with it: those that were running then are run again, each
in a process of its own, and one that kills that too is told as crashed.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any

from experiments.command_line import process_pool
from experiments.tournament.schedule import Run
from trms_cli.core.errors import TrmsError
from trms_cli.core.whole_file import replace_whole
from trms_cli.scoring.comparison.runs import LOG, RUN_KEY, SCORE, STATUS

STATUS_SCHEMA = "trms.status/1"
#: Runs that are waiting in the pool for each worker: few, so that a crash takes few with it.
_AHEAD = 2


def folder_of(run: Run, out: Path, block: str | None = None) -> Path:
    """Where a run is filed: once for each of its blocks."""
    entrant = f"{run.controller}+{run.observer}"
    return out / (block or run.blocks[0]) / entrant / run.ref / run.rig


def is_done(run: Run, out: Path) -> bool:
    """Whether a run of these very words has ended, well or not; a crash is tried again."""
    folder = folder_of(run, out)
    with contextlib.suppress(OSError, ValueError):
        run_record = json.loads((folder / SCORE).read_text(encoding="utf-8"))[RUN_KEY]
        return bool(run_record["fingerprint"] == run.fingerprint)
    with contextlib.suppress(OSError, ValueError):
        status = json.loads((folder / STATUS).read_text(encoding="utf-8"))
        return status.get("fingerprint") == run.fingerprint and status["state"] == "failed"
    return False


def run_all(
    runs: Sequence[Run], out: Path, *, jobs: int, time_limit: float, logs: bool
) -> Iterator[Run]:
    """Run all; yields each when it has ended and is filed.

    Parameters
    ----------
    jobs : int
        Processes.
    time_limit : float
        s of wall time that a run may take.
    logs : bool
        Whether each run keeps its log.
    """
    waiting = list(runs)
    while waiting:
        suspects: list[Run] = []
        for run, ended in _in_a_pool(waiting, out, jobs, time_limit, logs):
            if ended:
                waiting.remove(run)
                yield run
            else:
                suspects.append(run)
        for run in suspects:  # one of them killed its worker: each alone, to find out which
            waiting.remove(run)
            if not all(ended for _, ended in _in_a_pool([run], out, 1, time_limit, logs)):
                _file_status(run, out, "crashed", "the process that ran it died")
            yield run


def perform(run: Run, out: Path, time_limit: float, logs: bool) -> None:
    """Run and file one run; only the death of the process gets past here."""
    for block in run.blocks:
        shutil.rmtree(folder_of(run, out, block), ignore_errors=True)
    folder = folder_of(run, out)
    folder.mkdir(parents=True)
    _file_status(run, out, "running")
    begin = perf_counter()
    try:
        with _limited(time_limit), _silence():
            score, non_finite = _logged(run, folder) if logs else score_in_memory(run, folder)
    except TrmsError as error:
        _file_status(run, out, "failed", error.problem, where=error.where)
        return
    except Exception as error:  # a failing run must not hide the others
        _file_status(run, out, "failed", f"{type(error).__name__}: {error}")
        return
    run_record = {
        "coordinates": run.coordinates,
        "outside": run.outside,
        "non_finite": non_finite,
        "words": list(run.words),
        "fingerprint": run.fingerprint,
        "seconds": round(perf_counter() - begin, 3),
    }
    score["log"] = LOG if logs else ""
    content = json.dumps({**score, RUN_KEY: run_record}, indent=1, allow_nan=False).encode()
    for block in run.blocks:
        place = folder_of(run, out, block)
        place.mkdir(parents=True, exist_ok=True)
        replace_whole(place / SCORE, content)
    (folder / STATUS).unlink()


def config_of(run: Run) -> dict[str, Any]:
    """The configuration of a run, joined from parts that were composed before."""
    base = _composed(run.every)
    config, owners = dict(base), dict.fromkeys(base, 0)
    for owner, words in enumerate((run.rig_words, run.entrant_words, run.ref_words), start=1):
        for key, value in _composed((*words, *run.every)).items():
            if value != base[key]:
                if owners[key]:  # two parts change one key: only composing knows what is meant
                    return dict(_composed(run.words))
                config[key], owners[key] = value, owner
    return config


def _in_a_pool(
    runs: Sequence[Run], out: Path, jobs: int, time_limit: float, logs: bool
) -> Iterator[tuple[Run, bool]]:
    """Runs as they end, and those that had begun when a worker died (with False)."""
    queue = iter(runs)
    with process_pool(min(jobs, len(runs))) as pool:
        pending: dict[Future[None], Run] = {}
        try:
            while True:
                for run in queue:
                    pending[pool.submit(perform, run, out, time_limit, logs)] = run
                    if len(pending) >= jobs * _AHEAD:
                        break
                if not pending:
                    return
                completions, _ = wait(pending, return_when=FIRST_COMPLETED)
                for future in completions:
                    future.result()
                    yield pending.pop(future), True
        except BrokenProcessPool:
            for future, run in pending.items():
                if future.done() and future.exception() is None:
                    yield run, True
                elif (folder_of(run, out) / STATUS).is_file():
                    yield run, False
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def score_in_memory(run: Run, folder: Path) -> tuple[dict[str, Any], int]:
    """Score, and how often a command was not finite."""
    import numpy as np

    from trms_cli.library.tasks import experiment as assembly
    from trms_cli.library.tasks.run import score_of
    from trms_cli.simulation.closed_loop import Loop
    from trms_cli.simulation.history import History

    experiment = assembly.experiment_of(config_of(run))

    def keep(plant: Any) -> History:
        topics = assembly.topics_of(experiment, plant)
        return History(assembly.units_of(topics), None)

    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        loop = Loop.start(experiment, keep)
        loop.run()
        score = score_of(loop, folder, complete=True)
    faults = sum(
        kind == "fault" and source == "controller" for _, kind, source, *_ in loop.history.events
    )
    return score, faults


def _logged(run: Run, folder: Path) -> tuple[dict[str, Any], int]:
    """The same by what ``trms run`` does, with its log."""
    from dataclasses import replace

    from trms_cli.commands import run as command
    from trms_cli.scoring.comparison.runs import gather

    draft = folder / "draft"
    composition = _composition(run.words)
    config = {**composition.config, "out": str(draft), "picture": False}
    command.perform(replace(composition, config=config))
    (draft / LOG).replace(folder / LOG)
    shutil.rmtree(draft)
    read = gather([folder / LOG]).runs[0]
    return dict(read.score or {}), read.non_finite or 0


@cache
def _composition(words: tuple[str, ...]) -> Any:
    from trms_cli.composition.composer import compose

    return compose([*words, "picture=false"])


def _composed(words: tuple[str, ...]) -> dict[str, Any]:
    config: dict[str, Any] = _composition(words).config
    return config


def _file_status(run: Run, out: Path, state: str, error: str = "", **more: str) -> None:
    """A status in every block of a run that failed; of one that is running, in the first."""
    document = {
        "schema": STATUS_SCHEMA,
        "state": "failed" if state == "crashed" else state,
        "coordinates": run.coordinates,
        "outside": run.outside,
        "overrides": list(run.words),
        # a crash has no fingerprint: it is tried again when the tournament goes on
        "fingerprint": "" if state == "crashed" else run.fingerprint,
        "pid": os.getpid(),
    }
    if error:
        document["error"] = {"problem": error, **more}
    content = json.dumps(document, indent=1, ensure_ascii=False).encode()
    for block in run.blocks if error else run.blocks[:1]:
        place = folder_of(run, out, block)
        place.mkdir(parents=True, exist_ok=True)
        replace_whole(place / STATUS, content)


@contextlib.contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """End what takes too long, where the system has alarms."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def give_up(*_: Any) -> None:
        raise TrmsError(f"the run took longer than {seconds:g} s of wall time")

    before = signal.signal(signal.SIGALRM, give_up)
    # Again each second after that: an exception out of an alarm is lost where code that is called
    # back from C cannot pass it on.
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """What the runs say is said by the tables."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
