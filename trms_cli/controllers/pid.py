"""Decentralised PID: the main rotor holds pitch, the tail rotor holds yaw.

For each axis, with reference r, angle α and control period T,

    v = u_ff + k_p (b r̃ − α) + I + D            u = v cut to the limits
    I⁺ = I + k_i T (r̃ − α) + (T/T_t)(u − v)     back-calculation against windup
    D  = a D₋ − k_d (1 − a)/T (α − α₋)           on the measured angle, a = T_f/(T_f + T)

after Åström & Murray, "Feedback Systems", ch. 11. The feed-forward is the model's input in the
steady state at the reference; what the model misses, the integral supplies. Reference and
feed-forward each pass two equal first-order lags (r̃, u_ff), so that a step does not set the
lightly damped pitch swinging; the reference's are slower by what the rig takes to follow the
feed-forward, so that the integral does not gather the error of the transient.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.linear_design import Linearisation, require_drivable
from trms_cli.controllers.operating_point import SteadyState, Target
from trms_cli.controllers.pid_tuning import AxisPlant, Gains, Margins, held, margins, tuned, worst
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]
_Positive = Annotated[float, Meta(gt=0)]
_NotNegative = Annotated[float, Meta(ge=0)]
#: Which rotor holds which axis.
_ROTOR_OF_AXIS = {"pitch": "main", "yaw": "tail"}


@dataclass
class AxisState:
    """One axis: its fixed numbers and what it remembers.

    Attributes
    ----------
    state, reference, channel : int
        Positions of the angle in x, of its reference, and of its input in u.
    gains : Gains
    step : float
        T, s.
    limit : float
        Largest input, V.
    keep, derivative_gain : float
        a, and k_d (1 − a)/T.
    tracking : float
        T/T_t, at most 1.
    integral, derivative : float
        I and D, V.
    last_angle : float
        rad.
    reference_lags, forward_lags : [float, float]
        What the two lags hold, rad and V.
    """

    state: int
    reference: int
    channel: int
    gains: Gains
    step: float
    limit: float
    keep: float
    derivative_gain: float
    tracking: float
    integral: float = 0.0
    derivative: float = 0.0
    last_angle: float = math.nan
    reference_lags: list[float] = field(default_factory=lambda: [0.0, 0.0])
    forward_lags: list[float] = field(default_factory=lambda: [0.0, 0.0])


@dataclass
class PidState:
    """All axes, and the feed-forward at the last reference.

    Attributes
    ----------
    axes : list of AxisState
    steady : SteadyState or None
        None without feed-forward.
    margins : dict of str to Margins
        Robustness of each axis' loop, the worst of the operating points.
    reference_keep, forward_keep : float
        Part that a lag keeps over one period.
    feed_forward : list of float
        By input, V, before the lags.
    reference : list of float
        For which the feed-forward and ``target`` are, rad.
    """

    axes: list[AxisState]
    steady: SteadyState | None
    margins: Mapping[str, Margins]
    reference_keep: float
    forward_keep: float
    feed_forward: list[float]
    reference: list[float] = field(default_factory=list)
    target: Target | None = None


@dataclass(frozen=True, kw_only=True)
class Pid:
    """PID on each axis.

    Attributes
    ----------
    pitch, yaw : "auto" or Gains
        ``auto`` tunes them for the model at the operating point; see
        :mod:`trms_cli.controllers.pid_tuning`.
    operating_points : list of dict of str to float
        Controlled angles at which the model is linearised for tuning, rad. Yaw must need thrust
        there: the tail rotor has no slope where it stands still.
    max_sensitivity : float
        M, the bound on the peak of the sensitivity in tuning.
    smoothness : dict of str to float
        ρ by axis, s: weight of the rate against the angle in tuning; 3 where none is given.
    derivative_filter : float
        T_f, s.
    setpoint_weight : float
        b, the part of the reference that the proportional term sees.
    reference_lag, forward_lag : float
        Time constant of each of the two lags on the reference and on the feed-forward, s; 0 for
        none.
    tracking_time : float or None
        T_t, s; None takes √(k_d/k_i), but not less than T.
    feed_forward : bool
    sample_time : float or None
        Control period, s; None takes every sample.
    """

    pitch: Literal["auto"] | Gains = "auto"
    yaw: Literal["auto"] | Gains = "auto"
    operating_points: tuple[Mapping[str, float], ...] = (
        {"alpha_v": -0.3, "alpha_h": 0.3},
        {"alpha_v": 0.0, "alpha_h": 0.5},
        {"alpha_v": 0.3, "alpha_h": 1.0},
    )
    max_sensitivity: Annotated[float, Meta(gt=1)] = 1.6
    smoothness: Mapping[str, _Positive] = field(default_factory=dict)
    derivative_filter: _Positive = 0.05
    setpoint_weight: Annotated[float, Meta(ge=0, le=1)] = 1.0
    reference_lag: _NotNegative = 1.3
    forward_lag: _NotNegative = 1.0
    tracking_time: _Positive | None = None
    feed_forward: bool = True
    sample_time: _Positive | None = None

    def __post_init__(self) -> None:
        if not self.operating_points:
            raise ConfigurationError(
                "no operating point given",
                where="operating_points",
                remedy="give at least one, as [{alpha_v: 0.0, alpha_h: 0.5}]",
            )
        for name in self.smoothness:
            if name not in _ROTOR_OF_AXIS:
                raise ConfigurationError(
                    f"{name!r} is not an axis",
                    where="smoothness",
                    remedy=nearest(name, _ROTOR_OF_AXIS),
                )

    def preview(self, setup: ControlSetup) -> int:
        return 0

    def init(self, setup: ControlSetup) -> PidState:
        model, T = setup.model, setup.sample_time
        steady = SteadyState(model)
        gains, robustness = self._gains(model, T, steady)
        keep = self.derivative_filter / (self.derivative_filter + T)
        axes = []
        for name, axis in model.axes.items():
            channel = _channel(model, name)
            g = gains[name]
            tracking = self.tracking_time or (math.sqrt(g.kd / g.ki) if g.ki and g.kd else 1.0)
            axes.append(
                AxisState(
                    state=model.state_index(axis.angle),
                    reference=model.controlled.index(axis.angle),
                    channel=channel,
                    gains=g,
                    step=T,
                    limit=float(model.input_bounds()[1][channel]),
                    keep=keep,
                    derivative_gain=g.kd * (1 - keep) / T,
                    tracking=min(1.0, T / tracking),
                )
            )
        return PidState(
            axes,
            steady if self.feed_forward else None,
            robustness,
            _kept(self.reference_lag, T),
            _kept(self.forward_lag, T),
            [0.0] * model.n_u,
        )

    def _gains(
        self, model: Model, T: float, steady: SteadyState
    ) -> tuple[dict[str, Gains], dict[str, Margins]]:
        """Gains by axis, tuned where they are not given, and the worst margins of each loop."""
        key = "controller.operating_points"
        given = {"pitch": self.pitch, "yaw": self.yaw}
        linearisation = Linearisation(model, T, steady)
        points = []
        for i, angles in enumerate(self.operating_points):
            points.append(linearisation.at(angles, f"{key}[{i}]"))
            if any(given[name] == "auto" for name in model.axes):
                require_drivable(points[-1], f"{key}[{i}]")
        gains: dict[str, Gains] = {}
        robustness: dict[str, Margins] = {}
        systems = [(point.A, point.B, point.C) for point in points]
        for name, axis in model.axes.items():
            channel, row = _channel(model, name), model.controlled.index(axis.angle)
            plants = [AxisPlant(A, B[:, channel], C[row], T) for A, B, C in systems]
            chosen = given[name]
            if not isinstance(chosen, Gains):
                chosen = tuned(
                    plants,
                    self.derivative_filter,
                    self.max_sensitivity,
                    self.smoothness.get(name, 3.0),
                    f"controller.{name}",
                )
            gains[name] = chosen
            robustness[name] = worst(
                margins(plant, chosen, self.derivative_filter) for plant in plants
            )
            # One loop after the other: the next axis is tuned with this one held.
            systems = [
                held(plant, chosen, self.derivative_filter, B, C)
                for plant, (_, B, C) in zip(plants, systems, strict=True)
            ]
        return gains, robustness

    def step(self, state: PidState, sample: ControlSample, *, want_prediction: bool) -> Command:
        x = sample.estimate.x.tolist()
        reference = sample.reference[0].tolist()
        previous = sample.previous_command
        if not math.isfinite(sum(x) + sum(reference)):
            return Command(
                previous.copy(),
                Status.FAILED,
                fallback="hold",
                message="the estimate or the reference is not finite; the last command is held",
            )
        if math.isnan(state.axes[0].last_angle):
            _start(state, x, previous.tolist(), self.setpoint_weight)
        if state.steady is not None and reference != state.reference:
            _aim(state, state.steady, reference)
        u, weight = previous.copy(), self.setpoint_weight
        reference_keep, forward_keep = state.reference_keep, state.forward_keep
        for axis in state.axes:
            angle, gains = x[axis.state], axis.gains
            wanted = _lagged(axis.reference_lags, reference[axis.reference], reference_keep)
            axis.derivative = axis.keep * axis.derivative - axis.derivative_gain * (
                angle - axis.last_angle
            )
            axis.last_angle = angle
            v = (
                _lagged(axis.forward_lags, state.feed_forward[axis.channel], forward_keep)
                + gains.kp * (weight * wanted - angle)
                + axis.integral
                + axis.derivative
            )
            cut = min(max(v, -axis.limit), axis.limit)
            axis.integral += gains.ki * axis.step * (wanted - angle) + axis.tracking * (cut - v)
            u[axis.channel] = cut
        return Command(u)


def _channel(model: Model, axis: str) -> int:
    """Input of the rotor that holds an axis.

    Raises
    ------
    ConfigurationError
        For a model with an axis or rotors of other names.
    """
    rotor = _ROTOR_OF_AXIS.get(axis, "")
    if rotor not in model.rotors:
        raise ConfigurationError(
            f"no rotor of model {model.name!r} is known to hold its axis {axis!r}",
            where="controller",
            remedy="pid knows the axes pitch and yaw with the rotors main and tail; try lqr",
        )
    return names(model.inputs).index(model.rotors[rotor])


def _kept(lag: float, period: float) -> float:
    """Part of its value that a first-order lag keeps over a period."""
    return math.exp(-period / lag) if lag > 0 else 0.0


def _lagged(held: list[float], value: float, keep: float) -> float:
    """A value behind two equal first-order lags, whose memory is updated."""
    held[0] = value + keep * (held[0] - value)
    held[1] = held[0] + keep * (held[1] - held[0])
    return held[1]


def _aim(state: PidState, steady: SteadyState, reference: list[float]) -> None:
    """Put the feed-forward at the steady state for a reference, if there is one."""
    target = steady.solve(np.array(reference), None, state.target)
    state.reference = reference
    if target.converged:
        state.target, state.feed_forward = target, target.u.tolist()


def _start(state: PidState, x: list[float], command: list[float], weight: float) -> None:
    """Bumpless: if the reference were where the rig is, the command in force would go on."""
    if state.steady is not None:
        angles = [0.0] * len(state.axes)
        for axis in state.axes:
            angles[axis.reference] = x[axis.state]
        _aim(state, state.steady, angles)
    for axis in state.axes:
        axis.last_angle = angle = x[axis.state]
        axis.reference_lags = [angle, angle]
        axis.forward_lags = [state.feed_forward[axis.channel]] * 2
        axis.integral = (
            command[axis.channel]
            - state.feed_forward[axis.channel]
            - axis.gains.kp * (weight - 1) * angle
        )
