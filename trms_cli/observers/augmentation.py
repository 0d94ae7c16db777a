"""A model as a filter sees it: its state, what its sensors remember, and constant torques.

    z = (x, sensors' memory, d)
    x⁺ = F(x, u, p, d) + v_x      d⁺ = d + v_d      y = h(x, u, p) + v_y

The torques d on chosen equations make an estimate free of offset under constant disturbance and
model mismatch, and let a controller make the output so too. The memory of an input path (past
commands of a delay) is known and is carried beside z; what the sensors remember is as uncertain
as the states, and belongs to z.

Noise and prior ignorance are tables by kind of state. A kind (an angle, a rotor's speed, a torque
on an axis) is read off the model's structure, so that one table serves every model; see
:mod:`trms_cli.models.state_kinds`. The numbers are of small benches with two rotors; those of a
model of a user's are these in the proportion of its scales (:mod:`trms_cli.models.state_scales`),
where they have not been changed.
"""

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated

import casadi as ca
import msgspec
import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.discrete import copied_states, root_of
from trms_cli.models.discretisation import DiscreteModel, discretise, noise_of_states
from trms_cli.models.dry_friction import turning_rate
from trms_cli.models.model import Model, Signal, names
from trms_cli.models.rest import resting_state
from trms_cli.models.scales import BENCH
from trms_cli.models.state_kinds import kinds_of_disturbances, kinds_of_states
from trms_cli.models.state_scales import state_scales
from trms_cli.models.vector_field import holds_at_rest, without_impulses
from trms_cli.observers.observer import ObserverSetup

#: Longest explicit integration step over which the rig's dynamics are smooth, s.
_LONGEST_SUBSTEP = 0.02
#: Friction stops an axis that a torque moves by less than this share of its free response.
_STOPPED = 0.01
#: What is large of each kind on a small bench; 1 where nothing stands here.
_BENCH_SCALES = {
    "momentum": BENCH.travel / BENCH.time,  # rad/s
    "rotor": 200.0,  # rad/s
    "disturbance": BENCH.force,
    "rotor_disturbance": BENCH.force / 10,
}
#: Standard deviations never fall below this part of the initial ones.
_FLOOR = 1e-9


class ProcessNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Intensities of white noise on the states: over T seconds a state spreads by ``q·√T``."""

    angle: NotNegative = 2e-4  #: rad/√s
    momentum: NotNegative = 0.02  #: (rad/s)/√s, on angular momenta over inertia
    rotor: NotNegative = 3.0  #: (rad/s)/√s, on rotor speeds
    current: NotNegative = 0.05  #: A/√s
    other: NotNegative = 0.01  #: State's unit/√s, on states that effects add
    disturbance: NotNegative = 2e-3  #: N m/√s, the random walk of the estimated torques on the axes
    #: N m/√s, the same on the rotors, whose own torques are a tenth of the axes'
    rotor_disturbance: NotNegative = 2e-4
    #: ``acceleration``, ``rotor_acceleration``: rad/s²/√s, the same for a black box, which knows
    #: accelerations in place of torques
    acceleration: NotNegative = 0.05
    rotor_acceleration: NotNegative = 8.0
    #: (rad/s)/√s, on the rotor speeds of a black box. Its steady state shifts with the noise of
    #: what it is given, by the curvature of its surface: it is better told little of it.
    speed: NotNegative = 0.5
    #: State's unit/√s, on states that only remember an output or input; what was, stays
    past: NotNegative = 0.0
    #: Other values for single states (or disturbances), by name
    states: Mapping[str, NotNegative] = {}


class InitialSd(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard deviations before the first measurement; units as the states'."""

    angle: Positive = 0.1  #: rad
    momentum: Positive = 0.1  #: rad/s
    rotor: Positive = 20.0  #: rad/s
    current: Positive = 0.2  #: A
    other: Positive = 0.1  #: In the state's unit
    #: ``disturbance``, ``rotor_disturbance``: N m, of the torques on the axes and on the rotors
    disturbance: Positive = 0.01
    rotor_disturbance: Positive = 0.002
    #: ``acceleration``, ``rotor_acceleration``: rad/s², of what a black box has in place of torques
    acceleration: Positive = 0.2
    rotor_acceleration: Positive = 80.0
    speed: Positive = 20.0  #: rad/s, rotor speeds of a black box
    past: Positive = 0.002  #: State's unit, on states that only remember an output or input
    #: Other values for single states (or disturbances), by name
    states: Mapping[str, Positive] = {}


