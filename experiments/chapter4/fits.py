"""Recordings and fits of the study, exactly as ``trms run`` and ``trms identify`` make them."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from experiments.chapter4.cases import Case
from trms_cli.identification.free_runs import error_figures, window_runs
from trms_cli.identification.problem import FitResult, SilentProgress, with_values


@dataclass
class GreyboxFit:
    """One fit."""

    method: str
    errors: Mapping[str, Any]  #: By output: ``rmse``, … on the recording that was held out
    #: The common cost of all methods at the fitted values, nats; see
    #: :class:`trms_cli.identification.population.SimulationCost`
    cost: float
    seconds: float  #: Processor time of the fit, one thread
    simulations: int
    #: list of (simulations, s, cost); of methods that minimise the common cost
    history: list[tuple[int, float, float]] = field(default_factory=list)
    values: Mapping[str, float] = field(default_factory=dict)
    #: dict of str to (n,) array; simulated over the held-out recording
    trace: dict[str, Any] = field(default_factory=dict)


@dataclass
class CaseOutcome:
    """What came out of a case."""

    case: Case
    free: int = 0  #: Number of free parameters
    #: Errors of the model with its own values, by output
    white: Mapping[str, Any] = field(default_factory=dict)
    fits: list[GreyboxFit] = field(default_factory=list)
    #: dict of str to (n,) array; the held-out recording, and ``time`` (s)
    measured: dict[str, Any] = field(default_factory=dict)
    white_trace: dict[str, Any] = field(default_factory=dict)  #: dict of str to (n,) array


def run_case(
    case: Case, methods: Mapping[str, Sequence[str]], seeds: Sequence[int] = (0,)
) -> CaseOutcome:
    """Make the recordings of a case, fit it by every method and seed, judge on what is held out."""
    outcome = CaseOutcome(case)
    with tempfile.TemporaryDirectory(prefix="trms-chapter4-") as scratch:
        fit = record_run(case.fit, Path(scratch, "fit"))
        held_out = record_run(case.held_out, Path(scratch, "held_out"))
        for method, words in methods.items():
            for seed in seeds:
                _fit(outcome, method, [*words, f"seed={seed}"], fit, held_out)
    return outcome


def record_run(words: Sequence[str], folder: Path) -> Path:
    """The folder of a run."""
    from trms_cli.commands import run
    from trms_cli.composition.composer import compose

    with _silence():
        run.perform(compose([*words, "picture=false", f"out='{folder}'"]))
    return folder


def _fit(
    outcome: CaseOutcome, method: str, words: Sequence[str], fit: Path, held_out: Path
) -> None:
    from trms_cli.composition.composer import compose
    from trms_cli.identification.population import SimulationCost
    from trms_cli.library.tasks.identify import identification_of

    overrides = [f"real='{fit}'", f"validation.real='{held_out}'", "jobs=1"]
    task = identification_of(compose([*overrides, *outcome.case.identify, *words], "identify"))
    problem = task.problem
    length = problem.window_length
    if not outcome.white:
        outcome.free = len(problem.free)
        white = window_runs(problem.model, problem.validation, length)
        outcome.white = error_figures(white)
        dataset = problem.validation[0]
        outcome.measured = {"time": dataset.time} | {
            s.name: dataset.measurements[:, i] for i, s in enumerate(dataset.outputs)
        }
        outcome.white_trace = _trace(white)
    begin = process_time()
    result: FitResult = task.method.fit(problem, SilentProgress())
    seconds = process_time() - begin
    runs = window_runs(with_values(problem.model, result.values), problem.validation, length)
    outcome.fits.append(
        GreyboxFit(
            method,
            error_figures(runs),
            SimulationCost(problem)(result.theta),
            seconds,
            result.evaluations,
            [(at.evaluations, at.seconds, at.cost) for at in result.history],
            dict(result.values),
            _trace(runs),
        )
    )


def _trace(runs: Sequence[Any]) -> dict[str, Any]:
    simulated = np.where(np.isfinite(runs[0].simulated), runs[0].simulated, np.nan)
    return {s.name: simulated[:, i] for i, s in enumerate(runs[0].dataset.outputs)}


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """What the runs say is said by the tables."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
