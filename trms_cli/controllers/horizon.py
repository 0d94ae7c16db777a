"""The prediction over a horizon: trajectory, sensitivities, objective and penalties.

The future inputs are the only unknowns (single shooting): each input is constant over blocks of
control periods, ``u_k = z[:, block(k)]``, and the states follow by simulation, so that every
iterate is dynamically consistent. With ``e_k`` the deviation of the weighted states,

    J(z) = Σ_k Σ_i q_i e_ik² + Σ_k Σ_c d_c ((α_c,k − α_c,k−1)/T − ṙ_c,k)²
           + Σ_k Σ_j ρ_j (u_jk − u_s,j)² + Σ_b Σ_j s_j (z_jb − z_j,b−1)²
    φ(z) = J(z) + Σ_c (μ_c |v_c| + ν_c v_c²)

where ``ṙ`` is the rate of a reference that moves smoothly
(:mod:`trms_cli.controllers.reference_forecast`) and ``v`` are the scaled terminal residual
``x_N − x_s`` and the violations of soft limits. φ is an exact penalty function: with μ above the
multipliers its minimum meets the constraints exactly.

With a terminal region (:mod:`trms_cli.controllers.newton.region`) J also has the terminal cost
``‖L ξ_N‖²`` of ``ξ_N = (x_N − x_s, u_N−1 − u_s)``, and the terminal v is ``max(0, ‖L ξ_N‖ − √α)``;
a contractive terminal (:mod:`trms_cli.controllers.newton.terminals`) has that v without the cost.
A linear model (:mod:`trms_cli.controllers.linear_mpc`) has such a cost without the region, its
ṙ is zero, and its matrices are arguments in place of the parameters.
"""

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Self

import casadi as ca
import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import ControlSetup, Delay
from trms_cli.controllers.reference_forecast import smooth_rates
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction, argument_array
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.ranges import NotNegative, Positive
from trms_cli.models.discretisation import DiscreteModel
from trms_cli.models.model import Model, names
from trms_cli.models.state_scales import bench_ratios

#: Arguments of both compiled functions: initial state with memory, plan, last command, parameters,
#: disturbances, references, steady-state target; then what stays the same during a run: weights of
#: the errors (states, then rates), inputs and moves, limits (lower; upper), prices (linear and
#: quadratic, of the terminal equality and of the limits), scale of the terminal residual.
ARGUMENTS = (
    *("x0", "z", "u_previous", "p", "w", "r", "x_s", "u_s"),
    *("q", "rho", "s", "limits", "prices", "scale"),
)

#: Further ones of a horizon that has a cost of its end: ξ's origin, the cost's root L, and √α.
REGION_ARGUMENTS = ("centre", "root", "radius")

#: Usual control periods of a horizon; of an unstable model they end after a growth by e to this,
#: but not before.
_PERIODS, _MOST_GROWTH, _LEAST_PERIODS = 40, 5.0, 5
#: Usual weights of an error and its rate (1 and s², by the square of its scale) and of a move, for
#: a model with signals of its own.
_ERROR, _RATE, _MOVE = 1.0, 0.5, 0.0125

#: Added under the root of ‖L ξ_N‖², whose slope would else be no number at the centre.
_SMOOTH = 1e-20


