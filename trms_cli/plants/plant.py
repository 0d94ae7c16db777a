"""What a plant is: it takes commands and gives measurements; nobody sees inside, but the log."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from trms_cli.core.arrays import FloatArray
from trms_cli.models.model import Model, Signal


@dataclass(frozen=True)
class PlantSetup:
    """What a plant is told before a run."""

    sample_time: float  #: Time between two measurements, s
    samples: int  #: Number of samples in the run
    seed: int  #: Of everything random in the plant
    #: What controller and observer believe, which has the names and units of a real rig's signals;
    #: None: those of a twin rotor
    model: Model | None = None


class PlantRun(Protocol):
    """A plant during one run.

    What moves has a life around it, and the loop calls what there is of it, in this order:
    ``connect()``, ``check()``, ``arm()`` before a run; ``disarm()``, ``close(reason)`` after it,
    once, whatever ended it. Between check and arm a person agrees to ``confirmation``, if that is
    a text and not empty. The plant itself may have a ``landing``, an ``envelope``, and
    ``real_time = True`` where it does not wait.
    """

    @property
    def inputs(self) -> tuple[Signal, ...]: ...

    @property
    def outputs(self) -> tuple[Signal, ...]:
        """Measured channels, the order of :meth:`measure`."""

    @property
    def states(self) -> tuple[Signal, ...]:
        """True states, the order of :attr:`state`."""

    @property
    def noise_sd(self) -> Mapping[str, float]:
        """Standard deviation of each channel's noise, quantum included, in its unit."""

    @property
    def first_command(self) -> FloatArray:
        """The command in force before time zero, shape (n_u,)."""

    @property
    def input_limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the command, each (n_u,)."""

    @property
    def known_disturbances(self) -> Mapping[str, FloatArray]:
        """Measured torques over the run by equation, each (samples,), N m; empty for none."""

    @property
    def state(self) -> FloatArray:
        """The true state now, shape (n_x,)."""

    def measure(self) -> FloatArray:
        """The measurement now, shape (n_y,); NaN where a sample is missing."""

    def advance(self, command: FloatArray) -> None:
        """Hold a command (n_u,) for one sample."""


class Plant(Protocol):
    """An immutable description of a rig."""

    def init(self, setup: PlantSetup) -> Any:
        """The rig at time zero; a :class:`PlantRun`."""
