"""What chapter 7 consists of, read from YAML: pairs of observer and controller, rigs, cases."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from experiments.study_file import read_as

HERE = Path(__file__).parent
STUDY = HERE / "study.yaml"
CONFIGS = HERE / "configs"  #: Options of ``trms run`` that the study adds


class Case(msgspec.Struct, forbid_unknown_fields=True):
    """A reference, and what happens during it."""

    run: list[str]  #: overrides of ``trms run``
    duration: float  #: s
    what: str


class Part(msgspec.Struct, forbid_unknown_fields=True):
    """Cases on one rig."""

    about: str
    rig: list[str]  #: overrides of ``trms run``
    cases: dict[str, Case]


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The whole study."""

    every: list[str]
    encoder_step: float  #: rad
    last: float  #: s
    quick: float  #: s
    tolerances: dict[str, float]
    pairs: dict[str, list[str]]
    more_pairs: dict[str, list[str]]
    parts: dict[str, Part]


@dataclass(frozen=True)
class Job:
    """One run."""

    part: str
    case: str
    pair: str
    overrides: tuple[str, ...]  #: What follows ``trms run``

    @property
    def key(self) -> str:
        """Its name in documents."""
        return f"{self.part}/{self.case}/{self.pair}"

    @property
    def is_blind(self) -> bool:
        """Whether its rig is of the blind sets' code."""
        return "plant=blind_rig" in self.overrides


def read_study(path: Path = STUDY) -> Study:
    """The study of a YAML.

    Raises ConfigurationError if the file is not one.
    """
    return read_as(Study, path, "experiments/chapter7/study.yaml")


def jobs_of(study: Study, *, quick: bool = False, all_pairs: bool = False) -> list[Job]:
    """Every run of the study; with ``quick`` short ones."""
    pairs = study.pairs | (study.more_pairs if all_pairs else {})
    return [
        Job(
            name,
            case_name,
            pair,
            (
                *part.rig,
                *overrides,
                *case.run,
                *study.every,
                f"sim.duration={min(case.duration, study.quick) if quick else case.duration}",
            ),
        )
        for name, part in study.parts.items()
        for case_name, case in part.cases.items()
        for pair, overrides in pairs.items()
    ]
