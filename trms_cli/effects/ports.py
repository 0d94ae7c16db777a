"""Laws that stand at inputs as at outputs: which it is, the model says by the name.

The laws that are generated for any model, by the name ``{port}_{law}``, are the YAMLs of the group
``law``; see :mod:`trms_cli.composition.laws`.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from trms_cli.core.errors import ModelError
from trms_cli.core.ranges import NotNegative
from trms_cli.effects.actuator_lag import ActuatorLag
from trms_cli.effects.effect import Effect
from trms_cli.effects.input_bias import InputBias
from trms_cli.effects.input_delay import InputDelay
from trms_cli.effects.sensor_bias import SensorBias
from trms_cli.effects.sensor_delay import SensorDelay
from trms_cli.effects.tacho_lag import TachoLag
from trms_cli.models.model import Model, names
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True, kw_only=True)
class PortEffect(Effect):
    """An effect on an input or an output, which becomes that of either on a model."""

    port_name: str  #: Name of an input or output of the model

    def for_model(self, model: Model) -> Effect:
        inputs, outputs = names(model.inputs), names(model.outputs)
        if self.port_name not in (*inputs, *outputs):
            raise ModelError(
                f"model {model.name!r} has no input or output {self.port_name!r}",
                remedy=f"it has: {', '.join((*inputs, *outputs))}",
            )
        own = self.on_input() if self.port_name in inputs else self.on_output()
        return own.for_model(model)

    def parameters(self) -> tuple[Parameter, ...]:
        return self.on_input().parameters()

    @abstractmethod
    def on_input(self) -> Effect:
        """The effect, where the port is an input."""

    @abstractmethod
    def on_output(self) -> Effect:
        """The effect, where the port is an output."""


@dataclass(frozen=True, kw_only=True)
class Delay(PortEffect):
    """Transport delay of a command or of a measurement."""

    delay: NotNegative | None = None  #: s
    longest: Annotated[float, Meta(gt=0)] = 0.2  #: s, bound of the delay

    def on_input(self) -> Effect:
        return InputDelay(rotor=self.port_name, delay=self.delay, longest=self.longest)

    def on_output(self) -> Effect:
        return SensorDelay(axis=self.port_name, delay=self.delay, longest=self.longest)


@dataclass(frozen=True, kw_only=True)
class Bias(PortEffect):
    """Constant error of a command or of a measurement."""

    bias: Annotated[float, Meta(ge=-1e6, le=1e6)] | None = None  #: In the port's unit

    def on_input(self) -> Effect:
        return InputBias(rotor=self.port_name, bias=self.bias)

    def on_output(self) -> Effect:
        return SensorBias(axis=self.port_name, bias=self.bias)


@dataclass(frozen=True, kw_only=True)
class Lag(PortEffect):
    """First-order lag of a command or of a measurement."""

    time_constant: NotNegative | None = None  #: s

    def on_input(self) -> Effect:
        return ActuatorLag(rotor=self.port_name, time_constant=self.time_constant)

    def on_output(self) -> Effect:
        return TachoLag(rotor=self.port_name, time_constant=self.time_constant)
