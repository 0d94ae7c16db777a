"""The design of a PID law for a model: of each axis the tables, gains, filters and margins.

At each operating point the model is made linear, with the rotors' curves undone as the law undoes
them. The axes are designed one after the other, pitch first: each is tuned
(:mod:`trms_cli.controllers.pid_tuning`) with those before it held by their own loops, as they will
be.

Of a model with a path memory (a cable's hysteresis) there are two linear ones at each point: with
the memory as it is, which for small motions is a spring, and with it constant, as it is where the
axis has gone far one way. The bound on the sensitivity holds in both, and the cost is the sum over
both; what is fed forward is for far ways.

What is searched suits rigs that are as slow as small benches with two rotors. Another model is
designed for in a time of its own, in which it is as slow as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from trms_cli.controllers.pid_feed_forward import (
    INVERTED,
    PathMemory,
    PiecewiseLinear,
    RotorTables,
    decoupling,
    friction_torques,
    inverse,
    is_rotor_before_axis,
    path_memories,
    rotor_lag,
    rotor_tables,
    without_input_memory,
)
from trms_cli.controllers.pid_tuning import (
    AxisMargins,
    AxisPlant,
    Filters,
    Gains,
    margins,
    terms,
    tune_gains,
    with_loop_closed,
    worst,
)
from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.process_cache import call_memoised
from trms_cli.models.linearisation import Linearisation, LinearModel, require_drivable
from trms_cli.models.model import Model, names
from trms_cli.models.state_scales import bench_ratios, state_scales
from trms_cli.models.steady_state import SteadyState

#: A, B and C of the rig at one operating point, its inputs torques.
_System = tuple[FloatArray, FloatArray, FloatArray]

#: ρ where none is given, s.
_SMOOTHNESS = 3.0
#: Growth at which inputs are paired with axes, by a model's time constant.
_PAIRED = 0.1
#: Part by which a mode of an unstable rig grows in a period.
_UNSTABLE = 1e-3
#: Part by which a mode may grow in a period before a loop counts as unstable: an axis that nothing
#: pulls back has modes at 1, which rounding moves by its square root.
_GROWTH = 1e-6


@dataclass(frozen=True)
class AxisDesign:
    """One axis."""

    angle: str  #: State that is the axis' angle
    channel: int  #: Position of its rotor's input in u
    gains: Gains
    filters: Filters
    margins: AxisMargins  #: Of its loop, the worst of the operating points
    #: (c_0, c_1, c_2, c_3); torque by the angle and its derivatives, N m/rad, N m s/rad and so on
    inverse: tuple[float, ...]
    #: The same of the axis behind the law's lead, which undoes the rotor
    forward: tuple[float, ...]
    #: Torque by the rate of the torque fed forward to each axis before this one, s
    coupling: tuple[float, ...]
    curve: PiecewiseLinear  #: Input by torque, V by N m
    holding: PiecewiseLinear  #: torque by angle, N m by rad
    burdens: tuple[PiecewiseLinear, ...]  #: of each axis before this one; see RotorTables
    friction: PiecewiseLinear | None  #: torque by rate, N m by rad/s; None without dry friction
    memories: tuple[PathMemory, ...]  #: of the axis' path
    rotor_lag: float  #: τ, s, a delay of the commands left out; 0 for a rotor without


@dataclass(frozen=True, kw_only=True)
class PidDesign:
    """What is asked of a design."""

    #: dict of str to "auto" or Gains; by axis
    requested_gains: Mapping[str, Literal["auto"] | Gains]
    operating_points: Sequence[Mapping[str, float]]  #: Controlled angles, rad
    max_sensitivity: float  #: largest gain of the sensitivity function
    smoothness: Mapping[str, float]  #: By axis, s
    derivative_filter: float  #: s
    lead_filter: float  #: s

    def of(self, model: Model, step: float) -> dict[str, AxisDesign]:
        """The design for a model and a control period (s), by axis.

        Raises ConfigurationError by the key of an operating point or of gains that will not do.
        """
        return dict(call_memoised(PidDesign._of, self, model, step))

    def _of(self, model: Model, step: float) -> dict[str, AxisDesign]:
        if not model.axes:
            raise ConfigurationError(
                f"model {model.name!r} has no axis, and pid holds the angles of axes",
                where="controller",
                remedy="choose newton_mpc or lqr",
            )
        speed = 1 / bench_ratios(model).time
        named = any(name in point for point in self.operating_points for name in model.controlled)
        # of a model that none of them names there is but one, at rest
        points = self.operating_points if named or model.bench_sizes else ({},)
        wanted = replace(self._in_time(speed), operating_points=points)
        designs = wanted._designed(model, step, step * speed)
        return {name: _in_seconds(design, speed) for name, design in designs.items()}

    def _in_time(self, speed: float) -> PidDesign:
        """What is asked for, in a time that runs so much faster."""
        gains = {
            name: Gains(g.kp, g.ki / speed, g.kd * speed) if isinstance(g, Gains) else g
            for name, g in self.requested_gains.items()
        }
        return replace(
            self,
            requested_gains=gains,
            smoothness={name: rho * speed for name, rho in self.smoothness.items()},
            derivative_filter=self.derivative_filter * speed,
            lead_filter=self.lead_filter * speed,
        )

    def _designed(self, model: Model, period: float, step: float) -> dict[str, AxisDesign]:
        """The design for a control period (s) that is a step of the time of the design."""
        channels = loops_of(model, period)
        steady = SteadyState(model)
        tables = rotor_tables(model, channels, steady)
        constant = model.path_memory
        points = self._points(model, period, steady)
        as_they_are = [_driven_by_torques(point, channels, tables) for point in points]
        systems = [_without_states(system, constant) for system in as_they_are]
        # Beside them, where the loops have to be robust as well.
        springy = as_they_are if constant else []
        free = systems
        prompt: list[_System] | None = None
        if model.memory(period):
            immediate = without_input_memory(model)
            points = self._points(immediate, period, SteadyState(immediate))
            prompt = [
                _without_states(_driven_by_torques(point, channels, tables), constant)
                for point in points
            ]
        omega = np.exp(1j * INVERTED * step)
        designs: dict[str, AxisDesign] = {}
        for name, channel in channels.items():
            axis = model.axes[name]
            row = model.controlled.index(axis.angle)
            plants = [AxisPlant(A, B[:, channel], C[row], step) for A, B, C in systems + springy]
            responses = _responses(systems, channel, row, step)
            polynomial = inverse(responses, INVERTED)
            if not is_rotor_before_axis(polynomial):
                # The loops that are closed have bent it; what they do then is left to the feedback.
                responses = _responses(free, channel, row, step)
                polynomial = inverse(responses, INVERTED)
            filters = self._filters(rotor_lag(polynomial))
            lead = terms(omega, step, filters)[0]
            own = [lead * response for response in _responses(free, channel, row, step)]
            coupling = [
                self._decoupling(model, design, free, row, own, step) for design in designs.values()
            ]
            lag = rotor_lag(polynomial)
            if prompt is not None:
                lag = rotor_lag(inverse(_responses(prompt, channel, row, step), INVERTED))
            gains = self._gains(model, name, plants, filters)
            designs[name] = AxisDesign(
                angle=axis.angle,
                channel=channel,
                gains=gains,
                filters=filters,
                margins=worst(margins(plant, gains, filters) for plant in plants),
                inverse=tuple(polynomial.tolist()),
                forward=tuple(inverse([lead * r for r in responses], INVERTED).tolist()),
                coupling=tuple(coupling),
                curve=tables[name].curve,
                holding=tables[name].holding,
                burdens=tables[name].burdens,
                friction=friction_torques(model, name),
                memories=path_memories(model, name),
                rotor_lag=lag,
            )
            systems = _with_loop(systems, channel, row, step, gains, filters)
            springy = _with_loop(springy, channel, row, step, gains, filters)
            if prompt is not None:
                prompt = _with_loop(prompt, channel, row, step, gains, filters)
            following = list(channels)[len(designs) :]
            if any(self._is_tuned(other) for other in following):
                self._require_stable(name, systems)
        return designs

    def _decoupling(
        self,
        model: Model,
        other: AxisDesign,
        systems: Sequence[_System],
        row: int,
        own: Sequence[ComplexArray],
        step: float,
    ) -> float:
        """Torque on the axis of a row by the rate of the torque fed forward to another, s."""
        lead = terms(np.exp(1j * INVERTED * step), step, other.filters)[0]
        cross, itself = (
            [lead * response for response in _responses(systems, other.channel, r, step)]
            for r in (row, model.controlled.index(other.angle))
        )
        return decoupling(cross, own, itself, INVERTED, self.lead_filter)

    def _points(self, model: Model, step: float, steady: SteadyState) -> list[LinearModel]:
        linearisation = Linearisation(model, step, steady)
        points = []
        for i, angles in enumerate(self.operating_points):
            where = f"controller.operating_points[{i}]"
            points.append(linearisation.at(angles, where))
            if any(map(self._is_tuned, model.axes)):
                require_drivable(points[-1], where, model.path_memory)
        return points

    def _filters(self, lag: float) -> Filters:
        if lag > self.lead_filter:
            return Filters(self.derivative_filter, lag, self.lead_filter)
        return Filters(self.derivative_filter)

    def _is_tuned(self, axis: str) -> bool:
        return not isinstance(self.requested_gains.get(axis), Gains)

    def _gains(
        self, model: Model, name: str, plants: Sequence[AxisPlant], filters: Filters
    ) -> Gains:
        gains = self.requested_gains.get(name)
        if isinstance(gains, Gains):
            return gains
        smoothness, where = self.smoothness.get(name, _SMOOTHNESS), f"controller.{name}"
        try:
            return tune_gains(plants, filters, self.max_sensitivity, smoothness, where)
        except ConfigurationError as error:
            unstable = max(float(np.abs(np.linalg.eigvals(plant.A)).max()) for plant in plants)
            if unstable < 1 + _UNSTABLE:
                raise
            raise ConfigurationError(
                f"{model.name} is unstable at rest, and no PID law from {model.axes[name].angle} "
                "alone holds it: what falls is another state",
                where="controller",
                remedy="choose one that sees all states: lqr, linear_mpc, nmpc or newton_mpc",
            ) from error

    def _require_stable(self, name: str, systems: Sequence[_System]) -> None:
        """Refuse given gains with which another axis cannot be tuned."""
        for angles, (A, _, _) in zip(self.operating_points, systems, strict=True):
            if np.abs(np.linalg.eigvals(A)).max() > 1 + _GROWTH:
                where = ", ".join(f"{angle}={value:g}" for angle, value in angles.items())
                where = f"{where} rad" if where else "rest"
                raise ConfigurationError(
                    f"with these gains the loop of {name} is unstable at {where}, "
                    "and the other axis cannot be tuned beside it",
                    where=f"controller.{name}",
                    remedy="give a larger kd (N m s/rad; the axis hardly damps itself), smaller kp "
                    "(N m/rad) and ki (N m/(rad s)), or auto; or give the gains of both axes",
                )


def _driven_by_torques(
    point: LinearModel, channels: Mapping[str, int], tables: Mapping[str, RotorTables]
) -> _System:
    """The rig at a point, the rotors' curves undone as the law undoes them."""
    B = point.B.copy()
    for name, channel in channels.items():
        volts = float(point.target.u[channel])
        B[:, channel] /= tables[name].curve.inverse().slope(volts)
    return point.A, B, point.C


