"""What the study consists of, read from YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from experiments.chapter6.rig import state_at
from experiments.expected_figures import Tolerance
from experiments.study_file import read_as
from trms_cli.controllers.newton_mpc import NewtonMpc

FloatArray = npt.NDArray[np.float64]
HERE = Path(__file__).parent
STUDY = HERE / "study.yaml"


class Case(msgspec.Struct, forbid_unknown_fields=True):
    """References of both axes."""

    why: str
    ref: str
    alpha_v: dict[str, float]
    alpha_h: dict[str, float]


class Cases(msgspec.Struct, forbid_unknown_fields=True):
    """The six cases and the controllers that they are given to."""

    duration: float
    runs: dict[str, Case]
    controllers: dict[str, list[str]]
    only: list[str] = []


class Predictions(msgspec.Struct, forbid_unknown_fields=True):
    """Of which samples the internal predictions are shown."""

    start: list[float]
    goal: list[float]
    samples: list[int]
    later: list[int]
    duration: float
    modes: dict[str, Mode]


class Mode(msgspec.Struct, forbid_unknown_fields=True):
    """A way to run the controller."""

    terminal: str = "equality"
    horizon: int = 0  #: 0: as configured
    blocked: bool = False
    iterations: int = 10
    tolerance: float = 1e-4
    substeps: int = 1

    def controller(self, **more: Any) -> NewtonMpc:
        """The controller; ``blocked`` takes the default blocks, cut at the horizon."""
        default = NewtonMpc()
        horizon = self.horizon or default.prediction_horizon
        blocks = default.move_blocks if self.blocked or not self.horizon else (1,) * horizon
        options: dict[str, Any] = {
            "terminal": self.terminal,
            "prediction_horizon": horizon,
            "move_blocks": blocks,
            "max_iterations": self.iterations,
            "tolerance": self.tolerance,
        }
        return NewtonMpc(**options | more)


class Decrease(msgspec.Struct, forbid_unknown_fields=True):
    """The stability claim."""

    goal: list[float]
    box: dict[str, float]
    states: int
    samples: int
    held: float
    tolerance: float
    modes: dict[str, Mode]
    only: list[str] = []


class Loops(msgspec.Struct, forbid_unknown_fields=True):
    """Closed loops from states of the box."""

    states: int
    samples: int
    horizons: list[int]
    terminals: list[str]
    arrived: float


class Domain(msgspec.Struct, forbid_unknown_fields=True):
    """Feasible initial states."""

    goal: list[float]
    horizons: list[int]
    drawn: list[int]
    terminals: list[str]
    iterations: int
    feasible: float
    prices: tuple[float, float]
    grid: int
    slices: dict[str, dict[str, float]]
    box: dict[str, float]
    box_states: int
    loops: Loops


class Iterations(msgspec.Struct, forbid_unknown_fields=True):
    """One iteration against several."""

    counts: list[int]
    tolerance: float
    duration: float
    references: dict[str, dict[str, float]]
    horizons: dict[str, dict[str, int]]
    only: list[str] = []


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The whole study."""

    seed: int
    cases: Cases
    predictions: Predictions
    decrease: Decrease
    domain: Domain
    iterations: Iterations
    tolerances: dict[str, Tolerance]


def read_study(path: Path = STUDY, *, quick: bool = False) -> Study:
    """The study of a YAML, or the quick one in it.

    Raises ConfigurationError if the file is not one.
    """
    example = "experiments/chapter6/study.yaml"
    return read_as(Study, path, example, quick=quick, whole={"controllers"})


def draw_states(
    target: FloatArray, box: dict[str, float], count: int, seed: int
) -> list[FloatArray]:
    """States around a target; the first of more are those of fewer."""
    generator = np.random.default_rng(seed)
    shares = generator.uniform(-1.0, 1.0, (count, len(box)))
    return [
        state_at(target, {name: s * box[name] for name, s in zip(box, row, strict=True)})
        for row in shares
    ]
