"""The four starts on the nonlinear rig, each run exactly what `trms run` does."""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.chapter8.study import FloatArray, Study

ANGLES = ("alpha_h", "alpha_v")
INPUTS = ("u_v", "u_h")


@dataclass(frozen=True)
class Case:
    """One run."""

    controller: str  #: Names in the study
    observer: str  #: Names in the study
    start: tuple[float, float]  #: Yaw and pitch, rad
    overrides: tuple[str, ...]
    settled: float  #: rad


@dataclass(frozen=True)
class Ran:
    """What became of it."""

    case: Case
    ise: dict[str, float]  #: ∫ error² dt by angle, rad² s
    settling: dict[str, float]  #: s; NaN where an axis has not settled
    effort: dict[str, float]  #: Sum of the changes of an input, V
    largest: float  #: Largest command, V
    relaxed: float  #: Shares of the control samples
    failed: float  #: Shares of the control samples
    median_ms: float  #: A step, ms
    worst_ms: float  #: A step, ms
    time: FloatArray  #: (n,) array; s
    angles: dict[str, FloatArray]  #: dict of str to (n,) array
    commands: dict[str, FloatArray]  #: dict of str to (n,) array


def cases(study: Study, *, quick: bool = False) -> list[Case]:
    """Every controller, observer and start."""
    runs = study.runs
    names = runs.quick.controllers if quick else list(runs.controllers)
    observers = runs.quick.observers if quick else list(runs.observers)
    starts = study.starts[: runs.quick.starts] if quick else study.starts
    return [
        Case(
            name,
            observer,
            start,
            (
                *runs.controllers[name],
                *runs.observers[observer],
                "ref=constant",
                f"plant.initial.alpha_h={start[0]}",
                f"plant.initial.alpha_v={start[1]}",
                f"sim.duration={runs.duration}",
                f"seed={study.seed}",
                "sim.prediction_every=0",
            ),
            runs.settled,
        )
        for observer in observers
        for name in names
        if observer == observers[0] or name in runs.noisy
        for start in starts
    ]


def run_case(case: Case) -> Ran:
    """Run a case into a folder that is thrown away."""
    from trms_cli.commands import run
    from trms_cli.composition.composer import compose
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.runs.run_folder import LOG_NAME, SCORE_NAME

    with tempfile.TemporaryDirectory(prefix="trms-chapter8-") as scratch:
        folder = Path(scratch, "run")
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            run.perform(compose([*case.overrides, "picture=false", f"out='{folder}'"]))
        score: dict[str, Any] = json.loads((folder / SCORE_NAME).read_text(encoding="utf-8"))
        tables = read_log(folder / LOG_NAME).tables
    state, command, solver = (tables[k] for k in ("/plant/state", "/command", "/controller"))
    time = np.asarray(state.time, dtype=float)
    time = time - time[0]
    step = float(time[1])
    angles = {a: np.asarray(state.columns[a], dtype=float) for a in ANGLES}
    commands = {u: np.asarray(command.columns[u], dtype=float) for u in INPUTS}
    status = [str(value) for value in solver.columns["status"]]
    return Ran(
        case,
        {a: float((values**2).sum() * step) for a, values in angles.items()},
        {a: _settling(time, values, case.settled) for a, values in angles.items()},
        {u: float(np.abs(np.diff(values)).sum()) for u, values in commands.items()},
        float(max(np.abs(values).max() for values in commands.values())),
        float(np.mean([word == "relaxed" for word in status])),
        float(np.mean([word == "failed" for word in status])),
        float(score["solver"]["time_ms"]["median"]),
        float(score["solver"]["time_ms"]["max"]),
        time[::5],
        {a: values[::5] for a, values in angles.items()},
        {u: values[::5] for u, values in commands.items()},
    )


def run_all(case_list: Sequence[Case], jobs: int) -> Iterator[Ran]:
    """Run cases in worker processes, in order."""
    if jobs <= 1:
        yield from map(run_case, case_list)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=min(jobs, len(case_list)), mp_context=context) as pool:
        yield from pool.map(run_case, case_list)


def _settling(time: FloatArray, error: FloatArray, band: float) -> float:
    outside = np.flatnonzero(np.abs(error) > band)
    if not outside.size:
        return 0.0
    if outside[-1] + 1 >= len(time):
        return float("nan")
    return float(time[outside[-1] + 1])
