"""Runs of the matrix, each exactly what `trms run` does, several at once."""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from experiments.regression.matrix import Case
from trms_cli.core.errors import TrmsError

#: Every how many samples a trace keeps one: 10 Hz of the usual 50, enough for a figure.
_THINNING = 5


@dataclass
class Outcome:
    """What became of a case."""

    case: Case
    score: dict[str, Any] | None = None  #: ``trms.score/1``; None if the run failed
    problem: str = ""  #: Why it failed
    seconds: float = 0.0  #: Wall time, s
    #: dict of str to (n,) array; thinned ``time`` (s), angles and references ``r_…`` (rad)
    traces: dict[str, Any] = field(default_factory=dict)


def run_case(case: Case) -> Outcome:
    """Compose a case and run it into a folder that is thrown away; never raises but on Ctrl-C."""
    from trms_cli.commands import run
    from trms_cli.composition.composer import compose
    from trms_cli.runs.run_folder import LOG_NAME, SCORE_NAME

    begin = perf_counter()
    outcome = Outcome(case)
    with tempfile.TemporaryDirectory(prefix="trms-regression-") as scratch, _silence():
        folder = Path(scratch, "run")
        try:
            run.perform(compose([*case.overrides, "picture=false", f"out='{folder}'"]))
            outcome.score = json.loads((folder / SCORE_NAME).read_text(encoding="utf-8"))
            outcome.traces = _traces(folder / LOG_NAME)
        except TrmsError as error:
            outcome.problem = str(error)
        except Exception as error:  # a failing case must not hide the others
            outcome.problem = f"{type(error).__name__}: {error}"
    outcome.seconds = perf_counter() - begin
    return outcome


def run_all(cases: Sequence[Case], jobs: int) -> Iterator[Outcome]:
    """Run cases in worker processes; yields them as they end."""
    if jobs <= 1:
        yield from map(run_case, cases)
        return
    # A fresh process each, also where forking is usual: casadi's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=min(jobs, len(cases)), mp_context=context) as pool:
        futures = [pool.submit(run_case, case) for case in cases]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """What the runs say is said by the tables."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


def _traces(log: Path) -> dict[str, Any]:
    from trms_cli.recordings.log_reader import read_log

    tables = read_log(log).tables
    reference, state = tables["/reference"], tables["/plant/state"]
    traces = {"time": np.asarray(reference.time)[::_THINNING]}
    for name, values in reference.columns.items():
        traces[f"r_{name}"] = np.asarray(values, dtype=float)[::_THINNING]
        traces[name] = np.asarray(state.columns[name], dtype=float)[::_THINNING]
    return traces
