"""What an effect is: a function from a model to a richer model.

The same effect makes a simulated rig differ from its model, is a candidate cause of a gap, and,
once diagnosed, is what the controller's model gains. It may add states, torques, a changed input
path or sensor path, and impulses (set-valued friction). Whatever its kind, an effect of size zero
leaves every bit of a simulation as it was.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from functools import lru_cache
from typing import ClassVar, get_args, get_type_hints

import casadi as ca

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.models.dry_friction import apply_dry_friction, axis_of
from trms_cli.models.model import Model, RigAxis, Signal, Window, index_of, names
from trms_cli.models.parameters import Parameter
from trms_cli.models.scales import BENCH, PortScale, acceleration_function, at_port, port_scale

__all__ = ["Effect", "EffectContext", "axis_of", "resisting_impulse", "rotor_input"]


@dataclass(frozen=True)
class EffectContext:
    """Where an effect is evaluated: expressions at one point of the model beneath it."""

    model: Model  #: The model that the effect is added to
    #: ``x``, ``u``, ``p``, ``w``: Its states, the inputs that reach the motors, its parameters, its
    #: disturbances
    x: ca.SX
    u: ca.SX
    p: ca.SX
    w: ca.SX
    own: ca.SX  #: The effect's own states (or, on the input path, its memory)
    sizes: Mapping[str, ca.SX]  #: The effect's own parameters by their short names
    #: The effect's memory on the sensor path
    sensor_memory: ca.SX = field(default_factory=lambda: ca.SX.zeros(0))

    def axis(self, name: str) -> RigAxis:
        """The axis by name; see :func:`axis_of`."""
        return axis_of(self.model, name)

    def angle(self, axis: str) -> ca.SX:
        """Angle of an axis, rad."""
        return self.x[self.model.state_index(self.axis(axis).angle)]

    def rate(self, axis: str) -> ca.SX:
        """Angular rate of an axis, rad/s."""
        slope = _slope_function(self.model, self.model.state_index(self.axis(axis).angle))
        return slope(self.x, self.u, self.p, self.w)

    def cosine_of_pitch(self) -> ca.SX:
        """cos α of the pitch; 1 for a model whose pitch is locked level."""
        return ca.cos(self.angle("pitch")) if "pitch" in self.model.axes else ca.SX(1)

    def speed(self, rotor: str) -> ca.SX:
        """Speed of a rotor, rad/s."""
        return self.x[speed_row(self.model, rotor)]

    def spin_up(self, rotor: str) -> ca.SX:
        """Acceleration of a rotor, rad/s², with all that the model beneath does."""
        slope = _slope_function(self.model, speed_row(self.model, rotor))
        return slope(self.x, self.u, self.p, self.w)

    def quantity(self, name: str) -> ca.SX:
        """A physical quantity that the model names (``thrust_main``, ``inertia_yaw``…).

        Raises ModelError if this model has no such quantity.
        """
        return _named_quantity(self.model, name, self.model.quantities(self.x, self.u, self.p))

    def accelerations(self, *axes: str) -> tuple[ca.SX, ca.SX]:
        """Angular accelerations of some axes, and what torques on them add.

        Returns ``acceleration`` (n, 1), rad/s², with all that the model beneath and its
        disturbances ``w`` do; impulses (dry friction, stops) are no part of it. And ``mobility``
        (n, n), 1/(kg m²): ``mobility[i, j]`` is what one N m on axis ``j`` adds to axis ``i``.
        """
        both = acceleration_function(self.model, axes)
        acceleration, mobility = both(self.x, self.u, self.p, self.w)
        return acceleration, mobility

    def on(self, disturbance: str, value: ca.SX) -> ca.SX:
        """A disturbance vector (n_w, 1) with ``value`` on one equation and zero elsewhere."""
        vector = ca.SX.zeros(self.model.n_w)
        vector[index_of(self.model.disturbances, disturbance, "a disturbance")] = value
        return vector


class Effect(ABC):
    """Immutable description of an effect with its sizes. Override what the effect changes."""

    #: Whether it is a cause that a diagnosis may name; a residual is none
    explains: ClassVar[bool] = True
    #: Whether it may begin while a rig runs, as what is hung on, rubs or slips does: a law of the
    #: rig's build hardly does
    may_begin: ClassVar[bool] = True
    #: What is large where it acts; see :meth:`for_model`
    rig_scale: ClassVar[PortScale] = BENCH
    #: An effect of the same axis that this one is where one of some sizes is below a value: its
    #: class, and these values by size, as shares of the least typical ones
    special_case: ClassVar["tuple[type[Effect], Mapping[str, float]] | None"] = None

    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The sizes as parameters, by short name; the effect's name is put before them."""

    def size(
        self,
        name: str,
        unit: str,
        typical: tuple[float, float],
        description: str,
        upper: float | None = None,
    ) -> Parameter:
        """One of the fields as a parameter.

        Its bounds are those of the field's annotation, or a nearer upper one; ``typical`` is the
        range that small benches span. Both, and the unit, become those of the model at hand.
        """
        lower, highest = _ranges(type(self)).get(name, (-math.inf, math.inf))
        value = getattr(self, name)
        size = Parameter(
            name,
            math.nan if value is None else value,
            unit,
            lower=lower,
            upper=highest,
            typical=typical,
            description=description,
        )
        return at_port(size, self.rig_scale, upper)

    def for_model(self, model: Model) -> "Effect":
        """The effect as it acts on a model, with a value for each size that is not given.

        Raises :class:`ModelError` if the model lacks what the effect acts on.
        """
        self.check(model)
        own = copy(self)
        object.__setattr__(own, "rig_scale", port_scale(model, **own.port(model)))
        for size in own.parameters():
            if getattr(own, size.name, 0.0) is None:
                object.__setattr__(own, size.name, size.value)
        return own

    def port(self, model: Model) -> Mapping[str, str]:
        """Where it acts on a model: an ``axis``, ``input`` or ``output`` by its name."""
        if hasattr(self, "axis"):
            return {"axis": self.axis}
        if hasattr(self, "rotor"):
            return {"input": model.inputs[rotor_input(model, self.rotor)].name}
        return {}

    def check(self, model: Model) -> None:
        """Raise :class:`ModelError` if the model lacks what the effect acts on.

        By default that is its ``axis`` and its ``rotor``, where it has such fields.
        """
        if hasattr(self, "axis"):
            axis_of(model, self.axis)
        if hasattr(self, "rotor"):
            rotor_input(model, self.rotor)

    def overrides(self, *methods: str) -> bool:
        """Whether it changes any of what these stand for."""
        return any(getattr(type(self), name) is not getattr(Effect, name) for name in methods)

    @property
    def locations(self) -> tuple[str, ...]:
        """Where in the rig's block diagram it acts (``main_thrust``, ``yaw_moment``…).

        Empty: whoever asks reads it from what the effect overrides.
        """
        return ()

    def states(self) -> tuple[Signal, ...]:
        """Further continuous states.

        One that rests at any value, since only motion changes it (a hysteresis), says so by
        ``path_memory=True``: a controller then leaves it where it is.
        """
        return ()

    def derivative(self, at: EffectContext) -> ca.SX:
        """Time derivative of :meth:`states`."""
        return ca.SX.zeros(0)

    def disturbance(self, at: EffectContext) -> ca.SX:
        """Torques on the equations of the model, shape (n_w, 1)."""
        return ca.SX.zeros(at.model.n_w)

    def memory(self, step: float) -> tuple[Signal, ...]:
        """Discrete states of the input path for a step of this length (s)."""
        return ()

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        """Inputs and memory after a part of the step; see :meth:`Model.input_path`."""
        return at.u, at.own

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        """The model's states after the impulse of the last ``duration`` seconds."""
        return at.x

    def output(self, at: EffectContext, y: ca.SX) -> ca.SX:
        """The measured outputs as the changed sensors give them when nothing has changed."""
        return y

    def stretch(self, model: Model, sizes: Mapping[str, float]) -> float:
        """Logarithm of the factor by which readings spread more for the same states, all told."""
        return 0.0

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        """Discrete states of the sensors for a step of this length (s)."""
        return ()

    def sensor_path(
        self, at: EffectContext, before: ca.SX, after: ca.SX, window: Window, step: float
    ) -> ca.SX:
        """Memory of the sensors after a part of the step; see :meth:`Model.sensor_path`.

        ``before``, ``after``, (n_y, 1): what the sensors beneath read at its beginning and end.
        """
        return at.sensor_memory

    def reading(self, at: EffectContext, y: ca.SX, step: float, since: float) -> ca.SX:
        """The measured outputs with what the sensors remember; see :meth:`Model.reading`."""
        return self.output(at, y)

    def resolution(self, model: Model) -> tuple[str, int] | None:
        """The size that is the quantum of an output, and its position in ``y``; None without one.

        ``model``: that the effect is added to.
        """
        return None

    def noise_sd(self, at: EffectContext, step: float) -> ca.SX:
        """Standard deviation of what noise adds to each of :meth:`states` in a step (s)."""
        return ca.SX.zeros(len(self.states()))


