"""Unscented Kalman filter with integrating disturbances.

The state of the model is augmented by constant torques d on chosen equations,

    x⁺ = F(x, u, p, d) + v_x      d⁺ = d + v_d      y = h(x, u, p) + v_y

so that the estimate is free of offset under constant disturbance and model mismatch, and a
controller can make the output so too. Sigma points are drawn anew between prediction and update:
on a linear model the filter is the Kalman filter.

The covariance is updated in Joseph's form over the sigma points,

    P = Σ_i W_i (x̃_i − K ỹ_i)(x̃_i − K ỹ_i)ᵀ + K R Kᵀ

a sum of squares for non-negative weights (which the defaults have), with a floor far below every
physical scale. A missing channel's row of ỹ is zero: the update conditions exactly on the others.
The memory of an input path (past commands of a delay) is known and is carried beside the points;
what the sensors remember is as uncertain as the states, and belongs to the points.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated

import casadi as ca
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.discrete import copied_states, root_of
from trms_cli.models.discretisation import discretise
from trms_cli.models.model import Model, names
from trms_cli.observers.initial_state import resting_state
from trms_cli.observers.observer import Estimate, ObserverSetup
from trms_cli.observers.sigma_points import SigmaPoints
from trms_cli.observers.state_kinds import kinds_of_disturbances, kinds_of_states
from trms_cli.observers.ukf_step import filter_step

FloatArray = npt.NDArray[np.float64]
_Positive = Annotated[float, Meta(gt=0)]
_NotNegative = Annotated[float, Meta(ge=0)]

#: Longest explicit integration step over which the rig's dynamics are smooth, s.
_LONGEST_SUBSTEP = 0.02
#: Standard deviations never fall below this part of the initial ones.
_FLOOR = 1e-9


class ProcessNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Intensities of white noise on the states: over T seconds a state spreads by ``q·√T``.

    Attributes
    ----------
    angle : float
        rad/√s.
    momentum : float
        (rad/s)/√s, on angular momenta over inertia.
    rotor : float
        (rad/s)/√s, on rotor speeds.
    current : float
        A/√s.
    other : float
        State's unit/√s, on states that effects add.
    disturbance : float
        N m/√s, the random walk of the estimated torques on the axes.
    rotor_disturbance : float
        N m/√s, the same on the rotors, whose own torques are a tenth of the axes'.
    acceleration, rotor_acceleration : float
        rad/s²/√s, the same for a black box, which knows accelerations in place of torques.
    speed : float
        (rad/s)/√s, on the rotor speeds of a black box. Its steady state shifts with the noise of
        what it is given, by the curvature of its surface: it is better told little of it.
    past : float
        State's unit/√s, on states that only remember an output or input; what was, stays.
    states : dict of str to float
        Other values for single states (or disturbances), by name.
    """

    angle: _NotNegative = 2e-4
    momentum: _NotNegative = 0.02
    rotor: _NotNegative = 3.0
    current: _NotNegative = 0.05
    other: _NotNegative = 0.01
    disturbance: _NotNegative = 2e-3
    rotor_disturbance: _NotNegative = 2e-4
    acceleration: _NotNegative = 0.05
    rotor_acceleration: _NotNegative = 8.0
    speed: _NotNegative = 0.5
    past: _NotNegative = 0.0
    states: Mapping[str, _NotNegative] = {}