def by_state(
    table: ProcessNoise | InitialSd,
    kinds: tuple[str, ...],
    augmented: tuple[str, ...],
    key: str,
    ratios: FloatArray | float = 1.0,
) -> FloatArray:
    """A table's value for each state: by name where given, else by kind.

    ``ratios``: by which the usual value of a kind is multiplied; a changed one is as it is.
    ``kinds``, ``augmented``: kind and name of each state of the filter, disturbances included.
    ``key``: where names are given in the observer's configuration, for messages. Raises
    ConfigurationError for a name that the filter does not have.
    """
    for name in table.states:
        require_known(name, augmented, f"the filter has no state {name!r}", f"observer.{key}")
    usual = type(table)()
    values = [
        getattr(table, kind) * (ratio if getattr(table, kind) == getattr(usual, kind) else 1.0)
        for kind, ratio in zip(kinds, np.broadcast_to(ratios, len(kinds)), strict=True)
    ]
    return np.array([table.states.get(n, v) for n, v in zip(augmented, values, strict=True)])


@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """What all filters of this room are told."""

    #: Equations of the model that an integrating disturbance is estimated on. None takes all of
    #: them where there are as many measured channels, else the torque on each axis: tracking is
    #: offset-free only with as many integrators as channels (Pannocchia & Rawlings 2003, AIChE J.
    #: 49), since a biased rotor speed must be explained too.
    disturbances: tuple[str, ...] | None = None
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    #: Standard deviation by channel, instead of what the rig declares
    measurement_noise: Mapping[str, Positive] = field(default_factory=dict)
    initial_sd: InitialSd = field(default_factory=InitialSd)
    #: Integration steps a sample; None takes as many as keep them to 0.02 s
    substeps: Annotated[int, Meta(ge=1)] | None = None
    #: Innovations beyond this many of their standard deviations are taken for outliers, channel by
    #: channel; None believes everything
    gate: Positive | None = 20.0
    #: s; a channel that was rejected without a break for so long is believed again
    longest_rejection: Positive = 0.5


