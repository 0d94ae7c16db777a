"""What the study consists of, read from YAML: questions to ``trms stability``."""

from __future__ import annotations

from pathlib import Path

import msgspec

from experiments.expected_figures import Tolerance
from experiments.study_file import read_as

HERE = Path(__file__).parent
STUDY = HERE / "study.yaml"


class Question(msgspec.Struct, forbid_unknown_fields=True):
    """One call of ``trms stability``."""

    why: str  #: what it is for, in a few words
    overrides: list[str]  #: as typed
    figures: list[str] = []  #: keys of ``results`` that are recorded, as ``modes.0.frequency_hz``
    tables: list[int] = []  #: tables that the page shows, by their place
    pictures: dict[str, str] = {}  #: figures that are kept: file name by the figure's own
    shown: bool = True  #: whether the page of the chapter shows its figures
    quick: bool = False  #: whether the quick study has it


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The whole study."""

    questions: dict[str, Question]
    tolerance: Tolerance


def read_study(path: Path = STUDY, *, quick: bool = False) -> Study:
    """The study of a YAML, or the quick part of it.

    Raises ConfigurationError if the file is not one.
    """
    study = read_as(Study, path, str(STUDY))
    if quick:
        study.questions = {name: q for name, q in study.questions.items() if q.quick}
    return study