class InitialSd(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard deviations before the first measurement; units as the states'.

    Attributes
    ----------
    angle, momentum, rotor, current, other : float
        rad, rad/s, rad/s, A, the state's unit.
    disturbance, rotor_disturbance : float
        N m, of the torques on the axes and on the rotors.
    acceleration, rotor_acceleration : float
        rad/s², of what a black box has in place of torques.
    speed : float
        rad/s, rotor speeds of a black box.
    past : float
        State's unit, on states that only remember an output or input.
    states : dict of str to float
        Other values for single states (or disturbances), by name.
    """

    angle: _Positive = 0.1
    momentum: _Positive = 0.1
    rotor: _Positive = 20.0
    current: _Positive = 0.2
    other: _Positive = 0.1
    disturbance: _Positive = 0.01
    rotor_disturbance: _Positive = 0.002
    acceleration: _Positive = 0.2
    rotor_acceleration: _Positive = 80.0
    speed: _Positive = 20.0
    past: _Positive = 0.002
    states: Mapping[str, _Positive] = {}


@dataclass
class UkfState:
    """The filter at a sample.

    Attributes
    ----------
    function : BufferedFunction
        One step; its inputs hold the present mean, covariance and memory.
    estimate : Estimate
        Views of its outputs.
    prior_mean, prior_covariance : arrays
        Before the first measurement; where the filter recovers to.
    present : (n_y,) bool array
        Channels that the last measurement had.
    started : bool
        Whether there was a sample yet.
    recoveries : int
        How often the covariance had to be inflated to the prior.
    """

    function: BufferedFunction
    estimate: Estimate
    prior_mean: FloatArray
    prior_covariance: FloatArray
    present: npt.NDArray[np.bool_]
    started: bool = False
    recoveries: int = 0


@dataclass(frozen=True, kw_only=True)
class Ukf:
    """Unscented Kalman filter.

    Attributes
    ----------
    alpha, beta, kappa : float
        Spread of the sigma points; see :class:`SigmaPoints`. With α = 1 and κ = 0 no weight is
        negative.
    disturbances : list of str or None
        Equations of the model that an integrating disturbance is estimated on. None takes all of
        them where there are as many measured channels, else the torque on each axis: tracking is
        offset-free only with as many integrators as channels (Pannocchia & Rawlings 2003, AIChE
        J. 49), since a biased rotor speed must be explained too.
    process_noise : ProcessNoise
    measurement_noise : dict of str to float
        Standard deviation by channel, instead of what the rig declares.
    initial_sd : InitialSd
    substeps : int or None
        Integration steps a sample; None takes as many as keep them to 0.02 s.
    """

    alpha: Annotated[float, Meta(gt=0, le=1)] = 1.0
    beta: Annotated[float, Meta(ge=0)] = 2.0
    kappa: float = 0.0
    disturbances: tuple[str, ...] | None = None
    process_noise: ProcessNoise = field(default_factory=ProcessNoise)
    measurement_noise: Mapping[str, _Positive] = field(default_factory=dict)
    initial_sd: InitialSd = field(default_factory=InitialSd)
    substeps: Annotated[int, Meta(ge=1)] | None = None

    def init(self, setup: ObserverSetup) -> UkfState:
        model = setup.model
        equations = self._equations(setup)
        channels = setup.channels()
        substeps = self.substeps or max(1, int(np.ceil(setup.sample_time / _LONGEST_SUBSTEP)))
        discrete = discretise(model, setup.sample_time, substeps, sensors=True)
        n_s = model.n_x + discrete.n_sensors
        points = SigmaPoints(n_s + len(equations), self.alpha, self.beta, self.kappa)

        shown = discrete.states[model.n_x : n_s]
        augmented = (
            *(*model.state_names, *names(shown)),
            *(names(model.disturbances)[i] for i in equations),
        )
        pushes = kinds_of_disturbances(model)
        kinds = (
            *(*kinds_of_states(model), *("past" for _ in shown)),
            *(pushes[i] for i in equations),
        )
        noise_sd = self._noise_sd(setup)
        sd = _by_state(self.initial_sd, kinds, augmented, "initial_sd.states")
        for i, channel in _read_at_first(setup):
            # What is remembered of a channel starts from its first, noisy reading.
            sd[i] = np.hypot(sd[i], noise_sd[channel])
        intensity = _by_state(self.process_noise, kinds, augmented, "process_noise.states")
        driven = _driven_by_noise(model, setup.sample_time)
        for row in np.flatnonzero(driven):
            if augmented[row] not in self.process_noise.states:
                intensity[row] = driven[row] / np.sqrt(setup.sample_time)

        start = resting_state(
            model,
            dict(zip(setup.outputs, setup.first_measurement, strict=True)),
            setup.first_command,
        )
        settled = discrete.initial(start, setup.first_command)
        mean = np.concatenate([settled[:n_s], np.zeros(len(equations))])
        function = BufferedFunction(filter_step(discrete, equations, channels, points))
        arguments = dict(zip(function.function.name_in(), function.inputs, strict=True))
        arguments["m"][:] = mean
        arguments["P"][...] = np.diag(sd**2)
        arguments["memory"][:] = settled[n_s:]
        arguments["p"][:] = model.parameters.values
        # A command that is remembered is known: its variance is the floor, or there is no root.
        floor = (_FLOOR * sd) ** 2
        arguments["q"][:] = np.maximum(intensity**2 * setup.sample_time, floor)
        arguments["r"][:] = noise_sd**2
        arguments["floor"][:] = floor
        results = dict(zip(function.function.name_out(), function.outputs, strict=True))
        estimate = Estimate(
            x=results["m_next"][: model.n_x],
            sd=results["sd"][: model.n_x],
            disturbance=results["d"],
            disturbance_sd=results["d_sd"],
            predicted=results["predicted"],
            innovation=results["innovation"],
            innovation_sd=results["innovation_sd"],
        )
        present = np.zeros(len(channels), dtype=bool)
        return UkfState(function, estimate, mean, np.diag(sd**2), present)

    def step(
        self,
        state: UkfState,
        command: FloatArray,
        measurement: FloatArray,
        truth: Mapping[str, float] | None,
        known: FloatArray | None = None,
    ) -> Estimate:
        function = state.function
        m, covariance, memory, u, y, mask, advance, acting = function.inputs[:8]
        if known is not None:
            acting[:] = known
        np.isfinite(measurement, out=state.present)
        u[:] = command
        mask[:] = state.present
        y[:] = 0.0
        np.copyto(y, measurement, where=state.present)
        # At time zero there is nothing to predict over: the prior meets the first measurement.
        advance[0] = state.started
        state.started = True
        function()
        m_next, covariance_next, memory_next, health = function.outputs[:4]
        if not np.isfinite(health[0]):
            self._recover(state)
        m[:] = m_next
        covariance[...] = covariance_next
        memory[:] = memory_next
        if not state.present.all():
            state.estimate.innovation[~state.present] = np.nan
        return state.estimate

    def _recover(self, state: UkfState) -> None:
        """Get a finite estimate when a factorisation failed or a model step overflowed.

        The step is repeated from the prior covariance; then from the prior mean too; then without
        the measurement, which no state explains.
        """
        state.recoveries += 1
        function = state.function
        m, covariance, memory, _, _, mask, _ = function.inputs[:7]
        health = function.outputs[3]
        covariance[...] = state.prior_covariance
        function()
        if not np.isfinite(health[0]):
            m[:] = state.prior_mean
            function()
        if not np.isfinite(health[0]):
            mask[:] = 0.0
            state.present[:] = False
            function()
        if not np.isfinite(health[0]):
            for result in function.outputs:
                result[...] = 0.0
            function.outputs[0][:] = m
            function.outputs[1][...] = covariance
            function.outputs[2][:] = memory

    def _equations(self, setup: ObserverSetup) -> list[int]:
        """Positions of the disturbances that are estimated."""
        model = setup.model
        known = names(model.disturbances)
        if self.disturbances is None:
            if len(setup.outputs) >= model.n_w:
                return list(range(model.n_w))
            return [known.index(axis.moment) for axis in model.axes.values()]
        for name in self.disturbances:
            if name not in known:
                raise ConfigurationError(
                    f"model {model.name!r} has no equation for {name!r}",
                    where="observer.disturbances",
                    remedy=nearest(name, known),
                )
        return [known.index(name) for name in dict.fromkeys(self.disturbances)]

    def _noise_sd(self, setup: ObserverSetup) -> FloatArray:
        for name in self.measurement_noise:
            if name not in setup.outputs:
                raise ConfigurationError(
                    f"the rig measures no {name!r}",
                    where="observer.measurement_noise",
                    remedy=nearest(name, setup.outputs),
                )
        declared = {**setup.noise_sd, **self.measurement_noise}
        sd = np.array([declared.get(name, 0.0) for name in setup.outputs])
        for name, value in zip(setup.outputs, sd, strict=True):
            if not value > 0:
                raise ConfigurationError(
                    f"the noise of {name!r} is not declared",
                    where="observer.measurement_noise",
                    remedy=f"observer.measurement_noise.{name}=… (standard deviation)",
                )
        return sd


def _driven_by_noise(model: Model, sample_time: float) -> FloatArray:
    """What noise adds to each state in a sample by the model itself, shape (n_x,)."""
    _, _, p, _ = model.symbols()
    added = ca.Function("added", [p], [ca.densify(model.noise_sd(p, sample_time))])
    return np.asarray(added(model.parameters.values)).ravel()


def _read_at_first(setup: ObserverSetup) -> Iterator[tuple[int, int]]:
    """States that remember a measured channel, and the position of that channel in y."""
    model, copies = setup.model, copied_states(setup.model)
    for i in copies:
        kind, source = root_of(copies, i)
        if kind == "x" and model.state_names[source] in setup.outputs:
            yield i, setup.outputs.index(model.state_names[source])


def _by_state(
    table: ProcessNoise | InitialSd, kinds: tuple[str, ...], augmented: tuple[str, ...], key: str
) -> FloatArray:
    """A table's value for each state: by name where given, else by kind."""
    for name in table.states:
        if name not in augmented:
            raise ConfigurationError(
                f"the filter has no state {name!r}",
                where=f"observer.{key}",
                remedy=nearest(name, augmented),
            )
    return np.array(
        [
            table.states.get(name, getattr(table, kind))
            for name, kind in zip(augmented, kinds, strict=True)
        ]
    )
