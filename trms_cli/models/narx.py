"""A trained NARX network as a model of a rig: a black box in the place of equations.

With the output y, the command u and their samples of before (k counts the model's own samples)::

    ŷ(k+1) = N(y(k), …, y(k − l), u(k), …, u(k − m))           or y(k) + N(…), incremental
    y_j(k+1) = ŷ_j(k+1) + T² w_j       for an angle
    y_j(k+1) = ŷ_j(k+1) + T w_j        for a speed

The state is y(k) under the outputs' own names, then the outputs and inputs that are remembered
(``alpha_v_lag1`` is alpha_v one sample ago). The disturbances w are accelerations: a constant one
moves the output of a network of second order as a constant torque moves the rig, whatever the
sample time. One for each output lets an observer explain any constant difference between the rig
and the network.

The weights are constants of the model and no parameters: there is no prior on them and no meaning
to one of them.

Source: S. Chen, S. A. Billings & P. M. Grant 1990, "Non-linear system identification using neural
networks", Int. J. Control 51(6).
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import nearest
from trms_cli.models.discrete import SteppedModel
from trms_cli.models.model import Axis, FloatArray, Signal
from trms_cli.models.network import NarxStructure, Network
from trms_cli.models.parameters import ParameterSet
from trms_cli.models.rest import rest_equations

#: Axis of each angle and input of each rotor, as other models name them.
_AXES = {"alpha_v": "pitch", "alpha_h": "yaw"}
_ROTORS = {"u_v": "main", "u_h": "tail"}
_ANGLE = "rad"
#: Bound of a command that no limit is given for, by unit.
_LIMITS = {"V": 2.5, "1": 1.0}
#: Newton steps to the rest, and the seconds of free run before them.
_ITERATIONS, _SETTLING = 50, 60.0
_AT_REST = 1e-10


class Narx(SteppedModel):
    """A network that predicts the next outputs from past outputs and commands.

    Parameters
    ----------
    structure : NarxStructure
        What the regressor is made of.
    network : Network
        Of as many regressors and outputs as the structure has.
    name : str
    limits : mapping
        Symmetric bounds by input, and mechanical stops by angle (rad). Inputs without one have
        2.5 V, or 1 for normalised commands.

    Raises
    ------
    ModelError
        If network and structure do not fit, or a limit names no input or angle.
    """

    def __init__(
        self,
        structure: NarxStructure,
        network: Network,
        *,
        name: str = "narx",
        limits: Mapping[str, float] | None = None,
    ) -> None:
        _check_fit(structure, network)
        self.name, self.structure, self.network = name, structure, network
        self.sample_time = structure.sample_time
        self.outputs = tuple(map(Signal, structure.outputs, structure.output_units))
        self.inputs = tuple(map(Signal, structure.inputs, structure.input_units))
        remembered = [
            *_remembered(self.outputs, structure.output_lags[-1] - 1),
            *_remembered(self.inputs, structure.input_lags[-1] - 1),
        ]
        self.states = (*self.outputs, *remembered)
        self.disturbances = tuple(
            Signal(f"{y.name}_push", _acceleration_unit(y), f"acceleration added to {y.name}")
            for y in self.outputs
        )
        self.parameters = ParameterSet([], name)
        angles = tuple(y.name for y in self.outputs if y.unit == _ANGLE)
        self.controlled = angles or structure.outputs
        bounds = _checked_limits(limits or {}, structure)
        self.input_limits = {u.name: _limit(u, bounds) for u in self.inputs}
        self.stops = {angle: bounds.get(angle, np.inf) for angle in angles}
        self.axes = {_AXES.get(angle, angle): Axis(angle, f"{angle}_push") for angle in angles}
        self.rotors = {_ROTORS[u]: u for u in structure.inputs if u in _ROTORS}
        self._rest: FloatArray | None = None

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n_y, n_u = self.n_y, self.n_u
        kept_y = n_y * (self.structure.output_lags[-1] - 1)
        # y(k), y(k − 1), … and u(k), u(k − 1), …: newest first, all signals of a sample together
        outputs = x[: n_y + kept_y, 0]
        inputs = ca.vertcat(u, x[n_y + kept_y :, 0])
        lagged = ca.vertcat(
            *(outputs[n_y * (lag - 1) : n_y * lag, 0] for lag in self.structure.output_lags),
            *(inputs[n_u * (lag - 1) : n_u * lag, 0] for lag in self.structure.input_lags),
        )
        following = self.network.expression(ca.DM(self.structure.arrangement()) @ lagged)
        if self.structure.incremental:
            following += outputs[:n_y, 0]
        following += ca.DM(self._push_scale()) * w
        return ca.vertcat(following, outputs[:kept_y, 0], inputs[: inputs.shape[0] - n_u, 0])

    def measurement(self, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        return x[: self.n_y, 0]

    def rest(self) -> FloatArray:
        """Where the network settles without a command, as nearly as it does."""
        if self._rest is None:
            self._rest = _settled(self)
        return self._rest.copy()

    def _push_scale(self) -> FloatArray:
        """Change of each output in a step by a unit of its disturbance."""
        T = self.structure.sample_time
        return np.array([T**2 if y.unit == _ANGLE else T for y in self.outputs])


def _check_fit(structure: NarxStructure, network: Network) -> None:
    for key, given, expected in (
        ("regressor_mean", network.n_regressors, structure.n_regressors),
        ("output_mean", network.n_outputs, len(structure.outputs)),
    ):
        if given != expected:
            raise ModelError(
                f"the network has {given} and the structure {expected}",
                where=f"network.{key}",
                remedy="structure and network belong together: take both from one training",
            )


def _checked_limits(limits: Mapping[str, float], structure: NarxStructure) -> Mapping[str, float]:
    angles = [
        name
        for name, unit in zip(structure.outputs, structure.output_units, strict=True)
        if unit == _ANGLE
    ]
    # A network of one axis keeps the limits of the whole rig in its file.
    known = {*structure.inputs, *angles, *_AXES, *_ROTORS}
    for name, limit in limits.items():
        if name not in known:
            raise ModelError(
                f"there is no input or angle {name!r}",
                where=f"limits.{name}",
                remedy=nearest(name, known),
            )
        if not limit > 0:
            raise ModelError(
                f"{limit!r} given", where=f"limits.{name}", remedy="give a positive number"
            )
    return limits


def _limit(command: Signal, bounds: Mapping[str, float]) -> float:
    if command.name not in bounds and command.unit not in _LIMITS:
        raise ModelError(
            f"no limit for {command.name!r} in {command.unit}",
            where=f"limits.{command.name}",
            remedy="give the largest command",
        )
    return bounds.get(command.name, _LIMITS.get(command.unit, np.inf))


def _remembered(signals: tuple[Signal, ...], count: int) -> list[Signal]:
    """Signals one, two, … samples ago, all of one sample together."""
    return [
        Signal(f"{s.name}_lag{k}", s.unit, f"{s.name} {k} sample{'s' if k > 1 else ''} ago")
        for k in range(1, count + 1)
        for s in signals
    ]


def _acceleration_unit(output: Signal) -> str:
    if output.unit in (_ANGLE, "rad/s"):
        return "rad/s^2"
    return f"{output.unit}/s"


def _settled(model: Narx) -> FloatArray:
    """A fixed point without a command: a free run, then Newton's method from where it ended.

    The run goes to a fixed point that is stable, where the network has several; an end that
    Newton's method does not improve is kept as it is.
    """
    equations = rest_equations(model)
    _, u, p, w = model.symbols()
    s = ca.SX.sym("s", len(equations.unknowns))
    residual = equations.residual(s, u, p, w)
    newton = ca.Function("newton", [s, u, p, w], [residual, ca.jacobian(residual, s)])
    lifted = ca.Function("lifted", [s, u], [equations.state(s, u)])
    still = (np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))

    rows = list(equations.unknowns)
    n_y = model.n_y
    start = np.zeros(model.n_x)
    start[:n_y] = model.network.regressor_mean[:n_y]
    at = model.symbols()
    step = ca.Function("free", list(at), [model.transition(*at)])
    count = max(1, round(_SETTLING / model.sample_time))
    held = (ca.repmat(ca.DM(value), 1, count) for value in still)
    ends = np.array(step.mapaccum(count)(lifted(start[rows], still[0]), *held))[:, -1]
    point = ends[rows] if np.isfinite(ends).all() else start[rows]
    found = _newton(newton, point, still)
    return np.array(lifted(found, still[0]))[:, 0]


def _newton(
    function: ca.Function, start: FloatArray, constant: tuple[FloatArray, ...]
) -> FloatArray:
    point = start.copy()
    for _ in range(_ITERATIONS):
        rate, slope = (np.array(value) for value in function(point, *constant))
        move, *_ = np.linalg.lstsq(slope, -rate[:, 0], rcond=1e-10)
        point = point + move
        if not np.isfinite(point).all():
            return start
        if np.abs(move).max() < _AT_REST * (1.0 + np.abs(point).max()):
            return point
    return start