@dataclass(frozen=True, kw_only=True)
class HorizonSettings:
    """What every controller with a horizon is configured by."""

    sample_time: Positive = 0.1  #: Control period, s
    delay: Delay = "none"
    #: N, control periods; as it stands here, fewer of an unstable model of a user's
    prediction_horizon: Annotated[int, Meta(ge=2, le=1000)] = _PERIODS
    #: Lengths of the blocks over which an input is constant, in control periods (the control
    #: horizon). The last block lasts to the end of the prediction horizon; what is beyond it is
    #: left out.
    move_blocks: tuple[int, ...] = (1,) * 10 + (2,) * 5 + (4,) * 5
    #: How many control periods ahead the reference is known, at most N; beyond, it is taken as
    #: constant, so that a terminal state leaves N − preview periods to settle
    preview_horizon: Annotated[int, Meta(ge=0)] = 0
    #: How many control periods ahead a reference that is not known is carried on as the constant,
    #: ramp or sine that it has been so far (:mod:`trms_cli.controllers.reference_forecast`), at
    #: most N; 0 for none. Without effect where ``preview_horizon`` knows it.
    forecast_horizon: Annotated[int, Meta(ge=0)] = 15
    #: ``state_weights``, ``rate_weights``, ``input_weights``, ``move_weights``: See
    #: :class:`Weights`. For the Newton MPC each controlled state gets that of its typical size
    #: where none has a weight (the speed of a rotor alone); a model with signals of its own gets
    #: them by its scales, where none of them has one
    state_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 1.2, "alpha_h": 1.0}
    )
    rate_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"alpha_v": 0.5, "alpha_h": 0.38}
    )
    input_weights: Mapping[str, NotNegative] = field(default_factory=dict)
    move_weights: Mapping[str, NotNegative] = field(
        default_factory=lambda: {"u_v": 0.02, "u_h": 0.005}
    )
    #: Largest change per second, V/s
    input_rate_limits: Mapping[str, Positive] = field(default_factory=dict)
    #: Limits on states, met if at all possible; in the states' units
    soft_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    soft_linear: Positive = 100.0  #: Price of violating them by one unit
    soft_quadratic: Positive = 1000.0  #: Price of the square of the violation
    #: Steps of the model's integrator in a control period
    integration_steps: Annotated[int, Meta(ge=1)] = 1
    #: Whether the observer's constant disturbances enter prediction and target (offset-free)
    disturbance_compensation: bool = True

    def __post_init__(self) -> None:
        if self.preview_horizon > self.prediction_horizon:
            raise ConfigurationError(
                f"{self.preview_horizon} given",
                where="preview_horizon",
                remedy=f"at most the prediction horizon, {self.prediction_horizon}",
            )

    def for_model(self, model: Model) -> Self:
        """The settings with weights by the scales of a model, where those given name another's.

        Prices of soft limits are then of a share of the limited states' scale. The usual number of
        periods ends where what is unstable has grown by e⁵: beyond, a simulation of the plan says
        more of its rounding than of its inputs.
        """
        if model.bench_sizes:
            return self
        ratios, controlled = bench_ratios(model), model.controlled
        errors = ratios.states[[model.state_index(name) for name in controlled]] ** -2.0
        usual = {
            "state_weights": (controlled, _ERROR * errors),
            "rate_weights": (controlled, _RATE * ratios.time**2 * errors),
            "move_weights": (names(model.inputs), _MOVE * ratios.inputs**-2.0),
        }
        changes: dict[str, Any] = {
            key: {**getattr(self, key), **dict(zip(signals, weights.tolist(), strict=True))}
            for key, (signals, weights) in usual.items()
            if getattr(self, key) and not any(name in getattr(self, key) for name in signals)
        }
        limited = [model.state_index(n) for n in self.soft_limits if n in model.state_names]
        unit = float(ratios.states[limited].min(initial=np.inf)) if limited else 1.0
        linear, quadratic = self.soft_linear / unit, self.soft_quadratic / unit**2
        if self.prediction_horizon == _PERIODS:
            until = _MOST_GROWTH / max(ratios.growth * self.sample_time, 1e-9)
            least = max(_LEAST_PERIODS, self.preview_horizon)
            changes["prediction_horizon"] = int(np.clip(until, least, _PERIODS))
        return replace(self, **changes, soft_linear=linear, soft_quadratic=quadratic)

    @property
    def forecast_periods(self) -> int:
        """Control periods for which a reference that is not known is carried on."""
        ahead = 0 if self.preview_horizon else self.forecast_horizon
        return min(ahead, self.prediction_horizon)

    def preview(self, setup: ControlSetup) -> int:
        """Reference samples wanted beyond the present one."""
        return self.preview_horizon


