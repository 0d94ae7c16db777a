"""A simulated rig: a model with its own parameters, and what the model does not know.

It shares no object with the controller's model; its integration is its own and finer.

Mechanical stops: the rig's frame ends the travel of an axis, without rebound. Where a model has
equations, a stop is an effect: an impulse that takes the rate away. Where it only steps, the angle
is held at the stop, and so is what the model remembers of it: it has no rate left.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import casadi as ca
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.core.plugins import require_known
from trms_cli.core.process_cache import call_memoised
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.effects.effect import Effect, EffectContext, axis_of, resisting_impulse
from trms_cli.effects.extended_model import extend_model
from trms_cli.models.discrete import copied_states, root_of
from trms_cli.models.discretisation import discretise, noise_of_states
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import FloatArray, Model, Signal, names
from trms_cli.models.parameters import Parameter, ParameterSet
from trms_cli.models.rest import rest_equations
from trms_cli.plants.disturbance import ScheduledDisturbance
from trms_cli.plants.envelope import Envelope
from trms_cli.plants.faults.fault import Fault, FaultRun, FaultSetup
from trms_cli.plants.landing import Landing
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors

#: No initial angle (rad) or speed (rad/s) of such a rig is larger: its rotors reach some hundreds.
_FASTEST = 1e4
#: rad; see :meth:`SimulatedRig.__post_init__`.
_TWO_TURNS = 4 * math.pi


@dataclass(frozen=True, kw_only=True)
class MechanicalStop(Effect):
    """A stop at either end of an axis' travel."""

    axis: str
    range: float  #: Largest angle to either side, rad

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("range", self.range, "rad", lower=0.0),)

    def check(self, model: Model) -> None:
        axis_of(model, self.axis)

    def impulse(self, at: EffectContext, duration: float) -> ca.SX:
        row = at.model.state_index(at.axis(self.axis).angle)
        angle, limit = at.x[row], at.sizes["range"]
        x_stopped = resisting_impulse(at, self.axis, None, duration)
        outward = ca.logic_and(ca.fabs(angle) >= limit, angle * at.rate(self.axis) > 0)
        x = ca.if_else(outward, x_stopped, at.x)
        x[row] = ca.fmin(ca.fmax(angle, -limit), limit)
        return x


def with_stops(model: Model) -> dict[str, Effect]:
    """Stops for every axis of a model with equations that has a finite range, by effect name."""
    return {
        f"{name}_stop": MechanicalStop(axis=name, range=model.stops[axis.angle])
        for name, axis in model.axes.items()
        if model.stops.get(axis.angle, float("inf")) < float("inf")
    }


class StoppedSteps(DrivenModel):
    """A model that only steps, its angles within the stops.

    ``base``: with a ``sample_time``.
    """

    def __init__(self, base: Model) -> None:
        assert base.sample_time is not None
        super().__init__(base, ())
        copies = copied_states(base)
        #: Rows of an angle and of what is remembered of it, by the angle's range.
        self._stop_rows = [
            (row, [i for i in range(base.n_x) if root_of(copies, i) == ("x", row)], limit)
            for row, limit in (
                (base.state_index(name), limit) for name, limit in base.stops.items()
            )
            if limit < float("inf")
        ]

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        free = self.base.transition(x, u, p, w)
        after = ca.SX(free)
        for angle, rows, limit in self._stop_rows:
            stop = ca.sign(free[angle]) * limit
            for row in rows:
                after[row] = ca.if_else(ca.fabs(free[angle]) >= limit, stop, free[row])
        return after


