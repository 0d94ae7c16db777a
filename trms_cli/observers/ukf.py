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
The memory of an input path (past commands of a delay) is known and is carried beside the points.
"""

from __future__ import annotations

from collections.abc import Mapping
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
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model, index_of, names
from trms_cli.observers.initial_state import resting_state
from trms_cli.observers.observer import Estimate, ObserverSetup
from trms_cli.observers.sigma_points import SigmaPoints
from trms_cli.observers.state_kinds import kinds_of_states

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
        N m/√s, the random walk of the estimated torques.
    states : dict of str to float
        Other values for single states (or disturbances), by name.
    """

    angle: _NotNegative = 2e-4
    momentum: _NotNegative = 0.02
    rotor: _NotNegative = 3.0
    current: _NotNegative = 0.05
    other: _NotNegative = 0.01
    disturbance: _NotNegative = 2e-3
    states: Mapping[str, _NotNegative] = {}


class InitialSd(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard deviations before the first measurement; units as the states'.

    Attributes
    ----------
    angle, momentum, rotor, current, other : float
        rad, rad/s, rad/s, A, the state's unit.
    disturbance : float
        N m.
    states : dict of str to float
        Other values for single states (or disturbances), by name.
    """

    angle: _Positive = 0.1
    momentum: _Positive = 0.1
    rotor: _Positive = 20.0
    current: _Positive = 0.2
    other: _Positive = 0.1
    disturbance: _Positive = 0.01
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
        Equations of the model that an integrating disturbance is estimated on; None takes the
        torque on each axis.
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
        channels = [index_of(model.outputs, n, "an output of the model") for n in setup.outputs]
        substeps = self.substeps or max(1, int(np.ceil(setup.sample_time / _LONGEST_SUBSTEP)))
        discrete = discretise(model, setup.sample_time, substeps)
        points = SigmaPoints(model.n_x + len(equations), self.alpha, self.beta, self.kappa)

        augmented = (*model.state_names, *(names(model.disturbances)[i] for i in equations))
        kinds = (*kinds_of_states(model), *("disturbance" for _ in equations))
        sd = _by_state(self.initial_sd, kinds, augmented, "initial_sd.states")
        intensity = _by_state(self.process_noise, kinds, augmented, "process_noise.states")

        start = resting_state(
            model,
            dict(zip(setup.outputs, setup.first_measurement, strict=True)),
            setup.first_command,
        )
        mean = np.concatenate([start, np.zeros(len(equations))])
        function = BufferedFunction(_filter_step(discrete, equations, channels, points))
        arguments = dict(zip(function.function.name_in(), function.inputs, strict=True))
        arguments["m"][:] = mean
        arguments["P"][...] = np.diag(sd**2)
        arguments["memory"][:] = discrete.initial(start, setup.first_command)[model.n_x :]
        arguments["p"][:] = model.parameters.values
        arguments["q"][:] = intensity**2 * setup.sample_time
        arguments["r"][:] = self._noise_sd(setup) ** 2
        arguments["floor"][:] = (_FLOOR * sd) ** 2
        results = dict(zip(function.function.name_out(), function.outputs, strict=True))
        estimate = Estimate(
            x=results["m_next"][: model.n_x],
            sd=results["sd"],
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
    ) -> Estimate:
        function = state.function
        m, covariance, memory, u, y, mask, advance = function.inputs[:7]
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


def _filter_step(
    discrete: DiscreteModel, equations: list[int], channels: list[int], points: SigmaPoints
) -> ca.Function:
    """Prediction and update as one function, in stages so that it compiles in little time.

    The first seven inputs are ``m, P, memory, u, y, mask, advance``, the first four outputs the
    next ``m, P, memory`` and a number that is finite exactly if they are.
    """
    model = discrete.model
    n, n_x, n_y = points.n, model.n_x, len(channels)
    n_m, n_p = discrete.n_x - n_x, len(model.parameters)
    spread = _spread_stage(points)
    advance_one = _dynamics_stage(discrete, equations)
    predict = _prediction_stage(points)
    measure = _measurement_stage(model, channels, n)
    update = _update_stage(model, equations, points, n_y)

    m, P = ca.MX.sym("m", n), ca.MX.sym("P", n, n)
    memory, u, p = ca.MX.sym("memory", n_m), ca.MX.sym("u", model.n_u), ca.MX.sym("p", n_p)
    y, mask, advance = ca.MX.sym("y", n_y), ca.MX.sym("mask", n_y), ca.MX.sym("advance")
    q, r, floor = ca.MX.sym("q", n), ca.MX.sym("r", n_y), ca.MX.sym("floor", n)

    drawn = spread(m, P)
    count = points.count
    moved = advance_one.map(count)(
        drawn, ca.repmat(memory, 1, count), ca.repmat(u, 1, count), ca.repmat(p, 1, count)
    )
    m_prior, P_prior = predict(drawn, moved[:n, :], advance, q)
    memory_next = ca.if_else(advance > 0, moved[n:, 0], memory) if n_m else memory
    redrawn = spread(m_prior, P_prior)
    seen = measure.map(count)(redrawn, ca.repmat(u, 1, count), ca.repmat(p, 1, count))
    results = update(m_prior, redrawn, seen, y, mask, r, floor)
    m_next, P_next, health, *rest = results
    return ca.Function(
        "ukf_step",
        [m, P, memory, u, y, mask, advance, p, q, r, floor],
        [m_next, P_next, memory_next, health, *rest],
        ["m", "P", "memory", "u", "y", "mask", "advance", "p", "q", "r", "floor"],
        [
            *("m_next", "P_next", "memory_next", "health", "sd", "d", "d_sd"),
            *("predicted", "innovation", "innovation_sd"),
        ],
    )


def _spread_stage(points: SigmaPoints) -> ca.Function:
    m, P = ca.SX.sym("m", points.n), ca.SX.sym("P", points.n, points.n)
    return ca.Function("spread", [m, P], [points.around(m, P)])


def _dynamics_stage(discrete: DiscreteModel, equations: list[int]) -> ca.Function:
    """One sigma point (and the memory) over one sample."""
    model = discrete.model
    n_x = model.n_x
    z = ca.SX.sym("z", n_x + len(equations))
    memory, u = ca.SX.sym("memory", discrete.n_x - n_x), ca.SX.sym("u", model.n_u)
    p = ca.SX.sym("p", len(model.parameters))
    w = ca.SX.zeros(model.n_w)
    for k, equation in enumerate(equations):
        w[equation] = z[n_x + k]
    after = discrete.step(ca.vertcat(z[:n_x], memory), u, p, w)
    return ca.Function(
        "advance_one",
        [z, memory, u, p],
        [ca.densify(ca.vertcat(after[:n_x], z[n_x:], after[n_x:]))],
    )


def _prediction_stage(points: SigmaPoints) -> ca.Function:
    n, count = points.n, points.count
    before, after = ca.MX.sym("before", n, count), ca.MX.sym("after", n, count)
    advance, q = ca.MX.sym("advance"), ca.MX.sym("q", n)
    moved = ca.if_else(advance > 0, after, before)
    m = moved @ ca.DM(points.mean_weights)
    off = moved - ca.repmat(m, 1, count)
    P = _weighted(off, points) @ off.T + _diagonal(advance * q)
    return ca.Function("predict", [before, after, advance, q], [m, P])


def _weighted(off: ca.MX, points: SigmaPoints) -> ca.MX:
    """Deviations times their covariance weights."""
    return off * ca.repmat(ca.DM(points.covariance_weights).T, off.shape[0], 1)


def _diagonal(values: ca.MX) -> ca.MX:
    return ca.densify(ca.diag(values))


def _measurement_stage(model: Model, channels: list[int], n: int) -> ca.Function:
    z, u = ca.SX.sym("z", n), ca.SX.sym("u", model.n_u)
    p = ca.SX.sym("p", len(model.parameters))
    y = model.measurement(z[: model.n_x], u, p)[channels]
    return ca.Function("measure_one", [z, u, p], [ca.densify(y)])


def _update_stage(model: Model, equations: list[int], points: SigmaPoints, n_y: int) -> ca.Function:
    n, count = points.n, points.count
    m, drawn = ca.MX.sym("m", n), ca.MX.sym("drawn", n, count)
    seen = ca.MX.sym("seen", n_y, count)
    y, mask, r = ca.MX.sym("y", n_y), ca.MX.sym("mask", n_y), ca.MX.sym("r", n_y)
    floor = ca.MX.sym("floor", n)

    predicted = seen @ ca.DM(points.mean_weights)
    off_y = seen - ca.repmat(predicted, 1, count)
    S_all = _weighted(off_y, points) @ off_y.T
    off_y = off_y * ca.repmat(mask, 1, count)
    off_x = drawn - ca.repmat(m, 1, count)
    S = _weighted(off_y, points) @ off_y.T + _diagonal(mask * r + (1 - mask))
    gain = _gain_stage(n, n_y)(_weighted(off_x, points) @ off_y.T, S)
    innovation = mask * (y - predicted)
    m_next = m + gain @ innovation
    left = off_x - gain @ off_y
    P = (
        _weighted(left, points) @ left.T
        + (gain * ca.repmat((mask * r).T, n, 1)) @ gain.T
        + _diagonal(floor)
    )
    P = (P + P.T) / 2
    sd = ca.sqrt(ca.diag(P))
    d, d_sd = ca.MX.zeros(model.n_w), ca.MX.zeros(model.n_w)
    for k, equation in enumerate(equations):
        d[equation], d_sd[equation] = m_next[model.n_x + k], sd[model.n_x + k]
    return ca.Function(
        "update",
        [m, drawn, seen, y, mask, r, floor],
        [
            m_next,
            P,
            ca.sum1(m_next) + ca.sum1(sd) + ca.sum1(ca.vec(P)),
            sd[: model.n_x],
            d,
            d_sd,
            predicted,
            innovation,
            ca.sqrt(ca.diag(S_all) + r),
        ],
    )


def _gain_stage(n: int, n_y: int) -> ca.Function:
    """``cross S⁻¹`` by Cholesky factors."""
    cross, S = ca.SX.sym("cross", n, n_y), ca.SX.sym("S", n_y, n_y)
    root = ca.chol(S)
    gain = ca.solve(root, ca.solve(root.T, cross.T)).T
    return ca.Function("gain", [cross, S], [ca.densify(gain)])
