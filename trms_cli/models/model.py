"""What a model is: named signals, parameters, and equations stated once in CasADi.

A model is a hybrid system. Its continuous part is

    ẋ = dynamics(x, u, p, w)        y = measurement(x, u, p)

with generalised disturbances ``w``, one per physical equation. Effects may add what a differential
equation cannot say: an input path with memory (a delay), sensors with memory, impulses at the end
of each integration step (set-valued friction, a mechanical stop), and states that noise drives.
Plain models have none of them.

A model that was learnt from samples has no derivative, only the step from one sample to the next;
see :class:`trms_cli.models.discrete.SteppedModel`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.deprecation import deprecated_name
from trms_cli.core.errors import ModelError
from trms_cli.models.parameters import ParameterSet


@dataclass(frozen=True)
class Signal:
    """A named physical signal: a state, input, output or disturbance."""

    name: str  #: unique within its kind
    unit: str  #: SI, "1" for a normalised command
    description: str = ""  #: what it is, without the unit
    #: whether, as a state, it remembers a path: it rests at any value, and only motion changes it
    path_memory: bool = False
    #: whether, as memory of the input path, it begins at zero with a recording: what takes minutes
    #: (a drive that warms up) has not settled at the first command
    begins_cold: bool = False


@dataclass(frozen=True)
class RigAxis:
    """A mechanical axis of the rig, as effects and mechanical stops refer to it."""

    angle: str  #: Name of the state that is the axis' angle or position, rad or m
    moment: str  #: Name of the disturbance that is a torque or force on the axis, N m or N


@dataclass(frozen=True)
class RigRotor:
    """A rotor of the rig, as effects refer to it. What a model does not have stays empty."""

    input: str  #: Name of its input
    speed: str = ""  #: Name of the state that is its speed, rad/s
    torque: str = ""  #: Name of the disturbance that is a torque on it, N m
    axis: str = ""  #: Name of the axis that its thrust turns


#: A part of a step, as fractions of it; the last part ends at 1.
Window = tuple[float, float]


class Model(ABC):
    """A plant model with states. Immutable; its methods build expressions and keep nothing."""

    name: str
    states: tuple[Signal, ...]  #: The order of ``x``, ``u``, ``y`` and ``w``
    inputs: tuple[Signal, ...]  #: The order of ``x``, ``u``, ``y`` and ``w``
    outputs: tuple[Signal, ...]  #: The order of ``x``, ``u``, ``y`` and ``w``
    disturbances: tuple[Signal, ...]  #: The order of ``x``, ``u``, ``y`` and ``w``
    parameters: ParameterSet  #: The order and the present values of ``p``
    controlled: tuple[str, ...]  #: Names of the states that references are for
    input_limits: Mapping[str, float]  #: Symmetric bound of each input, in the input's unit
    #: Mechanical range of an angle or position, symmetric, in its unit; one without has no stop
    stops: Mapping[str, float] = MappingProxyType({})
    axes: Mapping[str, RigAxis] = MappingProxyType(
        {}
    )  #: Mechanical axes by name (``pitch``, ``yaw``)
    rotors: Mapping[str, RigRotor] = MappingProxyType({})  #: The rotors by name (``main``)
    #: Whether what is typical of small benches with two rotors (friction in N m, delays in s) is
    #: typical of it; else that is taken in the proportion of :mod:`trms_cli.models.scales`
    bench_sizes: bool = False
    #: Whether an explicit integrator needs steps far below the dynamics of interest
    stiff: bool = False
    #: Whether impulses, where there are any, hold an axis at rest; those of regularised friction,
    #: which is no more than steep there, only slow it
    friction_holds: bool = True
    #: s, of a model that only steps (:meth:`transition`); None for one with :meth:`dynamics`
    sample_time: float | None = None

    def take_over(self, base: Model) -> None:
        """Have the name, signals, parameters, limits and geometry of another model."""
        for attribute in Model.__annotations__:
            setattr(self, attribute, getattr(base, attribute))

    @abstractmethod
    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        """Time derivative of the states, shape (n_x, 1)."""

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        """Measured outputs, shape (n_y, 1): by default the states of these names."""
        return ca.vertcat(*(x[self.state_index(signal.name)] for signal in self.outputs))

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        """States one ``sample_time`` later, shape (n_x, 1), of a model that only steps.

        Raises ModelError for a model in continuous time, whose step depends on its length.
        """
        raise ModelError(
            f"model {self.name!r} has a derivative and no step of its own",
            remedy="make one of any length: discretise(model, step_length)",
        )

    def quantities(self, x: ca.SX, u: ca.SX, p: ca.SX) -> dict[str, ca.SX]:
        """Physical quantities by name that effects and reports refer to (thrusts, inertias…)."""
        return {}

    def rest(self) -> FloatArray:
        """A state to start from when none is given, shape (n_x,)."""
        return np.zeros(len(self.states))

    # Hybrid parts: a plain model has none. `ExtendedModel` overrides them.

    def memory(self, step: float) -> tuple[Signal, ...]:
        """Discrete states, updated once or more each ``step`` (s), after the continuous ones."""
        return ()

    def input_path(
        self, memory: ca.SX, u: ca.SX, p: ca.SX, window: Window, step: float
    ) -> tuple[ca.SX, ca.SX]:
        """What reaches the motors in a part of the step, and the memory after it.

        Parameters
        ----------
        memory : (n_m, 1)
        u : (n_u, 1)
            The command, constant over the step.
        window : (float, float)
            The part, see :data:`Window`.
        step : float
            Length of the whole step, s.
        """
        return u, memory

    def impulse(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX, duration: float) -> ca.SX:
        """Continuous states after the impulses of the last ``duration`` seconds."""
        return x

    def sensor_memory(self, step: float) -> tuple[Signal, ...]:
        """Discrete states of the sensors: what they still show of the past, :meth:`sensor_path`."""
        return ()

    def sensor_path(
        self,
        memory: ca.SX,
        before: ca.SX,
        after: ca.SX,
        u: ca.SX,
        p: ca.SX,
        window: Window,
        step: float,
    ) -> ca.SX:
        """The sensors' memory after a part of the step.

        Parameters
        ----------
        memory : (n_s, 1)
        before, after : (n_x, 1)
            States at the beginning and the end of the part.
        window : (float, float)
            The part, see :data:`Window`.
        step : float
            Length of the whole step, s.
        """
        return memory

    def reading(
        self, memory: ca.SX, x: ca.SX, u: ca.SX, p: ca.SX, step: float, since: float = 1.0
    ) -> ca.SX:
        """Measured outputs with what the sensors remember, shape (n_y, 1).

        :meth:`measurement` is what they read when nothing has changed for long.

        Parameters
        ----------
        memory : (n_s, 1)
        since : float
            How long ago the last step began, as a fraction of it.
        """
        return self.measurement(x, u, p)

    def noise_sd(self, p: ca.SX, step: float) -> ca.SX:
        """Standard deviation of what noise adds to each state in a step (s), shape (n_x, 1)."""
        return ca.SX.zeros(self.n_x)

    def resolutions(self) -> dict[str, int]:
        """Parameters that are the quantum of an output, and its position in ``y``."""
        return {}

    # Conveniences that follow from the above.

    @property
    def n_x(self) -> int:
        return len(self.states)

    @property
    def n_u(self) -> int:
        return len(self.inputs)

    @property
    def n_y(self) -> int:
        return len(self.outputs)

    @property
    def n_w(self) -> int:
        return len(self.disturbances)

    @property
    def state_names(self) -> tuple[str, ...]:
        return names(self.states)

    def state_index(self, name: str) -> int:
        return index_of(self.states, name, f"a state of model {self.name!r}")

    @property
    def path_memory(self) -> tuple[int, ...]:
        """Positions of the states that remember a path: a steady state leaves them open."""
        return tuple(i for i, state in enumerate(self.states) if state.path_memory)

    @property
    def rotor_speeds(self) -> dict[str, str]:
        """Name of the state that is a rotor's speed, of each rotor that has one."""
        return {n: r.speed for n, r in self.rotors.items() if r.speed in self.state_names}

    def rotor_of(self, axis: str) -> str | None:
        """Name of the rotor whose thrust turns an axis; None: no rotor's does."""
        return next((name for name, rotor in self.rotors.items() if rotor.axis == axis), None)

    def input_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the inputs, each (n_u,)."""
        upper = np.array([self.input_limits[signal.name] for signal in self.inputs])
        return -upper, upper

    def parameters_by_name(self, p: ca.SX) -> dict[str, ca.SX]:
        """The parameters (n_p, 1) by name."""
        return {name: p[i] for i, name in enumerate(self.parameters.names)}

    def without_effects(self) -> Model:
        """The model beneath all effects: itself, where it has none."""
        return self

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Fresh symbols (x, u, p, w)."""
        return (
            ca.SX.sym("x", self.n_x),
            ca.SX.sym("u", self.n_u),
            ca.SX.sym("p", len(self.parameters)),
            ca.SX.sym("w", self.n_w),
        )


def __getattr__(name: str) -> Any:
    return deprecated_name(__name__, name, {"Axis": ("RigAxis", RigAxis)})


def names(signals: Sequence[Signal]) -> tuple[str, ...]:
    """The names of signals, in order."""
    return tuple(signal.name for signal in signals)


def by_name(signals: Sequence[Signal], values: FloatArray) -> dict[str, float]:
    """The value of each signal, (n,), by its name."""
    return dict(zip(names(signals), values.tolist(), strict=True))


def index_of(signals: Sequence[Signal], name: str, what: str) -> int:
    """Position of a signal by name.

    Raises ModelError if there is none of that name.
    """
    signal_names = names(signals)
    if name not in signal_names:
        raise ModelError(f"{name!r} is not {what}", remedy=f"there are: {', '.join(signal_names)}")
    return signal_names.index(name)
