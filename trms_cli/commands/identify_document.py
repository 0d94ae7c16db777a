"""``trms.identification/1``: all figures of a fit as one JSON document."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trms_cli.commands.identify_assessment import Assessment, at_bounds
from trms_cli.commands.identify_request import Identification
from trms_cli.commands.run_assembly import versions
from trms_cli.composition.composer import Composition
from trms_cli.core.invocation import command_line
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.free_runs import WindowRuns, error_figures
from trms_cli.models.model import names

SCHEMA = "trms.identification/1"


def document_of(
    composition: Composition, asked: Identification, fitted: Assessment, seconds: float
) -> dict[str, Any]:
    """The document; figures that do not exist are null.

    Parameters
    ----------
    seconds : float
        Of the whole command, s.
    """
    result, problem = fitted.result, asked.problem
    content = {
        "schema": SCHEMA,
        "command": command_line(),
        "versions": versions(),
        "model": composition.choices.get("model"),
        "effects": list(composition.config.get("effect") or {}),
        "method": composition.choices.get("method"),
        "settings": dict(composition.config["method"]),
        "driven": list(asked.driven),
        "windows": {"length_s": problem.window_length, "stride_s": problem.window_stride},
        "seed": problem.seed,
        "recordings": [
            *(_recording(d, "fit") for d in problem.datasets),
            *(_recording(d, "held_out") for d in problem.validation),
        ],
        "admission": asked.admission.as_data(),
        "outcome": result.outcome.name.lower(),
        "sentence": result.outcome.value,
        "settled": result.outcome.settled,
        "cost": result.cost,
        "evaluations": result.evaluations,
        "seconds": {"fit": result.seconds, "whole": seconds},
        "history": [list(point) for point in result.history],
        "parameters": _parameters(asked, fitted),
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
    plain = as_json(content)
    assert isinstance(plain, dict)
    return plain


def as_json(value: Any) -> Any:
    """Arrays as lists, numbers that are not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return as_json(value.tolist())
    if isinstance(value, (list, tuple)):
        return [as_json(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


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


def _parameters(asked: Identification, fitted: Assessment) -> dict[str, Any]:
    values = fitted.result.values
    bounds = at_bounds(asked, values) if values else {}
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
        for p in asked.problem.free
        if p.name in values
    }


def _correlation(fitted: Assessment) -> dict[str, Any] | None:
    matrix = fitted.correlation
    if matrix is None:
        return None
    return {"names": list(fitted.result.values), "matrix": matrix}


def _errors(runs: Sequence[WindowRuns] | None) -> dict[str, Any] | None:
    return error_figures(runs) if runs else None
