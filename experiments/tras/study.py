"""The two fits of the study, and the free runs that judge them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from trms_cli.core.plugins import build
from trms_cli.effects.extended_model import extend_model
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.multiple_shooting import MultipleShooting
from trms_cli.identification.problem import (
    FitProblem,
    FitResult,
    Prior,
    SilentProgress,
    free_parameters,
    with_values,
)
from trms_cli.identification.validation.validate import (
    ValidationOptions,
    WindowOptions,
    common_windows,
    free_runs,
    lead_samples,
    predict_one_step,
)
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model
from trms_cli.models.tras import Tras
from trms_cli.simulation.rollout import Rollout

STUDY = Path(__file__).with_name("study.yaml")
#: How a window may start: by the filter, by the model's run over the seconds before, by itself.
KINDS = ("estimated", "moving_horizon", "fitted")


@dataclass(frozen=True)
class TrasFit:
    """One fit of the study."""

    problem: FitProblem
    model: Model  #: With the fitted values
    result: FitResult


def read_study(path: Path = STUDY) -> dict[str, Any]:
    """The study's settings."""
    settings: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return settings


def model_of(folder: Path, settings: Mapping[str, Any], fit: Mapping[str, Any]) -> Model:
    """The model with its effects, driven as the fit has it."""
    main, tail = (
        str(folder / f"static_{rotor}.csv") if fit["curves"] else None for rotor in ("main", "tail")
    )
    effects = {name: build(node, name) for name, node in settings["effects"].items()}
    model = extend_model(Tras(main_curve=main, tail_curve=tail), effects)
    return DrivenModel(model, fit["driven"]) if fit["driven"] else model


def parts_of(
    folder: Path, settings: Mapping[str, Any], fit: Mapping[str, Any]
) -> tuple[Dataset, Dataset]:
    """What is fitted, and what is held out."""
    whole = model_of(folder, settings, {**fit, "driven": []})
    options = DataOptions(
        command_delay=settings["command_delay"],
        noise_sd=settings["noise_sd"],
        quantum=settings["quantum"],
    )
    (dataset,) = load_datasets(str(folder / "closed_loop.csv"), whole, options)
    if fit["driven"]:
        dataset = dataset.driven_by(fit["driven"])
    cut = round(settings["split"] / dataset.sample_time)
    return dataset.part(0, cut), dataset.part(cut, len(dataset))


def fit_first_part(
    folder: Path, settings: Mapping[str, Any], fit: Mapping[str, Any], jobs: int = 2
) -> TrasFit:
    """Fit the first part."""
    first, _ = parts_of(folder, settings, fit)
    return _fit_to((first,), folder, settings, fit, jobs)


def cross_validated(
    folder: Path, settings: Mapping[str, Any], fit: Mapping[str, Any], jobs: int = 2
) -> dict[str, Any]:
    """Errors on each of several equal parts of the record, fitted to the others; pooled RMS.

    The same settings as everywhere. One part at the end judges a model where yaw had not been
    before; here most of its range has been visited by what is fitted.
    """
    first, rest = parts_of(folder, settings, fit)
    cuts = np.linspace(0, len(first) + len(rest), settings["folds"] + 1).round().astype(int)
    whole = _concatenate(first, rest)
    fold_errors: list[dict[str, Any]] = []
    for a, b in pairwise(cuts.tolist()):
        others = tuple(part for part in (whole.part(0, a), whole.part(b, len(whole))) if len(part))
        model = _fit_to(others, folder, settings, fit, jobs).model
        fold_errors.append(errors(model, whole.part(a, b), settings))
    pooled: dict[str, Any] = {}
    for channel in fold_errors[0]:
        weights = np.array([fold[channel]["windows"] for fold in fold_errors], dtype=float)
        pooled[channel] = {
            key: float(
                np.sqrt(
                    np.average([fold[channel][key] ** 2 for fold in fold_errors], weights=weights)
                )
            )
            for key in (*KINDS, "unchanged")
        } | {"windows": int(weights.sum())}
    return {"pooled": pooled, "folds": fold_errors}


def _concatenate(first: Dataset, rest: Dataset) -> Dataset:
    return replace(
        first,
        time=np.concatenate([first.time, rest.time]),
        commands=np.vstack([first.commands, rest.commands]),
        measurements=np.vstack([first.measurements, rest.measurements]),
    )


def _fit_to(
    datasets: tuple[Dataset, ...],
    folder: Path,
    settings: Mapping[str, Any],
    fit: Mapping[str, Any],
    jobs: int,
) -> TrasFit:
    model = model_of(folder, settings, fit)
    priors = {name: Prior(relative_sd=share) for name, share in fit["priors"].items()}
    problem = FitProblem(
        model=model,
        datasets=datasets,
        free=free_parameters(model.parameters, fit["free"], priors=priors),
        window_length=settings["window"],
        seed=settings["seed"],
        jobs=jobs,
    )
    result = MultipleShooting(starts=settings["starts"]).fit(problem, SilentProgress())
    return TrasFit(problem, with_values(model, result.values), result)


def errors(model: Model, dataset: Dataset, settings: Mapping[str, Any]) -> dict[str, Any]:
    """RMS of the free runs' errors, by output and by how their windows start, SI units."""
    window_settings = settings["judged"]
    horizon = window_settings["horizon"]
    rollout = Rollout(model, dataset.sample_time)
    rms_errors: dict[str, Any] = {}
    one_step = None
    for kind in KINDS:
        options = ValidationOptions(
            horizons=(horizon,),
            windows=WindowOptions(
                start=kind,  # type: ignore[arg-type]
                history=window_settings["history"],
                stride=window_settings["stride"],
            ),
        )
        if one_step is None:
            one_step = predict_one_step(model, dataset, rollout, options.predictor)
        lead = lead_samples([model], dataset, options)
        firsts = common_windows(dataset, options, lead, math.inf)
        runs = free_runs(model, dataset, rollout, one_step, firsts, options)
        window = runs.windows[horizon]
        for i, channel in enumerate(window.channels):
            values = window.errors[..., i]
            rms_errors.setdefault(channel, {})[kind] = float(np.sqrt(np.nanmean(values**2)))
            rms_errors[channel]["windows"] = len(window.first)
            rms_errors[channel]["unchanged"] = float(
                np.sqrt(np.nanmean(window.unchanged[..., i] ** 2))
            )
    return rms_errors