@dataclass(frozen=True, kw_only=True)
class InputEffect(Effect):
    """An effect on one command."""

    rotor: str  #: Name of an input, or of a rotor of the model

    def input_path(self, at: EffectContext, window: Window, step: float) -> tuple[ca.SX, ca.SX]:
        channel = rotor_input(at.model, self.rotor)
        u = ca.SX(at.u)
        u[channel], memory = self.command(at, u[channel], (window[1] - window[0]) * step)
        return u, memory

    @abstractmethod
    def command(self, at: EffectContext, u: ca.SX, duration: float) -> tuple[ca.SX, ca.SX]:
        """What arrives of a command over a part of the step (s), and the memory after it."""

    def full_command(self, model: Model) -> float:
        """The limit of the command, in its unit."""
        return model.input_limits[model.inputs[rotor_input(model, self.rotor)].name]


class SensorEffect(Effect):
    """An effect on one measured channel, named by its ``axis`` or ``rotor``.

    That is the axis whose angle it shows, the rotor whose speed it shows, or the output itself.
    """

    def row(self, model: Model) -> int:
        """Position of the channel in ``y``.

        Raises ModelError if the model does not measure it.
        """
        name: str = getattr(self, "axis", "") or getattr(self, "rotor", "")
        if name in names(model.outputs):
            return output_row(model, name)
        if hasattr(self, "axis"):
            return output_row(model, axis_of(model, name).angle)
        rotor_input(model, name)
        return output_row(model, model.rotors[name].speed)

    def check(self, model: Model) -> None:
        self.row(model)

    def port(self, model: Model) -> Mapping[str, str]:
        return {"output": model.outputs[self.row(model)].name}

    def inverse(
        self, recorded: FloatArray, step: float, sizes: Mapping[str, float]
    ) -> FloatArray | None:
        """The inverse of the effect: what the channel shows without it; None: there is none.

        NaN where the recording does not tell. ``recorded``, (n,) array: of the channel, in its
        unit, NaN where missing. ``step``: s, between samples. ``sizes``: values of
        :meth:`parameters`.
        """
        return None

    def add_to_channel(self, at: EffectContext, y: ca.SX, value: ca.SX) -> ca.SX:
        """The measured outputs with something added to the channel."""
        y = ca.SX(y)
        y[self.row(at.model)] += value
        return y


