"""The fit of the Aero's normal state, and the free runs and residuals that judge it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

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
    ModelValidation,
    ValidationOptions,
    WindowOptions,
    validate_all,
)
from trms_cli.models.quanser_aero import QuanserAero

STUDY = Path(__file__).with_name("study.yaml")
_CHANNELS = ("alpha_v", "alpha_h")


@dataclass(frozen=True)
class AeroFit:
    """A fit of the study."""

    problem: FitProblem
    model: QuanserAero  #: With the fitted values
    result: FitResult


def read_study(path: Path = STUDY) -> dict[str, Any]:
    """The study's settings."""
    settings: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return settings


def problem_of(
    datasets: tuple[Dataset, ...],
    settings: Mapping[str, Any],
    without: Mapping[str, float] | None = None,
    jobs: int = 2,
) -> FitProblem:
    """What is fitted; parameters in ``without`` stay at the values given there."""
    fixed_values = {**settings["values"], **(without or {})}
    priors = {
        name: Prior(**prior) for name, prior in settings["free"].items() if name not in fixed_values
    }
    means = {name: prior.mean for name, prior in priors.items() if prior.mean is not None}
    model = QuanserAero(
        parameter_set=settings["set"], parameters={**means, **fixed_values}, rotor_speeds=False
    )
    return FitProblem(
        model=model,
        datasets=datasets,
        free=free_parameters(model.parameters, list(priors), priors=priors),
        window_length=settings["window"],
        seed=settings["seed"],
        jobs=jobs,
    )


def recording(folder: Path, file: str, settings: Mapping[str, Any]) -> Dataset:
    """A recording of the folder, resampled."""
    model = QuanserAero(parameter_set=settings["set"], rotor_speeds=False)
    options = DataOptions(
        quantum=settings["quantum"], noise_sd=settings["noise_sd"], resample=settings["sample_time"]
    )
    (dataset,) = load_datasets(str(folder / file), model, options)
    return dataset


def parts_of(dataset: Dataset, settings: Mapping[str, Any]) -> tuple[Dataset, Dataset]:
    """What is fitted, and what is held out."""
    (a, b), (c, d) = (
        [round(at / dataset.sample_time) for at in settings[name]] for name in ("part", "held_out")
    )
    return dataset.part(a, b), dataset.part(c, min(d, len(dataset)))


def fit_model(problem: FitProblem, settings: Mapping[str, Any]) -> AeroFit:
    """Fit it."""
    result = MultipleShooting(starts=settings["starts"]).fit(problem, SilentProgress())
    model = with_values(problem.model, result.values)
    assert isinstance(model, QuanserAero)
    return AeroFit(problem, model, result)


def errors(
    models: Mapping[str, QuanserAero], dataset: Dataset, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """By model and output: RMS of free runs by horizon, and the residuals' autocorrelation."""
    options = ValidationOptions(
        horizons=tuple(settings["horizons"]),
        windows=WindowOptions(
            start=settings["start"], history=settings["history"], stride=settings["stride"]
        ),
    )
    validations = validate_all(models, dict.fromkeys(models, (dataset,)), options)
    return {validation.name: _of_model(validation) for validation in validations}


def _of_model(validation: ModelValidation) -> dict[str, Any]:
    statistics: dict[str, Any] = {}
    for channel in _CHANNELS:
        free = {
            f"{horizon:g}": float(np.sqrt(np.nanmean(validation.pooled(channel, horizon) ** 2)))
            for horizon in validation.horizons
        }
        unchanged = {
            f"{h:g}": float(np.sqrt(np.nanmean(validation.pooled(channel, h, "unchanged") ** 2)))
            for h in validation.horizons
        }
        tests = validation.tests.of(channel)
        statistics[channel] = {
            "free_runs": free,
            "unchanged": unchanged,
            "autocorrelation": _first_autocorrelation(validation, channel),
            "tests_failed": [test.name for test in tests if test.failed(validation.tests.level)],
            "tests": len(tests),
        }
    return statistics


def _first_autocorrelation(validation: ModelValidation, channel: str) -> float:
    """Of the one-step errors at a lag of one sample; 0 for a model that leaves white noise."""
    (step,) = validation.one_steps
    error = step.errors[:, step.channels.index(channel)]
    error = error[np.isfinite(error)]
    error = error - error.mean()
    return float(np.dot(error[1:], error[:-1]) / np.dot(error, error))
