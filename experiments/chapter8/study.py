"""What the study consists of, read from YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import yaml

from experiments.study_file import read_as
from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.robust_mpc import RobustMpc
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.models.newtonian import Newtonian

FloatArray = npt.NDArray[np.float64]
HERE = Path(__file__).parent
STUDY = HERE / "study.yaml"
PERIOD = 0.1


class Quick(msgspec.Struct, forbid_unknown_fields=True):
    """The part of the runs that a quick look takes."""

    controllers: list[str]
    observers: list[str]
    starts: int


class Runs(msgspec.Struct, forbid_unknown_fields=True):
    """Runs of the program."""

    duration: float
    settled: float
    controllers: dict[str, list[str]]
    observers: dict[str, list[str]]
    noisy: list[str]
    quick: Quick


class Coverage(msgspec.Struct, forbid_unknown_fields=True):
    """Polytopes against the nonlinear model."""

    sizes: list[float]
    components: list[int]
    points: int
    confidence: float


class Laws(msgspec.Struct, forbid_unknown_fields=True):
    """Laws on their polytopes."""

    components: list[int]
    points: int
    steps: int


class Standstill(msgspec.Struct, forbid_unknown_fields=True):
    """The yaw's gain where the tail rotor stands still."""

    yaw: float
    bounds: list[float]


class Domain(msgspec.Struct, forbid_unknown_fields=True):
    """A grid of starts: from, to, points."""

    yaw: tuple[float, float, int]
    pitch: tuple[float, float, int]


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The whole study."""

    seed: int
    starts: list[tuple[float, float]]
    runs: Runs
    coverage: Coverage
    laws: Laws
    standstill: Standstill
    domain: Domain


def read_study(path: Path = STUDY) -> Study:
    """The study of a YAML.

    Raises ConfigurationError if the file is not one.
    """
    return read_as(Study, path, "experiments/chapter8/study.yaml")


def controller(name: str = "robust_mpc", **other: Any) -> Any:
    """A controller as it is configured, with other values for some keys."""
    file = config_folder() / "controller" / f"{name}.yaml"
    node = yaml.safe_load(file.read_text(encoding="utf-8")) | other
    return build(node, "controller")


def online(**other: Any) -> RobustMpc:
    """The online controller as it is configured, with other values for some keys."""
    mpc = controller(**other)
    assert isinstance(mpc, RobustMpc)
    return mpc


def setup_of(model: Newtonian) -> ControlSetup:
    """The control period of the study."""
    return ControlSetup(model, PERIOD, np.zeros(model.n_u))


def start_state(model: Newtonian, start: tuple[float, float], hover: float = 0.0) -> FloatArray:
    """Rest at (yaw, pitch) with the main rotor at a speed, rad/s."""
    x = model.rest()
    x[model.state_index("alpha_h")], x[model.state_index("alpha_v")] = start
    x[model.state_index("omega_v")] = hover
    return x