@dataclass(frozen=True)
class Weights:
    """Weights of the objective, by state or input name."""

    #: q: of the squared deviation of a state, 1/unit². A controlled angle deviates from its
    #: reference, any other state from its value at the steady-state target.
    states: Mapping[str, float]
    #: d: of the squared mean rate of a controlled angle over each control period, less that of a
    #: reference that moves smoothly, s²/unit². It damps the motion itself; a weight on the angular
    #: momentum S would also punish the momentum that holds an axis still while the other axis'
    #: rotor changes its speed.
    rates: Mapping[str, float]
    inputs: Mapping[str, float]  #: ρ: of the squared deviation from the steady-state input, 1/V²
    moves: Mapping[str, float]  #: s: of the squared change between successive blocks, 1/V²


@dataclass(frozen=True)
class SoftLimits:
    """Limits on states that may be violated at a price."""

    states: Mapping[str, tuple[float, float]]  #: Lower and upper limit, in the state's unit
    #: ``linear``, ``quadratic``: μ and ν: price of a violation, 1/unit and 1/unit²
    linear: float
    quadratic: float


@dataclass(frozen=True)
class TerminalPrice:
    """Price of missing the terminal constraint (see :class:`Horizon`).

    That is the terminal equality, in scaled units, or a terminal region, in the root of the
    objective's.
    """

    linear: float  #: μ
    quadratic: float  #: ν
    #: Whether the horizon ends in a region with a cost of its own instead of the steady state.
    region: bool = False
    cost: bool = True  #: Whether a region has that cost


def blocks_of(prediction_horizon: int, lengths: tuple[int, ...]) -> IntArray:
    """Block index of each control period, shape (N,).

    Blocks beyond the horizon are left out; the last one lasts to its end.

    Raises ConfigurationError if there is no block, or one of no length.
    """
    if not lengths or min(lengths) < 1:
        raise ConfigurationError(
            f"{list(lengths)!r} given",
            where="move_blocks",
            remedy="one length or more, each of at least 1 control period",
        )
    index = np.repeat(np.arange(len(lengths)), lengths)[:prediction_horizon]
    rest = np.full(prediction_horizon - len(index), index[-1])
    return np.concatenate([index, rest])


def check_problem(model: Model, weights: Weights, limits: SoftLimits) -> None:
    """Raise :class:`ConfigurationError` for a limit or a name that makes no sense."""
    inputs = names(model.inputs)
    for name, (lower, upper) in limits.states.items():
        if not lower < upper:
            raise ConfigurationError(
                f"[{lower:g}, {upper:g}] given",
                where=f"soft_limits.{name}",
                remedy="the lower limit first, and below the upper one",
            )
    for where, entries, allowed_names in (
        ("state_weights", weights.states, model.state_names),
        ("rate_weights", weights.rates, model.controlled),
        ("input_weights", weights.inputs, inputs),
        ("move_weights", weights.moves, inputs),
        ("soft_limits", limits.states, model.state_names),
    ):
        check_names(entries, allowed_names, where)


#: Names of the 2 DOF rig, so that one configuration also serves its 1 DOF models.
_OF_BOTH_AXES = {"alpha_v", "alpha_h", "S_v", "S_h", "omega_v", "omega_h", "u_v", "u_h"}


def check_names(entries: Iterable[str], allowed_names: Sequence[str], where: str) -> None:
    """Raise :class:`ConfigurationError` for a name that neither this model nor its kin has."""
    for name in entries:
        if name not in _OF_BOTH_AXES:
            require_known(name, allowed_names, f"the model has no {name!r}", f"{where}.{name}")