def _without_states(system: _System, positions: Sequence[int]) -> _System:
    """The rig with some states constant."""
    A, B, C = system
    kept = np.setdiff1d(np.arange(A.shape[0]), positions)
    return A[np.ix_(kept, kept)], B[kept], C[:, kept]


def _with_loop(
    systems: Sequence[_System], channel: int, row: int, step: float, gains: Gains, filters: Filters
) -> list[_System]:
    """The rig at each point with the loop of one axis closed."""
    plants = [AxisPlant(A, B[:, channel], C[row], step) for A, B, C in systems]
    return [
        with_loop_closed(plant, gains, filters, B, C)
        for plant, (_, B, C) in zip(plants, systems, strict=True)
    ]


def _responses(
    systems: Sequence[_System], channel: int, row: int, step: float
) -> list[ComplexArray]:
    """Of an angle to a torque asked for, rad/(N m), at the frequencies that are inverted."""
    z = np.exp(1j * INVERTED * step)
    return [AxisPlant(A, B[:, channel], C[row], step).response(z) for A, B, C in systems]


def _in_seconds(design: AxisDesign, speed: float) -> AxisDesign:
    """A design in a time that runs so much faster, in seconds."""
    gains, filters = design.gains, design.filters
    powers = [speed**i for i in range(len(design.inverse))]
    return replace(
        design,
        gains=Gains(gains.kp, gains.ki * speed, gains.kd / speed),
        filters=Filters(
            filters.derivative / speed, filters.lead / speed, filters.lead_filter / speed
        ),
        margins=replace(design.margins, crossover=design.margins.crossover * speed),
        inverse=tuple(c / power for c, power in zip(design.inverse, powers, strict=True)),
        forward=tuple(c / power for c, power in zip(design.forward, powers, strict=True)),
        coupling=tuple(d / speed for d in design.coupling),
        rotor_lag=design.rotor_lag / speed,
    )


