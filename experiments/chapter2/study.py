"""What the study consists of: read from YAML, its signals built from the program's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import yaml

from experiments.study_file import read_as
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.references.signal import ReferenceSignal

FloatArray = npt.NDArray[np.float64]
HERE = Path(__file__).parent
STUDY = HERE / "study.yaml"


class Commands(msgspec.Struct, forbid_unknown_fields=True):
    """Evenly spaced values: commands in V, unless another unit is said."""

    points: int
    to: float
    start: float = msgspec.field(name="from")

    @property
    def values(self) -> FloatArray:
        return np.linspace(self.start, self.to, self.points)


class Sines(msgspec.Struct, forbid_unknown_fields=True):
    """Sines of one size at several frequencies."""

    amplitude: float  #: V
    offset: float  #: V
    frequencies: list[float]  #: Hz


class Rotors(msgspec.Struct, forbid_unknown_fields=True):
    """What the rotors alone are asked."""

    commands: Commands
    steps: list[float]  #: V
    step_duration: float  #: s
    sines: Sines


class Pair(msgspec.Struct, forbid_unknown_fields=True):
    """Commands of both rotors."""

    why: str
    duration: float  #: s
    u_v: dict[str, Any]
    u_h: dict[str, Any]


class BenchTests(msgspec.Struct, forbid_unknown_fields=True):
    """Instruments and sizes of the bench tests; units in the YAML."""

    repetitions: int
    speed_noise: float
    current_noise: float
    force_noise: float
    angle_quantum: float
    static_points: int
    run_down_speed: float
    run_down_speed_tail: float
    run_down_duration: float
    swing_start: float
    swing_duration: float
    yaw_commands: list[float]


class Friction(msgspec.Struct, forbid_unknown_fields=True):
    """What the rigs with a friction profile are asked; by ``vertical`` and ``horizontal``."""

    rates: Commands  #: rad/s
    swing_start: dict[str, float]  #: rad beside rest
    swing_duration: float  #: s
    drive: dict[str, dict[str, Any]]
    drive_duration: float  #: s


class Interface(msgspec.Struct, forbid_unknown_fields=True):
    """The interface circuits."""

    commands: Commands  #: V
    limits: dict[str, float]  #: V, by rotor


class Paths(msgspec.Struct, forbid_unknown_fields=True):
    """Multisines around an operating point; by command."""

    point: dict[str, float]  #: V
    rms: dict[str, float]  #: V
    larger: float  #: Factor of the large signal
    realisations: int
    periods: int  #: the last of which is looked at
    period: float  #: s
    hold: float  #: s, for which a value stands
    ratio: float  #: Of a line to the one below
    highest: float  #: Hz, of the lines that are shown


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The whole study."""

    sample_time: float  #: s
    substeps: int
    interface: Interface
    rotors: Rotors
    friction: Friction
    one_axis: dict[str, dict[str, list[tuple[float, float]]]]
    two_axes: dict[str, Pair]
    paths: Paths
    bench_tests: BenchTests


def read_study(path: Path = STUDY) -> Study:
    """The study of a YAML.

    Raises ConfigurationError if the file is not one.
    """
    return read_as(Study, path, "experiments/chapter2/study.yaml")


def signal(given: Mapping[str, Any], where: str) -> ReferenceSignal:
    """A signal of the library with other values for some of its keys.

    Raises ConfigurationError for an option that there is not, or a key that it does not have.
    """
    values = dict(given)
    name = values.pop("signal", "")
    file = config_folder() / "signal" / f"{name}.yaml"
    if not file.is_file():
        raise ConfigurationError(
            f"there is no signal {name!r}", where=f"{where}.signal", remedy="see trms list signal"
        )
    node = yaml.safe_load(file.read_text(encoding="utf-8")) | values
    reference = build(node, where)
    assert isinstance(reference, ReferenceSignal)
    return reference


def times(duration: float, sample_time: float) -> FloatArray:
    """Samples of a record, s, shape (n,)."""
    return np.arange(round(duration / sample_time), dtype=np.float64) * sample_time
