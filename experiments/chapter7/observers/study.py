"""What the study of observers consists of, read from YAML."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from experiments.study_file import read_as

HERE = Path(__file__).parent
STUDY = HERE / "study.yaml"


class Condition(msgspec.Struct, forbid_unknown_fields=True):
    """A kind of rig."""

    rig: list[str]  #: overrides of ``trms run``
    effects: list[list[str]] = []  #: in turn over the seeds
    torques: tuple[str, ...] = ("estimated",)  #: "estimated", "none"


class Recording(msgspec.Struct, forbid_unknown_fields=True):
    """A recording of a real rig."""

    file: str
    run: list[str]  #: overrides of ``trms run``
    observers: dict[str, list[str]] = {}  #: further ones, by observer


class FreePrediction(msgspec.Struct, forbid_unknown_fields=True):
    """How far the model is to see from an estimate, on recordings."""

    horizons: list[float]  #: s
    every: float  #: s between two starts
    begin: float  #: s before the first one


class Traces(msgspec.Struct, forbid_unknown_fields=True):
    """Records of which the estimates of some observers are drawn beside the truth."""

    observers: list[str]
    records: dict[str, TracedRecord]


class TracedRecord(msgspec.Struct, forbid_unknown_fields=True):
    """One of them."""

    condition: str
    seed: int
    torques: str = "estimated"


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The whole study."""

    duration: float  #: s
    transient: float
    seeds: int
    maker: list[str]
    references: list[str]
    observers: list[str]
    against: str
    channels: dict[str, list[str]]
    conditions: dict[str, Condition]
    recordings: dict[str, Recording]
    free_prediction: FreePrediction
    traces: Traces


@dataclass(frozen=True)
class Job:
    """One record and all that is done with it."""

    condition: str
    seed: int
    overrides: tuple[str, ...]  #: Of the run that makes the record
    torques: tuple[str, ...]


def read_study(path: Path = STUDY) -> Study:
    """The study of a YAML.

    Raises ConfigurationError if the file is not one.
    """
    return read_as(Study, path, "experiments/chapter7/observers/study.yaml")


def jobs_of(study: Study) -> list[Job]:
    """Every record of the study."""
    jobs = []
    for name, condition in study.conditions.items():
        for seed in range(1, study.seeds + 1):
            effects = condition.effects[seed % len(condition.effects)] if condition.effects else []
            overrides = (
                *study.maker,
                f"ref={study.references[seed % len(study.references)]}",
                *(override.replace("{seed}", str(seed)) for override in condition.rig),
                *([f"effect=[{','.join(effects)}]"] if effects else []),
                f"sim.duration={study.duration}",
                f"seed={seed}",
            )
            jobs.append(Job(name, seed, overrides, condition.torques))
    return jobs