@dataclass(frozen=True, kw_only=True)
class SimulatedRig:
    """A rig that is simulated."""

    model: Model  #: Equations of the rig
    #: True values that differ from the model's, SI
    parameters: Mapping[str, float] = field(default_factory=dict)
    #: Draws all parameters from their priors first; None keeps the model's values
    prior_seed: Annotated[int, Meta(ge=0)] | None = None
    #: Multiplies the priors' standard deviations for that draw
    prior_scale: NotNegative = 1.0
    #: What the rig has and the model does not know
    effects: Mapping[str, Effect] = field(default_factory=dict)
    integration_step: Positive = 0.005  #: Longest integration step, s
    sensors: Sensors = field(default_factory=Sensors)
    initial: Mapping[str, Annotated[float, Meta(ge=-_FASTEST, le=_FASTEST)]] = field(
        default_factory=dict
    )  #: Initial states that differ from rest, by name
    #: Commands in force before time zero, by input
    first_command: Mapping[str, float] = field(default_factory=dict)
    #: External torques by name
    disturbances: Mapping[str, ScheduledDisturbance] = field(default_factory=dict)
    faults: Mapping[str, Fault] = field(default_factory=dict)  #: What breaks during a run, by name
    mechanical_stops: bool = True  #: Whether the frame ends the travel of each axis
    #: How it is brought to rest; a simulated rig needs no landing at the end of a run
    landing: Landing = field(default_factory=lambda: Landing(after_run=False))
    envelope: Envelope = field(default_factory=Envelope)  #: What it may do

    def __post_init__(self) -> None:
        if not self.mechanical_stops and self.envelope.beyond_stops is not None:
            # nothing stops such a rig: what has turned round twice is no longer under control
            free = replace(self.envelope, beyond_stops=_TWO_TURNS)
            object.__setattr__(self, "envelope", free)

    def init(self, setup: PlantSetup) -> SimulatedRun:
        """The rig at time zero."""
        return SimulatedRun(self, setup)

    def true_model(self) -> Model:
        """The rig's equations with effects and stops."""
        effects, model = dict(self.effects), self.model
        if self.mechanical_stops and model.sample_time is not None:
            model = StoppedSteps(model)
        elif self.mechanical_stops:
            effects |= with_stops(model)
        return extend_model(model, effects)

    def true_parameters(self, model: Model) -> ParameterSet:
        """The rig's parameter values, effects' sizes among them."""
        parameters = model.parameters
        if self.prior_seed is not None and not self.model.parameters:
            raise ConfigurationError(
                f"{self.prior_seed} given, and the rig's model {self.model.name!r} has no "
                "parameters to draw",
                where="prior_seed",
                remedy="choose a rig with equations: model@plant.model=newtonian",
            )
        if self.prior_seed is not None:
            parameters = parameters.draw(self.prior_seed, self.prior_scale)
        return parameters.replaced(self.parameters)


