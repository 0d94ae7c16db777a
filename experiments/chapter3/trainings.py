"""One training of the study: a recording, a method, a seed; its errors in physical units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from experiments.chapter3.methods import method, option
from experiments.chapter3.recordings import recording
from experiments.study_file import merged
from trms_cli.core.arrays import FloatArray
from trms_cli.core.plugins import build
from trms_cli.identification.blackbox.prediction_error import (
    Samples,
    Structure,
    predict_samples,
    rms,
    sample_signals,
    simulate_network,
)
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FitProblem, FitResult, SilentProgress
from trms_cli.models.innovation_network import structure_from_data
from trms_cli.models.model import Model
from trms_cli.models.network import Network

SETTINGS = Path(__file__).with_name("study.yaml")
PARTS = ("fitted", "validation", "test")


@dataclass(frozen=True)
class Job:
    """What is trained."""

    system: str  #: Key of ``systems`` in the settings
    label: str  #: Of the training in tables
    #: ``method``, ``training``: Options of ``configs/method`` and ``configs/training``
    method: str
    training: str
    seed: int  #: Of the first weights
    changes: Mapping[str, Any] = field(default_factory=dict)  #: Keys of the method
    excitation: Mapping[str, Any] | None = None  #: Another one for the fitted recording


@dataclass(frozen=True)
class TrainingResult:
    """What came out."""

    job: Job
    epochs: int
    kept_epoch: int
    weights: int
    seconds: float
    outcome: str
    one_step: dict[str, dict[str, float]]  #: By part and output: RMS error in the output's unit
    free_run: dict[str, dict[str, float]]  #: infinite after a divergence
    #: ``losses``, ``times``: Normalised loss after each epoch, and the time until then, s
    losses: list[float]
    times: list[float]
    structure: dict[str, Any]  #: Plain data of the trained network
    network: dict[str, Any]  #: Plain data of the trained network


@cache
def settings() -> dict[str, Any]:
    """The study's settings."""
    return dict(yaml.safe_load(SETTINGS.read_text(encoding="utf-8")))


@cache
def model_of(system: str) -> Model:
    """The rig's equations."""
    model = build(option("model", settings()["systems"][system]["model"]), "model")
    assert isinstance(model, Model)
    return model


@cache
def make_recording(system: str, part: str, short: float = 1.0) -> Dataset:
    """A recording of a system; ``short`` is the share of its duration."""
    own = settings()["systems"][system]
    return recording(
        own["model"],
        own["excitation"],
        duration=short * settings()["durations"][part],
        sample_time=settings()["sample_time"],
        seed=own["draws"][part],
        name=f"{system} {part}",
    )


def run_job(job: Job, short: float = 1.0) -> TrainingResult:
    """Train and judge."""
    # Loaded before any time is taken.
    from scipy import cluster, linalg, optimize  # noqa: F401

    changes = merged(settings()["method"], settings()["systems"][job.system]["method"])
    if job.method in ("rbf", "wavelet"):
        changes.pop("hidden", None)
    changes = merged(changes, job.changes)
    fitted = make_recording(job.system, "fitted", short)
    if job.excitation is not None:
        fitted = recording(
            settings()["systems"][job.system]["model"],
            job.excitation,
            duration=fitted.duration,
            sample_time=fitted.sample_time,
            seed=0,
            name=f"{job.system} {job.label}",
        )
    parts = {
        "fitted": fitted,
        "validation": make_recording(job.system, "validation", short),
        "test": make_recording(job.system, "test", short),
    }
    problem = FitProblem(
        model=model_of(job.system),
        datasets=(fitted,),
        validation=(parts["validation"],),
        seed=job.seed,
    )
    result = method(job.method, job.training, changes).fit(problem, SilentProgress())
    return _judged(job, result, parts)


def _judged(job: Job, result: FitResult, parts: Mapping[str, Dataset]) -> TrainingResult:
    document = result.model_document
    assert document is not None
    structure = structure_from_data(document["structure"])
    network = Network.from_data(document["network"])
    stages = result.details["stages"]
    one_step, free_run = {}, {}
    for part, dataset in parts.items():
        samples = sample_signals(dataset, structure)
        one_step[part] = _errors(structure, samples, predict_samples(structure, network, samples))
        free_run[part] = _errors(structure, samples, simulate_network(structure, network, samples))
    return TrainingResult(
        job,
        sum(stage["epochs"] for stage in stages),
        stages[-1]["kept_epoch"],
        result.details["weights"],
        result.seconds,
        stages[-1]["outcome"],
        one_step,
        free_run,
        [point.cost for point in result.history],
        [point.seconds for point in result.history],
        dict(document["structure"]),
        dict(document["network"]),
    )


def _errors(structure: Structure, samples: Samples, played: FloatArray) -> dict[str, float]:
    first = structure.longest_lag
    errors = rms(played[first:] - samples.outputs[first:])
    return {
        name: float(error) if np.isfinite(error) else float("inf")
        for name, error in zip(structure.outputs, errors, strict=True)
    }
