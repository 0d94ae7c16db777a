"""What an observer is: from commands and measurements to an estimate."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model, names


@dataclass(frozen=True)
class ObserverSetup:
    """What an observer is told before a run."""

    model: Model  #: What the observer believes
    sample_time: float  #: Time between two measurements, s
    #: Measured channels in the order of ``y``, a subset of the model's outputs
    outputs: tuple[str, ...]
    #: Declared standard deviation of each channel's noise (quantum included), in its unit
    noise_sd: Mapping[str, float]
    first_measurement: FloatArray  #: (n_y,) array; the measurement at time zero, NaN where missing
    first_command: FloatArray  #: (n_u,) array; the command in force before time zero

    def channels(self) -> list[int]:
        """Positions of the measured channels among the model's outputs.

        Raises ConfigurationError for a channel that the model knows nothing of.
        """
        output_names = names(self.model.outputs)
        foreign = [name for name in self.outputs if name not in output_names]
        if foreign:
            both = [name for name in self.outputs if name in output_names]
            raise ConfigurationError(
                f"the rig measures {', '.join(foreign)}, of which model {self.model.name!r} "
                "knows nothing",
                where="plant.sensors.channels",
                remedy=f"measure what it knows: plant.sensors.channels=[{','.join(both)}]"
                if both
                else f"choose a model that measures {foreign[0]}",
            )
        return [output_names.index(name) for name in self.outputs]


class Observer(Protocol):
    """An immutable configuration; everything that changes is in the state it hands out."""

    def init(self, setup: ObserverSetup) -> Any:
        """A fresh state; two of them never share anything."""

    def step(
        self,
        state: Any,
        command: FloatArray,
        measurement: FloatArray,
        truth: Mapping[str, float] | None,
        known: FloatArray | None = None,
    ) -> Estimate:
        """The estimate at this sample.

        Parameters
        ----------
        state
            From :meth:`init`; updated in place.
        command : (n_u,) array
            What was applied since the last sample (at the first: ``first_command``).
        measurement : (n_y,) array
            Channels of ``setup.outputs``; NaN where a sample is missing.
        truth : mapping or None
            True states by name, for observers that are allowed to cheat; None when replaying.
        known : (n_w,) array or None
            Measured torques on the model's equations since the last sample, N m; given only in
            runs that have any. They are part of the estimate's disturbance.
        """