class SimulatedRun:
    """A simulated rig during one run; see :class:`trms_cli.plants.plant.PlantRun`."""

    def __init__(self, rig: SimulatedRig, setup: PlantSetup) -> None:
        model = rig.true_model()
        self.model = model
        self.parameters = rig.true_parameters(model)
        substeps = max(1, math.ceil(setup.sample_time / rig.integration_step - 1e-9))
        discrete = discretise(model, setup.sample_time, substeps, sensors=True)
        self.inputs: tuple[Signal, ...] = model.inputs
        self.states: tuple[Signal, ...] = model.states
        available = names(model.outputs)
        channels = rig.sensors.measured(available)
        self.outputs = tuple(model.outputs[available.index(name)] for name in channels)
        self.noise_sd = rig.sensors.declared_noise(channels)
        self.first_command = _vector(rig.first_command, model.inputs, "first_command")
        self.input_limits = model.input_bounds()
        start = model.rest()
        for name, value in rig.initial.items():
            stop = model.stops.get(name, math.inf) if rig.mechanical_stops else math.inf
            if abs(value) > stop:
                raise ConfigurationError(
                    f"{value:g} given",
                    where=f"initial.{name}",
                    remedy=f"the mechanical stops are at ±{stop:g} {_unit_of(model, name)} "
                    "(plant.mechanical_stops=false takes them away)",
                )
            start[_position(name, names(model.states), "initial")] = value
        if model.sample_time is not None:
            start = _remembering(rig.model, start, self.first_command, rig.initial)
        # The buffers' arrays are fixed for life; the step writes beside its input and is copied
        # back, the measurement reads what the step does.
        self._step = BufferedFunction(discrete.step)
        sense = call_memoised(_selected, discrete.measurement, channels, available)
        self._sense = BufferedFunction(sense, inputs=self._step.inputs[:3])
        self._full = self._step.inputs[0]
        self._full[:] = discrete.initial(start, self.first_command)
        self._step.inputs[2][:] = self.parameters.values
        self._n_x = model.n_x
        generator = np.random.default_rng(np.random.SeedSequence([setup.seed, 0x504C414E]))
        self._noise = rig.sensors.draw_noise(channels, setup.samples, generator)
        quanta = rig.sensors.quanta(channels)
        self._quanta = np.where(quanta > 0, quanta, 1.0)
        self._rounded = quanta > 0
        self._any_rounded = bool(self._rounded.any())
        self._all_rounded = bool(self._rounded.all())
        self.faults = _broken(rig.faults, setup, channels, names(model.inputs))
        self._noisy_states, self._pushes = _noise_on_states(model, self.parameters, setup)
        self.known_disturbances: Mapping[str, FloatArray]
        self._w, self.known_disturbances = self._torques(rig, setup)
        self._pushed = bool(self._w.any())
        self._sample = 0

    @property
    def state(self) -> FloatArray:
        return self._full[: self._n_x]

    def measure(self) -> FloatArray:
        sense = self._sense
        sense()
        y = sense.outputs[0] + self._noise[self._sample]
        if self._any_rounded:
            readings = y / self._quanta
            np.rint(readings, readings)
            readings *= self._quanta
            y = readings if self._all_rounded else np.where(self._rounded, readings, y)
        for fault in self.faults:
            fault.sensed(self._sample, y)
        return y

    def advance(self, command: FloatArray) -> None:
        step = self._step
        if self.faults:
            command = command.copy()
            for fault in self.faults:
                fault.commanded(self._sample, command)
        step.inputs[1][:] = command
        if self._pushed:
            step.inputs[3][:] = self._w[self._sample]
        step()
        self._full[:] = step.outputs[0]
        if self._noisy_states.size:
            self._full[self._noisy_states] += self._pushes[self._sample]
        self._sample += 1
        # One sum is the cheapest test of all states at once, and of a few numbers Python's.
        if not math.isfinite(sum(self._full.tolist())):
            raise SimulationError(
                f"the simulated rig's state is no longer finite at sample {self._sample}",
                where="plant",
                remedy="lower plant.integration_step, or look at the effects' sizes",
            )

    def _torques(
        self, rig: SimulatedRig, setup: PlantSetup
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Disturbances at each sample, shape (samples, n_w), held over the sample.

        Beside them those that are measured, by equation, each (samples,).
        """
        equations = names(self.model.disturbances)
        times = np.arange(setup.samples, dtype=np.float64) * setup.sample_time
        w = np.zeros((setup.samples, len(equations)))
        measured: dict[str, FloatArray] = {}
        for name, disturbance in rig.disturbances.items():
            equation = disturbance.equation
            words = f"the rig has no equation {equation!r}"
            require_known(equation, equations, words, f"disturbances.{name}.equation")
            torque = disturbance.torque.sample(times)
            w[:, equations.index(equation)] += torque
            if disturbance.known:
                measured.setdefault(equation, np.zeros(setup.samples))
                measured[equation] += torque
        return w, measured


def _broken(
    faults: Mapping[str, Fault],
    setup: PlantSetup,
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
) -> tuple[FaultRun, ...]:
    """The faults of a run, in their order; each has random numbers of its own."""
    runs = []
    for name, fault in faults.items():
        seed = (setup.seed, 0x4641554C, zlib.crc32(name.encode()))
        fault_setup = FaultSetup(setup.sample_time, setup.samples, outputs, inputs, seed)
        try:
            runs.append(fault.init(fault_setup))
        except ConfigurationError as error:
            error.where = f"faults.{name}.{error.where}"
            raise
    return tuple(runs)


def _noise_on_states(
    model: Model, parameters: ParameterSet, setup: PlantSetup
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """States that noise drives, and what it adds to each over the run, (samples, count)."""
    sd = noise_of_states(model, parameters.values, setup.sample_time)
    driven = np.flatnonzero(sd)
    pushes = np.zeros((setup.samples, driven.size))
    for column, row in enumerate(driven):
        # A stream for each name: what other effects there are does not change the noise of one.
        key = zlib.crc32(model.state_names[row].encode())
        generator = np.random.default_rng(np.random.SeedSequence([setup.seed, key]))
        pushes[:, column] = sd[row] * generator.standard_normal(setup.samples)
    return driven, pushes


def _remembering(
    model: Model, start: FloatArray, command: FloatArray, start_values: Mapping[str, float]
) -> FloatArray:
    """A start at which what a model that steps remembers agrees with where it is, but as given."""
    equations = rest_equations(model)
    _, u, _, _ = model.symbols()
    s = ca.SX.sym("s", len(equations.unknowns))
    whole = ca.Function("whole", [s, u], [equations.state(s, u)])
    settled = np.array(whole(start[list(equations.unknowns)], command))[:, 0]
    for name in start_values:
        settled[model.state_index(name)] = start[model.state_index(name)]
    return settled


def _selected(
    measurement: ca.Function, channels: tuple[str, ...], available: tuple[str, ...]
) -> ca.Function:
    at = [ca.SX.sym(name, *measurement.size_in(name)) for name in ("x", "u", "p")]
    rows = [available.index(name) for name in channels]
    return ca.Function("sense", at, [measurement(*at)[rows]], ["x", "u", "p"], ["y"])


def _vector(values: Mapping[str, float], signals: tuple[Signal, ...], where: str) -> FloatArray:
    vector = np.zeros(len(signals))
    for name, value in values.items():
        vector[_position(name, names(signals), where)] = value
    return vector


def _unit_of(model: Model, state: str) -> str:
    return model.states[model.state_index(state)].unit


def _position(name: str, valid_names: tuple[str, ...], where: str) -> int:
    require_known(name, valid_names, f"unknown name {name!r}", f"{where}.{name}")
    return valid_names.index(name)