@dataclass(frozen=True, kw_only=True)
class AugmentedModel:
    """The equations that a filter believes: all that its step is built from."""

    discrete: DiscreteModel  #: One sample, with the sensors' memory
    substeps: int  #: Parts of a sample that it is integrated over
    equations: list[int]  #: Disturbances that are estimated
    channels: list[int]  #: Measured ones of the model's outputs
    names: tuple[str, ...]  #: Of z, shape (n,)

    @property
    def model(self) -> Model:
        return self.discrete.model

    @property
    def n(self) -> int:
        """Length of z."""
        return len(self.names)

    @property
    def n_s(self) -> int:
        """Length of z without the disturbances."""
        return self.model.n_x + self.discrete.n_sensors

    @property
    def n_m(self) -> int:
        """Length of the input path's memory."""
        return self.discrete.n_x - self.n_s

    def symbols(self, kind: type[ca.SX] | type[ca.MX] = ca.SX) -> tuple[ca.SX, ...]:
        """Fresh symbols ``(z, memory, u, p, w_known)``."""
        model = self.model
        sizes = {
            "z": self.n,
            "memory": self.n_m,
            "u": model.n_u,
            "p": len(model.parameters),
            "known": model.n_w,
        }
        return tuple(kind.sym(name, size) for name, size in sizes.items())

    def torques(self, z: ca.SX, w_known: ca.SX) -> ca.SX:
        """All disturbances: the known ones, and what is estimated beside them, (n_w, 1)."""
        w = type(w_known)(w_known)
        for k, equation in enumerate(self.equations):
            w[equation] += z[self.n_s + k]
        return w

    def gliding(self) -> DiscreteModel | None:
        """The same sample with the axes gliding freely; None for a model without dry friction."""
        if not holds_at_rest(self.model):
            return None
        return discretise(
            without_impulses(self.model), self.discrete.step_length, self.substeps, sensors=True
        )

    def observable(self) -> ca.Function | None:
        """``(z, memory, u, p, w_known)`` → 1 for what a sample tells of, 0 for what it does not.

        (n, 1). It does not tell of the torque on an axis or rotor that dry friction stops: the
        friction takes up whatever that torque is. None for a model whose friction stops nothing.
        """
        gliding = self.gliding()
        if gliding is None:
            return None
        z, memory, u, p, w_known = self.symbols()
        x_0, w = ca.vertcat(z[: self.n_s, 0], memory), self.torques(z, w_known)
        with_friction, without = (
            step(x_0, u, p, w)[: self.model.n_x, 0] for step in (self.discrete.step, gliding.step)
        )
        entries = [ca.SX.ones(self.n_s)]
        for k, equation in enumerate(self.equations):
            rate, torque = turning_rate(self.model, equation), z[self.n_s + k]
            if rate is None:
                entries.append(ca.SX(1))
                continue
            response, free_response = (
                ca.fabs(ca.jacobian(rate(x, u, p, w), torque)) for x in (with_friction, without)
            )
            entries.append(response > _STOPPED * free_response)
        observable = ca.cse([ca.densify(ca.vertcat(*entries))])
        return ca.Function("observable", [z, memory, u, p, w_known], observable)

    def measured(self, z: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        """The measured channels, (n_y, 1)."""
        # What is known beside z, past commands, has no part in a measurement.
        full = ca.vertcat(z[: self.n_s, 0], ca.SX.zeros(self.n_m))
        return self.discrete.measurement(full, u, p)[self.channels]


@dataclass(frozen=True, kw_only=True)
class Augmentation(AugmentedModel):
    """A model made ready for a filter: its equations, where it starts, and its noise."""

    mean: FloatArray  #: (n,) arrays; before the first measurement
    sd: FloatArray  #: (n,) arrays; before the first measurement
    memory: FloatArray  #: (n_m,) array; of the input path, after a long time at the first command
    q: FloatArray  #: (n,) array; variances that a sample adds to z
    r: FloatArray  #: (n_y,) array; variances of the measurement noise
    floor: FloatArray  #: (n,) array; least variances, far below every physical scale

    def alone(self) -> AugmentedModel:
        """The equations without their numbers: the same for every run of one model."""
        return AugmentedModel(
            discrete=self.discrete,
            substeps=self.substeps,
            equations=self.equations,
            channels=self.channels,
            names=self.names,
        )


def augment(setup: ObserverSetup, options: FilterOptions) -> Augmentation:
    """The model of a setup as a filter with these options sees it.

    Raises ConfigurationError for names that the model or the rig does not have, and for a channel
    whose noise nobody declared.
    """
    model, rounding_sd = _without_rounding(setup.model)
    equations = _equations(setup, options.disturbances)
    channels = setup.channels()
    substeps = options.substeps or max(1, int(np.ceil(setup.sample_time / _LONGEST_SUBSTEP)))
    discrete = discretise(model, setup.sample_time, substeps, sensors=True)
    n_s = model.n_x + discrete.n_sensors
    sensor_states = discrete.states[model.n_x : n_s]
    augmented = (
        *(*model.state_names, *names(sensor_states)),
        *(names(model.disturbances)[i] for i in equations),
    )
    pushes = kinds_of_disturbances(model)
    kinds = (
        *(*kinds_of_states(model), *("past" for _ in sensor_states)),
        *(pushes[i] for i in equations),
    )
    noise_sd = np.hypot(_noise_sd(setup, options.measurement_noise), rounding_sd[channels])
    ratios, time_ratio = _ratios(model, kinds, sensor_states, equations)
    sd = by_state(options.initial_sd, kinds, augmented, "initial_sd.states", ratios)
    for i, channel in _read_at_first(setup):
        # What is remembered of a channel starts from its first, noisy reading.
        sd[i] = np.hypot(sd[i], noise_sd[channel])
    ratios /= np.sqrt(time_ratio)
    intensity = by_state(options.process_noise, kinds, augmented, "process_noise.states", ratios)
    driven = noise_of_states(model, model.parameters.values, setup.sample_time)
    for row in np.flatnonzero(driven):
        if augmented[row] not in options.process_noise.states:
            intensity[row] = driven[row] / np.sqrt(setup.sample_time)
    start = resting_state(
        model, dict(zip(setup.outputs, setup.first_measurement, strict=True)), setup.first_command
    )
    settled = discrete.initial(start, setup.first_command)
    # A command that is remembered is known: its variance is the floor, or there is no root.
    floor = (_FLOOR * sd) ** 2
    return Augmentation(
        discrete=discrete,
        substeps=len(discrete.parts) if model.sample_time is not None else substeps,
        equations=equations,
        channels=channels,
        names=augmented,
        mean=np.concatenate([settled[:n_s], np.zeros(len(equations))]),
        sd=sd,
        memory=settled[n_s:],
        q=np.maximum(intensity**2 * setup.sample_time, floor),
        r=noise_sd**2,
        floor=floor,
    )


def _ratios(
    model: Model, kinds: tuple[str, ...], sensors: tuple[Signal, ...], equations: list[int]
) -> tuple[FloatArray, float]:
    """Scale of each state of a filter over that of its kind on a small bench, and that of time."""
    if model.bench_sizes or model.sample_time is not None:
        return np.ones(len(kinds)), 1.0
    scales = state_scales(model)
    by_unit = {
        signal.unit: scales.states[model.state_names.index(signal.name)]
        for signal in model.outputs
        if signal.name in model.state_names
    }
    remembered = [by_unit.get(signal.unit, 1.0) for signal in sensors]
    own = np.concatenate([scales.states, remembered, scales.disturbances[equations]])
    return own / [_BENCH_SCALES.get(kind, 1.0) for kind in kinds], scales.time / BENCH.time


def _without_rounding(model: Model) -> tuple[Model, FloatArray]:
    """The model with sensors that do not round, and the deviation that rounding adds, (n_y,).

    All sigma points may lie within a quantum: they would read alike, and a measurement would tell
    nothing until the angle had gone a quantum astray. A filter therefore takes rounding for noise,
    of the deviation of a uniform one.
    """
    sd, exact = np.zeros(model.n_y), {}
    for name, row in model.resolutions().items():
        sd[row] = np.hypot(sd[row], model.parameters[name].value / np.sqrt(12))
        exact[name] = 0.0
    if exact:
        model = copy.copy(model)
        model.parameters = model.parameters.replaced(exact)
    return model, sd


def _equations(setup: ObserverSetup, selection: tuple[str, ...] | None) -> list[int]:
    """Positions of the disturbances that are estimated."""
    model = setup.model
    equation_names = names(model.disturbances)
    if selection is None:
        if len(setup.outputs) >= model.n_w:
            return list(range(model.n_w))
        return [equation_names.index(axis.moment) for axis in model.axes.values()]
    for name in selection:
        problem = f"model {model.name!r} has no equation for {name!r}"
        require_known(name, equation_names, problem, "observer.disturbances")
    return [equation_names.index(name) for name in dict.fromkeys(selection)]


def _noise_sd(setup: ObserverSetup, overrides: Mapping[str, float]) -> FloatArray:
    for name in overrides:
        require_known(
            name, setup.outputs, f"the rig measures no {name!r}", "observer.measurement_noise"
        )
    declared = {**setup.noise_sd, **overrides}
    sd = np.array([declared.get(name, 0.0) for name in setup.outputs])
    for name, value in zip(setup.outputs, sd, strict=True):
        if not value > 0:
            raise ConfigurationError(
                f"the noise of {name!r} is not declared",
                where="observer.measurement_noise",
                remedy=f"observer.measurement_noise.{name}=… (standard deviation)",
            )
    return sd


def _read_at_first(setup: ObserverSetup) -> Iterator[tuple[int, int]]:
    """States that remember a measured channel, and the position of that channel in y."""
    model, copies = setup.model, copied_states(setup.model)
    for i in copies:
        kind, source = root_of(copies, i)
        if kind == "x" and model.state_names[source] in setup.outputs:
            yield i, setup.outputs.index(model.state_names[source])
