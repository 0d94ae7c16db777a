"""What the study consists of, read from YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

from experiments.expected_figures import Tolerance
from experiments.study_file import read_as

HERE = Path(__file__).parent
STUDY = HERE / "study.yaml"

Family = Literal["white", "grey", "network", "linear"]


class RigSettings(msgspec.Struct, forbid_unknown_fields=True):
    """The rigs that are drawn."""

    of: int  #: Rigs that are drawn, from seed 1 on
    seeds: list[int]  #: Those that take part
    scatter: float  #: Of the parameters, as a share of the priors' deviations
    laws: float  #: Share of the imperfect laws of the sealed sets
    effects: dict[str, float]  #: Sizes of what no model has, ``<effect>.<size>``

    @property
    def every(self) -> list[int]:
        """Seeds of all that are drawn."""
        return list(range(1, self.of + 1))


class RecordingSettings(msgspec.Struct, forbid_unknown_fields=True):
    """The recordings of each rig, s."""

    sample_time: float
    settling: float
    fitted: float
    judged: tuple[float, float]  #: In open loop, under two PIDs


class Entrant(msgspec.Struct, forbid_unknown_fields=True):
    """A model as it is, or one that is fitted."""

    family: Family
    name: str  #: In tables and figures
    fit: list[str] = []  #: Words of ``trms identify``; empty: nothing is fitted
    model: str = ""  #: Option of ``model`` of one that is not fitted; empty: the entrant's key
    rigs: int = 0  #: On how many of the rigs it is tried, the first ones; 0: on all


class Task(msgspec.Struct, forbid_unknown_fields=True):
    """A closed loop."""

    why: str
    words: list[str]  #: Of ``trms run``


class LoopSettings(msgspec.Struct, forbid_unknown_fields=True, rename={"begin": "from"}):
    """The closed loops."""

    duration: float  #: s
    begin: float  #: s, errors count from here on
    tasks: dict[str, Task]
    ranked: list[str]  #: Tasks that the ranking is of
    level: float  #: Share below which a difference is none
    only: list[str] = []

    def chosen(self) -> dict[str, Task]:
        """The tasks that are done."""
        return {name: t for name, t in self.tasks.items() if not self.only or name in self.only}


class AcceptanceSettings(msgspec.Struct, forbid_unknown_fields=True):
    """Which laws are tried with which models."""

    duration: float  #: s
    controllers: list[str]
    models: list[str]


class FormSettings(msgspec.Struct, forbid_unknown_fields=True):
    """The two forms of the beam on the record, driven by the measured rotors."""

    driven: str
    data: list[str]
    free: list[str]
    relative_sd: float
    models: dict[str, str]  #: Names by option


class RecordSettings(msgspec.Struct, forbid_unknown_fields=True):
    """The record of a real rig."""

    split: float  #: s, what comes later is judged
    data: list[str]
    models: dict[str, Entrant]
    forms: FormSettings


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The whole study."""

    rigs: RigSettings
    recordings: RecordingSettings
    models: dict[str, Entrant]
    horizons: list[float]  #: s, of free runs
    worst: float  #: Largest error over that of no change
    loops: LoopSettings
    acceptance: AcceptanceSettings
    record: RecordSettings | None
    tolerances: dict[str, Tolerance]
    only: list[str] = []

    def entrants(self) -> dict[str, Entrant]:
        """The models that take part."""
        return {name: e for name, e in self.models.items() if not self.only or name in self.only}

    def entrants_of(self, seed: int) -> dict[str, Entrant]:
        """Those that are tried on a rig."""
        place = self.rigs.seeds.index(seed)
        return {n: e for n, e in self.entrants().items() if not e.rigs or place < e.rigs}


def read_study(path: Path = STUDY, *, quick: bool = False) -> Study:
    """The study of a YAML, or the quick one in it.

    Raises ConfigurationError if the file is not one.
    """
    example = "experiments/model_study/study.yaml"
    return read_as(Study, path, example, quick=quick)