class Horizon:
    """Prediction of a discretised model, compiled when it is first asked for.

    ``discrete``: one control period. ``blocks``: (N,); from :func:`blocks_of`. ``scale``: (n_x,);
    typical size of each state; the terminal residual is divided by it. Weights, limits, prices and
    parameters are arguments, not constants: one compiled function serves every tuning of one
    structure. ``linear``: see above.
    """

    def __init__(
        self,
        discrete: DiscreteModel,
        blocks: IntArray,
        weights: Weights,
        soft_limits: SoftLimits,
        terminal: TerminalPrice | None,
        scale: FloatArray,
        *,
        linear: bool = False,
    ) -> None:
        model = discrete.model
        check_problem(model, weights, soft_limits)
        self.model, self.discrete, self.blocks = model, discrete, blocks
        self.n_periods, self.n_blocks = len(blocks), int(blocks[-1]) + 1
        self.n_z = self.n_blocks * model.n_u
        self.weighted = tuple(name for name in model.state_names if weights.states.get(name))
        self.damped = tuple(name for name in model.controlled if weights.rates.get(name))
        self.limited = tuple(name for name in model.state_names if name in soft_limits.states)
        self.weights, self.soft_limits = weights, soft_limits
        self.terminal, self.scale = terminal, scale
        self.has_region = terminal is not None and terminal.region
        self.is_linear = linear
        #: Added to the Hessian's diagonal, 1/V²: inputs without influence stay where they are.
        self.regularisation = 1e-9 if linear else 1e-6
        self.has_end_cost = linear or (terminal is not None and terminal.region and terminal.cost)
        #: :data:`ARGUMENTS`, and :data:`REGION_ARGUMENTS` with a cost of the end or a region.
        self.argument_names = (
            *ARGUMENTS,
            *(REGION_ARGUMENTS if self.has_end_cost or self.has_region else ()),
        )
        #: Terminal residuals: one a state of the equality, a single one of a region, or none.
        self.n_terminal = 0 if terminal is None else 1 if terminal.region else model.n_x
        #: Arguments of both compiled functions by name.
        self.arguments = {name: argument_array(size) for name, size in self._sizes().items()}
        for name, value in self._settings().items():
            self.arguments[name][...] = value

    @functools.cached_property
    def linearise(self) -> BufferedFunction:
        """The compiled prediction with its slopes.

        Arguments → states (n_x, N), terminal residual, scaled (n_x,), objective, merit, violation;
        then gradient of J (n_z,), its Gauss–Newton root G (n_errors·N, n_z) with 2 GᵀG the Hessian
        of the part of states and rates, slope of the terminal residual (n_x, n_z), slopes of the
        limited states (n_limited·N, n_z). With a terminal region the residual is ``‖L ξ_N‖ − √α``
        (1,), and G has the rows of the terminal cost besides.
        """
        function = self._function(with_sensitivities=True)
        return BufferedFunction(function, inputs=tuple(self.arguments.values()))

    @functools.cached_property
    def evaluate(self) -> BufferedFunction:
        """The compiled prediction: the same arguments → the first five of these."""
        function = self._function(with_sensitivities=False)
        return BufferedFunction(function, inputs=tuple(self.arguments.values()))

    def _settings(self) -> dict[str, FloatArray]:
        """Values of the arguments that stay the same during a run."""
        model, weights, soft, terminal = (
            self.model,
            self.weights,
            self.soft_limits,
            self.terminal or TerminalPrice(0.0, 0.0),
        )
        limits = [soft.states[name] for name in self.limited]
        return {
            "p": np.zeros(1) if self.is_linear else model.parameters.values,
            "q": np.array(
                [weights.states[name] for name in self.weighted]
                + [weights.rates[name] for name in self.damped]
            ),
            "rho": np.array([weights.inputs.get(name, 0.0) for name in names(model.inputs)]),
            "s": np.array([weights.moves.get(name, 0.0) for name in names(model.inputs)]),
            "limits": np.array(limits).reshape(-1, 2),
            "prices": np.array([terminal.linear, terminal.quadratic, soft.linear, soft.quadratic]),
            "scale": self.scale,
        }

    def _sizes(self) -> dict[str, tuple[int, int]]:
        """Of the arguments, by name."""
        model, discrete = self.model, self.discrete
        n, n_x, n_u = self.n_periods, model.n_x, model.n_u
        sizes = {
            "x0": (discrete.n_x, 1),
            "z": (n_u, self.n_blocks),
            "u_previous": (n_u, 1),
            "p": discrete.step.size_in(2),
            "w": (model.n_w, 1),
            "r": (len(model.controlled), n),
            "x_s": (n_x, 1),
            "u_s": (n_u, 1),
            "q": (len(self.weighted) + len(self.damped), 1),
            "rho": (n_u, 1),
            "s": (n_u, 1),
            "limits": (len(self.limited), 2),
            "prices": (4, 1),
            "scale": (n_x, 1),
            "centre": (discrete.n_x + n_u, 1),
            "root": (discrete.n_x + n_u, discrete.n_x + n_u),
            "radius": (1, 1),
        }
        return {name: sizes[name] for name in self.argument_names}

    def _function(self, *, with_sensitivities: bool) -> ca.Function:
        discrete, model, n = self.discrete, self.model, self.n_periods
        stage = _stage(discrete, with_sensitivities)
        n_x, n_u = model.n_x, model.n_u
        at = {name: ca.MX.sym(name, *size) for name, size in self._sizes().items()}

        state, states, slopes = at["x0"], [], []
        sensitivity = ca.MX(discrete.n_x, 0)
        for k in range(n):
            u = at["z"][:, int(self.blocks[k])]
            if not with_sensitivities:
                state = stage(state, u, at["p"], at["w"])
            else:
                state, a, b = stage(state, u, at["p"], at["w"])
                sensitivity = _propagated(sensitivity, a, b, k, self.blocks)
                slopes.append(sensitivity)
            states.append(state)
        trajectory = ca.horzcat(*states)
        residual = (trajectory[:n_x, -1] - at["x_s"]) / at["scale"]
        objective = self._objective(trajectory, at)
        if self.has_end_cost or self.has_region:
            end = at["root"] @ (ca.vertcat(trajectory[:, -1], at["z"][:, -1]) - at["centre"])
        if self.has_end_cost:
            objective += ca.sumsqr(end)
        if self.has_region:
            distance = ca.sqrt(ca.sumsqr(end) + _SMOOTH)
            residual = distance - at["radius"]
        merit, violation = self._merit(objective, trajectory, residual, at)
        results = [trajectory, residual, objective, merit, violation]
        if not with_sensitivities:
            return ca.Function("horizon_evaluate", list(at.values()), results)
        root = self._root(slopes, ca.sqrt(at["q"]))
        errors = ca.repmat(ca.sqrt(at["q"]), n, 1) * ca.vec(self._errors(trajectory, at))
        of_inputs = ca.vec(ca.jacobian(self._input_objective(at), at["z"]))
        gradient = 2 * root.T @ errors + of_inputs
        terminal_slope = sensitivity[:n_x, :] / ca.repmat(at["scale"], 1, self.n_z)
        if self.has_end_cost or self.has_region:
            last = ca.horzcat(ca.MX(n_u, self.n_z - n_u), ca.MX.eye(n_u))
            in_end = at["root"] @ ca.vertcat(sensitivity, last)
        if self.has_end_cost:
            gradient += 2 * in_end.T @ end
            root = ca.vertcat(root, in_end)
        if self.has_region:
            terminal_slope = end.T @ in_end / distance
        results += [
            gradient,
            root,
            terminal_slope,
            ca.vertcat(*(self._padded(slope, self.limited) for slope in slopes)),
        ]
        return ca.Function(
            "horizon_linearise", list(at.values()), [ca.densify(result) for result in results]
        )

    def _padded(self, slope: ca.MX, states: tuple[str, ...]) -> ca.MX:
        """Slopes of some states at one period, with zeros for the blocks not begun yet."""
        rows = [self.model.state_index(name) for name in states]
        return ca.horzcat(slope[rows, :], ca.MX(len(rows), self.n_z - slope.shape[1]))

    def _root(self, slopes: list[ca.MX], factors: ca.MX) -> ca.MX:
        """G: slopes of all errors at all periods, each times its factor, (n_errors·N, n_z)."""
        period = self.discrete.step_length
        before, parts = ca.MX(len(self.damped), self.n_z), []
        for slope in slopes:
            angles = self._padded(slope, self.damped)
            errors = ca.vertcat(self._padded(slope, self.weighted), (angles - before) / period)
            parts.append(ca.repmat(factors, 1, self.n_z) * errors)
            before = angles
        return ca.vertcat(*parts)

    def _errors(self, trajectory: ca.MX, at: Mapping[str, ca.MX]) -> ca.MX:
        """Deviations of the weighted states, then rates, over the horizon, (n_errors, N)."""
        model, errors = self.model, []
        for name in self.weighted:
            row = model.state_index(name)
            controlled = name in model.controlled
            goal = at["r"][model.controlled.index(name), :] if controlled else at["x_s"][row]
            errors.append(trajectory[row, :] - goal)
        goal_rates = smooth_rates(at["r"], self.discrete.step_length)
        if self.is_linear:
            goal_rates = ca.MX.zeros(*goal_rates.shape)
        for name in self.damped:
            row = model.state_index(name)
            before = ca.horzcat(at["x0"][row], trajectory[row, :-1])
            rate = (trajectory[row, :] - before) / self.discrete.step_length
            errors.append(rate - goal_rates[model.controlled.index(name), :])
        return ca.vertcat(*errors)

    def _objective(self, trajectory: ca.MX, at: Mapping[str, ca.MX]) -> ca.MX:
        squares = ca.sum2(self._errors(trajectory, at) ** 2)
        return ca.dot(at["q"], squares) + self._input_objective(at)

    def _input_objective(self, at: Mapping[str, ca.MX]) -> ca.MX:
        """The part of J that depends on the inputs alone."""
        periods = ca.repmat(ca.DM(np.bincount(self.blocks)).T, self.model.n_u, 1)
        deviation = at["z"] - ca.repmat(at["u_s"], 1, self.n_blocks)
        inputs = ca.dot(at["rho"], ca.sum2(periods * deviation**2))
        moves = at["z"] - ca.horzcat(at["u_previous"], at["z"][:, :-1])
        return inputs + ca.dot(at["s"], ca.sum2(moves**2))

    def _merit(
        self, objective: ca.MX, trajectory: ca.MX, residual: ca.MX, at: Mapping[str, ca.MX]
    ) -> tuple[ca.MX, ca.MX]:
        prices = at["prices"]
        merit, violation = objective, ca.MX(0)
        if self.has_region:
            outside = ca.fmax(residual, 0)
            merit += prices[0] * outside + prices[1] * outside**2
        elif self.terminal is not None:
            merit += prices[0] * ca.sum1(ca.fabs(residual)) + prices[1] * ca.sumsqr(residual)
        for i, name in enumerate(self.limited):
            value = trajectory[self.model.state_index(name), :]
            lower, upper = at["limits"][i, 0], at["limits"][i, 1]
            beyond = ca.fmax(ca.fmax(lower - value, value - upper), 0)
            merit += prices[2] * ca.sum2(beyond) + prices[3] * ca.sumsqr(beyond)
            violation = ca.fmax(violation, ca.mmax(beyond))
        return merit, violation


def _stage(discrete: DiscreteModel, with_sensitivities: bool) -> ca.Function:
    """One control period: (x, u, p, w) → x⁺ [, ∂x⁺/∂x, ∂x⁺/∂u]."""
    if with_sensitivities:
        return discrete.slopes("stage")
    if len(discrete.parts) > 1:
        return discrete.step
    x, u, p, w = discrete.symbols()
    return ca.Function("stage", [x, u, p, w], ca.cse([discrete.step(x, u, p, w)]))


def _propagated(sensitivity: ca.MX, a: ca.MX, b: ca.MX, k: int, blocks: IntArray) -> ca.MX:
    """∂x_{k+1}/∂z for the blocks begun so far: S⁺ = A S, plus B in the present block."""
    if k == 0:
        return b
    n_u = b.shape[1]
    successor = a @ sensitivity
    if blocks[k] != blocks[k - 1]:
        return ca.horzcat(successor, b)
    return ca.horzcat(successor[:, :-n_u], successor[:, -n_u:] + b)