@lru_cache(maxsize=128)
def _ranges(kind: type[Effect]) -> dict[str, tuple[float, float]]:
    """Least and largest value of each field whose annotation has them."""
    ranges = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        # of what may be left out, NotNegative | None
        hint = next((part for part in get_args(hint) if hasattr(part, "__metadata__")), hint)
        for limits in getattr(hint, "__metadata__", ()):
            lower = -math.inf if limits.ge is None else float(limits.ge)
            ranges[name] = (lower, math.inf if limits.le is None else float(limits.le))
    return ranges


def rotor_input(model: Model, rotor: str) -> int:
    """Position in ``u`` of an input, or of the input of a rotor.

    Raises ModelError if the model has no such rotor or input.
    """
    input_names = names(model.inputs)
    if rotor not in model.rotors and rotor not in input_names:
        raise ModelError(
            f"model {model.name!r} has no {rotor} rotor and no input of that name",
            remedy=f"it has: {', '.join((*model.rotors, *input_names))}",
        )
    name = model.rotors[rotor].input if rotor in model.rotors else rotor
    return index_of(model.inputs, name, "an input")


def speed_row(model: Model, rotor: str) -> int:
    """Position of a rotor's speed in ``x``.

    Raises ModelError if the model has no such rotor, or its speed is no state.
    """
    rotor_input(model, rotor)
    if rotor not in model.rotor_speeds:
        raise ModelError(
            f"model {model.name!r} has no state that is the speed of the {rotor} rotor",
            remedy=f"it has: {', '.join(model.state_names)}",
        )
    return model.state_index(model.rotor_speeds[rotor])


def motor_disturbance(model: Model, rotor: str) -> int:
    """Position in ``w`` of the torque on a rotor."""
    torque = model.rotors[rotor].torque
    return index_of(model.disturbances, torque, f"a disturbance of model {model.name!r}")


def output_row(model: Model, name: str) -> int:
    """Position of a measured channel in ``y``.

    Raises ModelError if the model does not measure it.
    """
    output_names = names(model.outputs)
    if name not in output_names:
        raise ModelError(
            f"model {model.name!r} does not measure {name!r}",
            remedy=f"it measures: {', '.join(output_names)}",
        )
    return output_names.index(name)


def require_quantities(model: Model, *quantity_names: str) -> None:
    """Check that a model names some physical quantities.

    Raises ModelError for the first that it does not.
    """
    x, u, p, _ = model.symbols()
    expressions = model.quantities(x, u, p)
    for name in quantity_names:
        _named_quantity(model, name, expressions)


def _named_quantity(model: Model, name: str, expressions: Mapping[str, ca.SX]) -> ca.SX:
    if name not in expressions:
        raise ModelError(
            f"model {model.name!r} does not name {name!r}",
            remedy=f"it names: {', '.join(sorted(expressions)) or 'nothing'}",
        )
    return expressions[name]


def resisting_impulse(
    at: EffectContext, part: str, torque: ca.SX | Callable[[ca.SX], ca.SX] | None, duration: float
) -> ca.SX:
    """States after dry friction on an axis or rotor; see :mod:`trms_cli.models.dry_friction`.

    ``torque``: N m, not negative; a function of the rate (rad/s); None removes the whole rate.
    ``duration``: s.
    """
    return apply_dry_friction(at.model, (at.x, at.u, at.p, at.w), part, torque, duration)


# Built once for a model and inlined wherever it is called: an effect is asked at every stage of
# every substep, and each effect asks the model beneath it, which would take a time that doubles
# with each effect.


@lru_cache(maxsize=128)
def _slope_function(model: Model, row: int) -> ca.Function:
    at = model.symbols()
    return ca.Function("slope", list(at), [model.dynamics(*at)[row]])
