"""All results of the study, as figures with a name that can be held against recorded ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from experiments.chapter6.cases import ANGLES, Plans, Run, study_cases, study_predictions
from experiments.chapter6.decrease import Claim, study_decrease
from experiments.chapter6.domain import (
    Arrivals,
    FeasibleStates,
    study_box,
    study_loops,
    study_slice,
)
from experiments.chapter6.iterations import Economy, study_iterations
from experiments.chapter6.rig import Record
from experiments.chapter6.study import Study
from experiments.command_line import process_pool
from experiments.expected_figures import json_text, rounded

_CASE_FIGURES = ("rmse", "overshoot_percent", "settling_time_s")


@dataclass(frozen=True)
class Results:
    """What the parts of the study found."""

    runs: list[Run]
    plans: dict[str, Plans]
    claims: list[Claim]
    records: dict[str, list[Record]]
    box: FeasibleStates
    slices: dict[str, FeasibleStates]
    arrivals: list[Arrivals]
    economy: list[Economy]


def compute(study: Study, jobs: int, said: Callable[[str], None]) -> Results:
    """Every part; what measures times comes last and alone."""
    parts: dict[str, tuple[Any, ...]] = {
        "cases": (study_cases, study.cases),
        "decrease": (study_decrease, study.decrease, study.seed),
        "box": (study_box, study.domain, study.seed),
        "loops": (study_loops, study.domain, study.seed),
        **{name: (study_slice, study.domain, name) for name in study.domain.slices},
        "predictions": (study_predictions, study.predictions),
    }
    results: dict[str, Any] = {}
    if jobs <= 1:
        for name, (work, *arguments) in parts.items():
            results[name] = work(*arguments)
            said(name)
        economy = study_iterations(study.iterations)
    else:
        with process_pool(jobs) as pool:
            futures: dict[str, Future[Any]] = {
                name: pool.submit(work, *arguments) for name, (work, *arguments) in parts.items()
            }
            for name, future in futures.items():
                results[name] = future.result()
                said(name)
            economy = pool.submit(study_iterations, study.iterations).result()
    said("iterations")
    claims, records = results["decrease"]
    return Results(
        results["cases"],
        results["predictions"],
        claims,
        records,
        results["box"],
        {name: results[name] for name in study.domain.slices},
        results["loops"],
        economy,
    )


def figures_of(results: Results) -> dict[str, dict[str, float]]:
    """Figures by part and name; times are left out."""
    cases: dict[str, float] = {}
    for run in results.runs:
        for angle in ANGLES:
            channel = run.score["channels"][angle]
            for key in _CASE_FIGURES:
                if channel.get(key) is not None:
                    cases[f"{run.case}/{run.controller}/{angle}/{key}"] = channel[key]
        cases[f"{run.case}/{run.controller}/failed"] = run.statuses.get("failed", 0)
    decrease: dict[str, float] = {}
    for claim in results.claims:
        for key in ("held", "kept", "kept_with_move"):
            decrease[f"{claim.mode}/{key}"] = getattr(claim, key)
    domain: dict[str, float] = {}
    for place, feasible_states in {"box": results.box, **results.slices}.items():
        for (terminal, horizon), feasible in feasible_states.feasible.items():
            domain[f"{place}/{terminal}/{horizon}"] = float(feasible.mean())
    for row in results.arrivals:
        domain[f"loops/{row.terminal}/{row.horizon}/arrived"] = row.arrived
    iterations = {f"{r.horizon}/{r.reference}/{r.count}": r.cost for r in results.economy}
    return {"cases": cases, "decrease": decrease, "domain": domain, "iterations": iterations}


def document_of(full: Mapping[str, Any], quick: Mapping[str, Any]) -> str:
    """The text of expected.json."""
    return json_text({"schema": "trms.chapter6/1", "full": rounded(full), "quick": rounded(quick)})


def details_of(results: Results) -> dict[str, Any]:
    """Everything that the tables show, for a file."""
    return {
        "schema": "trms.chapter6.results/1",
        "figures": rounded(figures_of(results)),
        "decrease": [_plain(claim) for claim in results.claims],
        "loops": [_plain(row) for row in results.arrivals],
        "iterations": [_plain(row) for row in results.economy],
        "statuses": {f"{r.case}/{r.controller}": r.statuses for r in results.runs},
    }


def _plain(row: Any) -> dict[str, Any]:
    return {key: rounded(value) for key, value in vars(row).items()}
