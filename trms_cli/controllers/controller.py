"""What a controller is: from references and an estimate to a command."""

import enum
import math
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from trms_cli.core.arrays import FloatArray
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model

#: Whether a command acts at the sample that it is asked for at, or one sample later, as it is
#: reckoned with then; the loop reads it, like the control period
Delay = Literal["none", "one_sample"]


class Status(enum.Enum):
    """How a sample's computation ended: what it means and what to do about it."""

    OK = ("ok", "solved", "")
    BUDGET = (
        "budget",
        "stopped at the iteration budget before convergence",
        "expected with one iteration a sample; else raise max_iterations",
    )
    RELAXED = (
        "relaxed",
        "the terminal constraint could not be met and was relaxed",
        "lengthen the prediction horizon, or slow the reference down",
    )
    FAILED = (
        "failed",
        "the solve failed; the declared fall-back acted",
        "read /event and the slack; try another qp_solver or softer limits",
    )
    OVERRIDDEN = (
        "overridden",
        "the supervisor's command acted in place of the controller's",
        "read /event for the cause",
    )

    def __init__(self, label: str, meaning: str, remedy: str) -> None:
        self.label = label
        self.meaning = meaning
        self.remedy = remedy


@dataclass(frozen=True)
class ControlSetup:
    """What a controller is told before a run."""

    model: Model  #: What the controller believes
    sample_time: float  #: Control period, s
    first_command: FloatArray  #: (n_u,) array; the command in force before time zero


@dataclass
class ControlSample:
    """What a controller sees at a sample."""

    time: float  #: s
    #: (preview + 1, n_r) array; references now and at the next control periods, rad; the order of
    #: ``model.controlled``
    reference: FloatArray
    estimate: Estimate
    previous_command: FloatArray  #: (n_u,) array; as applied, after limits


@dataclass
class Prediction:
    """Trajectories that a controller expects."""

    time: FloatArray  #: (n,) array; s from now
    states: FloatArray  #: (n, n_x) array
    inputs: FloatArray  #: (n, n_u) array; the last row repeats the one before


@dataclass
class Command:
    """A controller's answer. Times in s; quantities that a law does not have are NaN."""

    u: FloatArray  #: (n_u,) array; within the model's limits and finite
    status: Status = Status.OK
    iterations: int = 0
    objective: float = math.nan  #: of the plan
    slack: float = math.nan  #: largest violation of a soft limit
    kkt_residual: float = math.nan  #: of the optimality conditions
    linearise_time: float = math.nan  #: s
    qp_time: float = math.nan  #: s
    fallback: str = ""  #: Which fall-back acted, empty for none
    message: str = ""
    prediction: Prediction | None = None
    #: Whether no steady state has the reference, and the closest one is the target
    out_of_reach: bool = False
    #: How far the prediction ends from where it must; NaN without a terminal constraint
    terminal_residual: float = math.nan


class PresentReference:
    """A controller that looks at no future reference."""

    def preview(self, setup: ControlSetup) -> int:
        """None are wanted."""
        return 0


class Controller(Protocol):
    """An immutable configuration; everything that changes is in the state it hands out.

    Attributes
    ----------
    sample_time : float or None
        Control period, s; None takes every sample.
    """

    @property
    def sample_time(self) -> float | None: ...

    def preview(self, setup: ControlSetup) -> int:
        """How many future reference samples, one control period apart, :meth:`step` wants."""

    def init(self, setup: ControlSetup) -> Any:
        """A fresh state; two of them never share anything."""

    def step(self, state: Any, sample: ControlSample, *, want_prediction: bool) -> Command:
        """The command from now to the next control period; ``state`` is updated in place."""
