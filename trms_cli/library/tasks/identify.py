"""A fit: problem, result, figures as ``trms.identification/1``, findings, files."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import model_of_choice
from trms_cli.core import wording
from trms_cli.core.errors import EXIT_OK, SimulationError
from trms_cli.core.findings import NextCommand, json_data
from trms_cli.core.invocation import command_line, program
from trms_cli.core.versions import versions
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.findings import findings, in_short
from trms_cli.identification.free_runs import (
    Assessment,
    WindowRuns,
    add_free_runs,
    assess,
    at_bounds,
    error_figures,
)
from trms_cli.identification.problem import FitOutcome as Ended
from trms_cli.identification.problem import FitProblem, FitResult
from trms_cli.library.tasks import files
from trms_cli.library.tasks.identification_request import Identification, identification_of
from trms_cli.library.tasks.task import Done, Listener
from trms_cli.models.model import names

SCHEMA = "trms.identification/1"
#: Files of a fit in its folder.
MODEL_NAME, DOCUMENT_NAME, PAGE_NAME = "model.yaml", "identification.json", "identification.html"


def perform(composition: Composition, listener: Listener, folder: Path | None = None) -> Done:
    """Fit what a configuration asks for; in the folder of an earlier fit, go on with that.

    Raises KeyboardInterrupt in a sweep if it was stopped: the sweep ends too.
    """
    begin = perf_counter()
    from trms_cli.reporting.progress import STATE_NAME, FitProgress
    from trms_cli.runs.run_folder import write_document

    request = identification_of(composition)
    origin = files.origin_of(composition) if request.problem.free else None
    again = folder is not None
    folder = folder or composition.folder("identify")
    if not again:
        files.write_config(composition, folder)
    listener.begin(_words(composition, request), dict(_facts(request)))
    progress = FitProgress(folder / STATE_NAME, resume=again, quiet=listener.quiet)
    with progress:
        result = request.method.fit(request.problem, progress)
    if again:  # now that it is known to be the same search
        files.write_config(composition, folder)
    _require_simulated(result)
    fitted = assess(request.problem, result)
    model = files.write_fitted_model(
        request, fitted.result, fitted.deviations, origin, folder / MODEL_NAME
    )
    add_free_runs(request.problem, fitted, files.network_of(result, model))
    document = document_of(composition, request, fitted, perf_counter() - begin)
    written = {"model": model, "numbers": folder / DOCUMENT_NAME}
    write_document(document, written["numbers"])
    then = _next(composition, request, document, folder)
    told = findings(document, fitted, then)
    if composition.config["picture"]:
        from trms_cli.reporting.page import write_page

        page = write_page(told, folder / PAGE_NAME, interactive=False)
        written |= {"page": page} if page else {}
    if progress.exit_code is not None and composition.job is not None:
        raise KeyboardInterrupt
    spent = {
        "fit": f"{wording.count(result.evaluations, 'simulation')} in "
        f"{wording.seconds(result.seconds)}, cost {result.cost:.6g}",
        "time": f"{wording.seconds(perf_counter() - begin)} in all",
    }
    code = EXIT_OK if progress.exit_code is None else progress.exit_code
    told = replace(told, facts=spent, files=written, warnings=())
    if composition.job is not None:
        told = replace(told, lead=[in_short(document)])
    return Done(folder, told, exit_code=code, objective=result.cost)


def _require_simulated(result: FitResult) -> None:
    """A fit that could simulate nothing has no model to write."""
    if result.outcome is Ended.FAILED:
        problem, _, remedy = result.outcome.value.partition(": ")
        raise SimulationError(problem, where="model", remedy=remedy)


def _words(composition: Composition, request: Identification) -> str:
    choices = composition.choices
    model = wording.model_name(model_of_choice(composition))
    words = [str(choices.get("method")), f"model {model}"]
    if choices.get("effect"):
        words.append(f"effect {', '.join(choices['effect'])}")
    if request.driven:
        words.append(f"driven by {', '.join(request.driven)}")
    if request.problem.free:
        words.append(f"{wording.count(len(request.problem.free), 'parameter')} free")
    return " · ".join(words)


def _facts(request: Identification) -> Iterator[tuple[str, str]]:
    problem = request.problem
    yield "fitted", "; ".join(map(_part, problem.datasets))
    if problem.validation:
        yield "held out", "; ".join(map(_part, problem.validation))
    else:
        yield "held out", "nothing: how good the model is on other data stays unknown"
    remarks: dict[str, None] = {}
    for dataset in (*problem.datasets, *problem.validation):
        remarks |= dict.fromkeys(dataset.remarks)
    if request.idle:
        remarks[f"no part in the equations, so not fitted: {', '.join(request.idle)}"] = None
    if remarks:
        yield "note", "\n".join(remarks)
    if request.admission.warnings:
        yield "warning", "\n".join(map(str, request.admission.warnings))


def _part(dataset: Dataset) -> str:
    return (
        f"{dataset.name} {dataset.time[0]:g} to {dataset.time[-1] + dataset.sample_time:g} s "
        f"at {1 / dataset.sample_time:g} Hz"
    )


def _next(
    composition: Composition, request: Identification, document: Mapping[str, Any], folder: Path
) -> list[NextCommand]:
    from trms_cli.reporting.progress import STATE_NAME

    model = shlex.quote(str(folder / MODEL_NAME))
    commands = [
        NextCommand(f"{program()} validate model={model} {_judging(composition, request)}"),
        NextCommand(f"{program()} run model={model}"),
    ]
    if document["outcome"] in ("interrupted", "budget_spent") and (folder / STATE_NAME).is_file():
        line = f"{program()} identify resume={shlex.quote(str(folder))}"
        longer = _more(composition.config["method"])
        budget = document["outcome"] == "budget_spent"
        commands.append(NextCommand(f"{line} {longer}" if longer and budget else line))
    return commands


def _judging(composition: Composition, request: Identification) -> str:
    """The recording, read as the fit read it, and of it what was held out."""
    first = (*request.problem.validation, *request.recordings)[0]
    words = [f"real={shlex.quote(first.source)}"]
    if request.driven:
        words.append(f"driven=[{','.join(request.driven)}]")
    words += [shlex.quote(w) for w in composition.overrides if w.startswith("data.")]
    parted = request.problem.validation and first.source == request.recordings[0].source
    if parted and not any(w.startswith("data.start=") for w in words):
        words.append(f"data.start={first.time[0]:g}")
    return " ".join(words)


def _more(method: Mapping[str, Any]) -> str:
    for key in ("generations", "evaluations", "iterations"):
        if isinstance(method.get(key), int):
            return f"method.{key}={2 * method[key]}"
    return ""


def document_of(
    composition: Composition, request: Identification, fitted: Assessment, seconds: float
) -> dict[str, Any]:
    """The document of a command that took `seconds`; figures that do not exist are null."""
    result, problem = fitted.result, request.problem
    content = {
        "schema": SCHEMA,
        "command": command_line(),
        "versions": versions(),
        "model": model_of_choice(composition),
        "effects": list(composition.config.get("effect") or {}),
        "method": composition.choices.get("method"),
        "settings": dict(composition.config["method"]),
        "driven": list(request.driven),
        "windows": {"length_s": problem.window_length, "stride_s": problem.window_stride},
        "seed": problem.seed,
        "recordings": [
            *(_recording(d, "fit") for d in problem.datasets),
            *(_recording(d, "held_out") for d in problem.validation),
        ],
        "admission": request.admission.as_data(),
        "outcome": result.outcome.name.lower(),
        "sentence": result.outcome.value,
        "settled": result.outcome.settled,
        "cost": result.cost,
        "evaluations": result.evaluations,
        "seconds": {"fit": result.seconds, "whole": seconds},
        "history": [list(point) for point in result.history],
        "parameters": _parameters(request.problem, fitted),
        "correlation": _correlation(fitted),
        **fitted.statistics,
        "errors": {
            part: {
                "before": _errors(fitted.before.get(part)),
                "after": _errors(fitted.after.get(part)),
            }
            for part in ("fit", "held_out")
        },
        "details": dict(result.details),
    }
    plain: dict[str, Any] = json_data(content)
    return plain


def _recording(dataset: Dataset, part: str) -> dict[str, Any]:
    return {
        "name": dataset.name,
        "source": dataset.source,
        "sha256": dataset.sha256,
        "part": part,
        "from_s": float(dataset.time[0]),
        "to_s": float(dataset.time[-1]),
        "samples": len(dataset),
        "sample_time_s": dataset.sample_time,
        "inputs": list(names(dataset.inputs)),
        "outputs": list(names(dataset.outputs)),
        "noise_sd": dict(zip(names(dataset.outputs), dataset.noise_sd.tolist(), strict=True)),
        "remarks": list(dataset.remarks),
    }


def _parameters(problem: FitProblem, fitted: Assessment) -> dict[str, Any]:
    values = fitted.result.values
    bounds = at_bounds(problem, values) if values else {}
    return {
        p.name: {
            "value": values[p.name],
            "sd": fitted.deviations[p.name],
            "unit": p.unit,
            "start": p.start,
            "prior_mean": p.prior_mean,
            "prior_sd": p.prior_sd,
            "lower": p.lower,
            "upper": p.upper,
            "at_bound": bounds.get(p.name),
        }
        for p in problem.free
        if p.name in values
    }


def _correlation(fitted: Assessment) -> dict[str, Any] | None:
    matrix = fitted.correlation
    if matrix is None:
        return None
    return {"names": list(fitted.result.values), "matrix": matrix}


def _errors(runs: Sequence[WindowRuns] | None) -> dict[str, Any] | None:
    return error_figures(runs) if runs else None
