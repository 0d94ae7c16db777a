"""The six cases by the program itself, and the plans of successive samples."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.chapter6.rig import FloatArray, Loop
from experiments.chapter6.study import Case, Cases, Mode, Predictions

ANGLES = ("alpha_v", "alpha_h")


@dataclass(frozen=True)
class Run:
    """A case under a controller."""

    case: str
    controller: str
    score: dict[str, Any]  #: ``trms.score/1``
    #: dict of str to (n,) array; ``time`` (s), references ``r_…`` and angles (rad), inputs (V)
    traces: dict[str, FloatArray]
    #: ``control_time``, ``objective``, ``residual``: (m,) arrays; per control sample; the residual
    #: is the terminal one
    control_time: FloatArray
    objective: FloatArray
    residual: FloatArray
    statuses: dict[str, int]  #: Samples by status


@dataclass(frozen=True)
class Plans:
    """What was planned at some samples after a step of the references."""

    time: FloatArray  #: (n,) array; s after the step, of the rig's trajectory
    x: FloatArray  #: (n, n_x) and (n, n_u): what came of it
    u: FloatArray  #: (n, n_x) and (n, n_u): what came of it
    objective: FloatArray  #: (n,) array
    #: dict of int to (times, states, inputs); by sample
    predictions: dict[int, tuple[FloatArray, FloatArray, FloatArray]]


def overrides(case: Case) -> list[str]:
    """Of ``trms run``, for the references of a case."""
    words = [f"ref={case.ref}"]
    for angle in ANGLES:
        words += [f"ref.{angle}.{key}={value}" for key, value in getattr(case, angle).items()]
    return words


def study_cases(study: Cases) -> list[Run]:
    """Every case under every controller."""
    return [
        run_case(name, case, controller, words, study.duration)
        for name, case in study.runs.items()
        if not study.only or name in study.only
        for controller, words in study.controllers.items()
    ]


def run_case(name: str, case: Case, controller: str, words: list[str], duration: float) -> Run:
    """One of them, exactly as ``trms run`` does it."""
    from trms_cli.commands import run
    from trms_cli.composition.composer import compose
    from trms_cli.recordings.log_reader import read_log

    with tempfile.TemporaryDirectory(prefix="trms-chapter6-") as scratch:
        folder = Path(scratch, "run")
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            run.perform(
                compose(
                    [
                        *("experiment=chapter6", *overrides(case), *words),
                        *(f"sim.duration={duration}", "picture=false", f"out='{folder}'"),
                    ]
                )
            )
        score = json.loads((folder / "score.json").read_text(encoding="utf-8"))
        tables = read_log(folder / "run.mcap").tables
    reference, state, command = (
        tables[topic] for topic in ("/reference", "/plant/state", "/command")
    )
    traces = {"time": np.asarray(reference.time, dtype=float)}
    for angle in ANGLES:
        traces[f"r_{angle}"] = np.asarray(reference.columns[angle], dtype=float)
        traces[angle] = np.asarray(state.columns[angle], dtype=float)
    for name_of_input in ("u_v", "u_h"):
        traces[name_of_input] = np.asarray(command.columns[name_of_input], dtype=float)
    control = tables["/controller"]
    statuses: dict[str, int] = {}
    for status in control.columns["status"]:
        statuses[str(status)] = statuses.get(str(status), 0) + 1
    return Run(
        name,
        controller,
        score,
        traces,
        np.asarray(control.time, dtype=float),
        np.asarray(control.columns["objective"], dtype=float),
        np.asarray(control.columns["terminal_residual"], dtype=float),
        statuses,
    )


def study_predictions(study: Predictions) -> dict[str, Plans]:
    """The same step by every mode."""
    return {name: _plans(mode, study) for name, mode in study.modes.items()}


def _plans(mode: Mode, study: Predictions) -> Plans:
    loop, goal = Loop(mode.controller()), np.array(study.goal)
    start = loop.state.steady_state.solve(np.array(study.start))
    loop.begin(start.x, np.array(study.start), start.u)
    x, before = start.x.copy(), start.u.copy()
    loop.state.newton.plan[:] = start.u[:, None]
    period = loop.mpc.sample_time
    states, inputs, objective, predictions = [x], [], [], {}
    for k in range(round(study.duration / period)):
        loop.begin(x, goal, before)
        outcome = loop.solve()
        u = loop.state.newton.plan[:, 0].copy()
        if k in (*study.samples, *study.later):
            predicted = loop.state.prediction()
            predictions[k] = (k * period + predicted.time, predicted.states, predicted.inputs)
        x = loop.after(x, u)
        before = u
        states.append(x)
        inputs.append(u)
        objective.append(outcome.objective)
    n = len(inputs)
    return Plans(
        np.arange(n, dtype=np.float64) * period,
        np.array(states[:n]),
        np.array(inputs),
        np.array(objective),
        predictions,
    )