def loops_of(model: Model, step: float) -> dict[str, int]:
    """Position of the input that holds each axis whose angle or position is controlled.

    That of its rotor; of a model without rotors the pairing of the largest gains, each as a share
    of what the input and the axis can. ``step``: control period, s.

    Raises ConfigurationError for more axes than inputs, and for what is controlled and no axis.
    """
    if model.rotors:
        return {name: holding_input(model, name) for name in model.axes}
    axes = {axis.angle: name for name, axis in model.axes.items()}
    for name in model.controlled:
        if name not in axes:
            raise ConfigurationError(
                f"{name} is controlled, which is the angle or position of no axis of {model.name}",
                where="controller",
                remedy="choose lqr, linear_mpc, nmpc or newton_mpc",
            )
    if len(model.controlled) > model.n_u:
        raise ConfigurationError(
            f"{model.name} has {model.n_u} inputs for {len(model.controlled)} controlled axes, "
            "and pid has one input for each",
            where="controller",
            remedy="choose lqr, linear_mpc, nmpc or newton_mpc",
        )
    if model.n_u == 1:
        return {axes[model.controlled[0]]: 0}
    from scipy.optimize import linear_sum_assignment

    linear = Linearisation(model, step, SteadyState(model)).at({}, "controller.operating_points")
    scales = state_scales(model)
    z = np.exp(_PAIRED * step / scales.time)
    gain = linear.C @ np.linalg.solve(z * np.eye(len(linear.A)) - linear.A, linear.B)
    travels = scales.states[[model.state_index(name) for name in model.controlled]]
    shares = np.abs(gain) * scales.inputs / travels[:, None]
    rows, columns = linear_sum_assignment(-np.log(shares + np.finfo(float).tiny))
    return {axes[model.controlled[r]]: int(c) for r, c in zip(rows, columns, strict=True)}


def holding_input(model: Model, axis: str) -> int:
    """Input of the rotor that holds an axis.

    Raises ConfigurationError for a model with an axis or rotors of other names.
    """
    rotor = model.rotor_of(axis)
    if rotor is None:
        raise ConfigurationError(
            f"no rotor of model {model.name!r} is known to hold its axis {axis!r}",
            where="controller",
            remedy="pid knows the axes pitch and yaw with the rotors main and tail; try lqr",
        )
    return names(model.inputs).index(model.rotors[rotor].input)
