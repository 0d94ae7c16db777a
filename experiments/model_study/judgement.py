"""Models held against recordings that they were not fitted to, as ``trms validate`` does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.findings import json_data

ANGLES = ("alpha_v", "alpha_h")


@dataclass(frozen=True)
class Judgement:
    """A model on recordings."""

    #: RMS errors of free runs by channel and horizon (s, as text), SI units; infinite where the
    #: model ran away
    errors: Mapping[str, Mapping[str, float]]
    unchanged: Mapping[str, Mapping[str, float]]  #: Of the prediction that nothing changes
    one_step: Mapping[str, float]  #: RMS errors one step ahead
    failed_tests: int  #: Of the residuals one step ahead
    tests: int

    def relative(self, worst: float, channels: Sequence[str] = (), horizon: str = "") -> float:
        """Error over that of no change: geometric mean over channels and horizons.

        ``channels``, ``horizon``: all where empty. ``worst``: what counts as much at the most.
        """
        ratios = [
            min(self.errors[c][h] / self.unchanged[c][h], worst)
            for c in self.errors
            for h in self.errors[c]
            if (not channels or c in channels) and (not horizon or h == horizon)
        ]
        return float(np.exp(np.mean(np.log(ratios))))


def judge(
    models: Mapping[str, str],
    words: Sequence[str],
    horizons: Sequence[float],
    admitted_by: str = "",
) -> dict[str, Judgement]:
    """Judge models on the same recordings, over the same windows.

    One model says whether the recordings can be taken; that a bad fit finds them strange is the
    fit's fault.

    ``models``: what ``model=`` takes, by name. ``words``: of ``trms validate``. ``admitted_by``:
    that one, as ``model=`` takes it; empty: the first.
    """
    from trms_cli.composition.composer import Composition, compose
    from trms_cli.identification.data import load_datasets
    from trms_cli.identification.validation.document import model_document
    from trms_cli.identification.validation.validate import validate_all
    from trms_cli.library.tasks.subject import (
        driven_model,
        driven_recordings,
        model_of,
        several,
    )
    from trms_cli.library.tasks.validate import validation_of

    ahead = f"horizons=[{','.join(map(str, horizons))}]"

    def composed(model: str) -> Composition:
        return compose([f"model='{model}'", *words, ahead, "page=false"], "validate")

    compositions = {name: composed(model) for name, model in models.items()}
    first = composed(admitted_by or next(iter(models.values())))
    request = validation_of([first], ["first"])
    built = {name: model_of(own.config) for name, own in compositions.items()}
    real = several(first.config["real"], "real")
    datasets = {
        name: driven_recordings(load_datasets(real, model, request.data), request.driven)
        for name, model in built.items()
    }
    simulated = {name: driven_model(model, request.driven) for name, model in built.items()}
    with np.errstate(all="ignore"):
        validations = validate_all(simulated, datasets, request.options)
        documents = [json_data(model_document(validation)) for validation in validations]
    return {name: _judgement(d) for name, d in zip(models, documents, strict=True)}


def _judgement(document: Mapping[str, Any]) -> Judgement:
    table = document["by_horizon"]
    return Judgement(
        {c: {h: _number(row["rms"]) for h, row in rows.items()} for c, rows in table.items()},
        {c: {h: row["unchanged_rms"] for h, row in rows.items()} for c, rows in table.items()},
        {c: _number(figures["rms"]) for c, figures in document["one_step"].items()},
        document["residual_tests"]["failed"],
        document["residual_tests"]["count"],
    )


def _number(value: float | None) -> float:
    """Of a figure that is none where it is not finite."""
    return float("inf") if value is None else value
