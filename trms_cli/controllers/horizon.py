"""The prediction over a horizon, compiled: trajectory, sensitivities, objective and penalties.

The future inputs are the only unknowns (single shooting): each input is constant over blocks of
control periods, ``u_k = z[:, block(k)]``, and the states follow by simulation, so that every
iterate is dynamically consistent. With ``e_k`` the deviation of the weighted states,

    J(z) = Σ_k Σ_i q_i e_ik² + Σ_k Σ_j ρ_j (u_jk − u_s,j)² + Σ_b Σ_j s_j (z_jb − z_j,b−1)²
    φ(z) = J(z) + Σ_c (μ_c |v_c| + ν_c v_c²)

where ``v`` are the scaled terminal residual ``x_N − x_s`` and the violations of soft limits. φ is
an exact penalty function: with μ above the multipliers its minimum meets the constraints exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.discretisation import DiscreteModel
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Weights:
    """Weights of the objective, by state or input name.

    Attributes
    ----------
    states : dict of str to float
        q: of the squared deviation of a state, 1/unit². A controlled angle deviates from its
        reference, any other state from its value at the steady-state target.
    inputs : dict of str to float
        ρ: of the squared deviation from the steady-state input, 1/V².
    moves : dict of str to float
        s: of the squared change between successive blocks, 1/V².
    """

    states: Mapping[str, float]
    inputs: Mapping[str, float]
    moves: Mapping[str, float]


@dataclass(frozen=True)
class SoftLimits:
    """Limits on states that may be violated at a price.

    Attributes
    ----------
    states : dict of str to (float, float)
        Lower and upper limit, in the state's unit.
    linear, quadratic : float
        μ and ν: price of a violation, 1/unit and 1/unit².
    """

    states: Mapping[str, tuple[float, float]]
    linear: float
    quadratic: float


@dataclass(frozen=True)
class TerminalPrice:
    """Price of missing the terminal equality, in scaled units (see :class:`Horizon`)."""

    linear: float
    quadratic: float


def blocks_of(prediction_horizon: int, lengths: tuple[int, ...]) -> npt.NDArray[np.int64]:
    """Block index of each control period, shape (N,).

    Raises
    ------
    ConfigurationError
        If the lengths are not positive or do not add up to at most the horizon; the last block
        lasts to the end of the horizon.
    """
    if not lengths or min(lengths) < 1 or sum(lengths) > prediction_horizon:
        raise ConfigurationError(
            f"{list(lengths)!r} given, with prediction_horizon={prediction_horizon}",
            where="move_blocks",
            remedy="lengths of at least 1 that add up to at most the prediction horizon",
        )
    index = np.repeat(np.arange(len(lengths)), lengths)
    rest = np.full(prediction_horizon - len(index), len(lengths) - 1)
    return np.concatenate([index, rest])


class Horizon:
    """Compiled prediction of a discretised model.

    Parameters
    ----------
    discrete : DiscreteModel
        One control period.
    blocks : (N,) int array
        From :func:`blocks_of`.
    weights, soft_limits, terminal
    scale : (n_x,) array
        Typical size of each state; the terminal residual is divided by it.

    Attributes
    ----------
    linearise : BufferedFunction
        (x0, z, u_previous, p, w, r, x_s, u_s) → states (n_x, N), sensitivities of the rows
        (n_rows·N, n_z), of the terminal state, scaled (n_x, n_z), terminal residual, scaled,
        objective, merit, violation.
    evaluate : BufferedFunction
        The same arguments → states, terminal residual, objective, merit, violation.
    """

    def __init__(
        self,
        discrete: DiscreteModel,
        blocks: npt.NDArray[np.int64],
        weights: Weights,
        soft_limits: SoftLimits,
        terminal: TerminalPrice | None,
        scale: FloatArray,
    ) -> None:
        model = discrete.model
        _check_names(model, weights, soft_limits)
        self.model, self.discrete, self.blocks = model, discrete, blocks
        self.n_periods, self.n_blocks = len(blocks), int(blocks[-1]) + 1
        self.n_z = self.n_blocks * model.n_u
        self.weighted = tuple(name for name in model.state_names if weights.states.get(name))
        self.limited = tuple(name for name in model.state_names if name in soft_limits.states)
        self.weights, self.soft_limits, self.terminal, self.scale = (
            weights,
            soft_limits,
            terminal,
            scale,
        )
        #: Rows of the sensitivities at each period, by state.
        self.rows = tuple(dict.fromkeys(self.weighted + self.limited))
        self.linearise = BufferedFunction(self._function(with_sensitivities=True))
        self.evaluate = BufferedFunction(self._function(with_sensitivities=False))

    def _function(self, *, with_sensitivities: bool) -> ca.Function:
        discrete, model, n = self.discrete, self.model, self.n_periods
        stage = _stage(discrete, with_sensitivities)
        n_full, n_x, n_u = discrete.n_x, model.n_x, model.n_u
        x0 = ca.MX.sym("x0", n_full)
        z = ca.MX.sym("z", n_u, self.n_blocks)
        u_previous = ca.MX.sym("u_previous", n_u)
        p = ca.MX.sym("p", len(model.parameters))
        w = ca.MX.sym("w", model.n_w)
        r = ca.MX.sym("r", len(model.controlled), n)
        x_s = ca.MX.sym("x_s", n_x)
        u_s = ca.MX.sym("u_s", n_u)
        arguments = [x0, z, u_previous, p, w, r, x_s, u_s]

        state, states, sensitivity, row_sensitivities = x0, [], None, []
        rows = [model.state_index(name) for name in self.rows]
        for k in range(n):
            u = z[:, int(self.blocks[k])]
            if not with_sensitivities:
                state = stage(state, u, p, w)
            else:
                state, a, b = stage(state, u, p, w)
                sensitivity = _propagated(sensitivity, a, b, k, self.blocks)
                padding = ca.MX.zeros(len(rows), self.n_z - sensitivity.shape[1])
                row_sensitivities.append(ca.horzcat(sensitivity[rows, :], padding))
            states.append(state)
        trajectory = ca.horzcat(*states)
        residual = (trajectory[:n_x, -1] - x_s) / ca.DM(self.scale)
        objective = self._objective(trajectory, z, u_previous, r, x_s, u_s)
        merit, violation = self._merit(objective, trajectory, residual)
        tail = [residual, objective, merit, violation]
        if not with_sensitivities:
            return ca.Function("horizon_evaluate", arguments, [trajectory, *tail])
        terminal = ca.diag(1 / ca.DM(self.scale)) @ sensitivity[:n_x, :]
        slopes = [ca.densify(ca.vertcat(*row_sensitivities)), ca.densify(terminal)]
        return ca.Function("horizon_linearise", arguments, [trajectory, *slopes, *tail])

    def _objective(
        self, trajectory: ca.MX, z: ca.MX, u_previous: ca.MX, r: ca.MX, x_s: ca.MX, u_s: ca.MX
    ) -> ca.MX:
        model = self.model
        total = ca.MX(0)
        for name in self.weighted:
            row = model.state_index(name)
            goal = r[model.controlled.index(name), :] if name in model.controlled else x_s[row]
            total += self.weights.states[name] * ca.sumsqr(trajectory[row, :] - goal)
        periods = np.bincount(self.blocks)
        for j, name in enumerate(names(model.inputs)):
            if self.weights.inputs.get(name):
                deviation = ca.sqrt(ca.DM(periods).T) * (z[j, :] - u_s[j])
                total += self.weights.inputs[name] * ca.sumsqr(deviation)
            if self.weights.moves.get(name):
                moves = z[j, :] - ca.horzcat(u_previous[j], z[j, :-1])
                total += self.weights.moves[name] * ca.sumsqr(moves)
        return total

    def _merit(self, objective: ca.MX, trajectory: ca.MX, residual: ca.MX) -> tuple[ca.MX, ca.MX]:
        merit, violation = objective, ca.MX(0)
        if self.terminal is not None:
            merit += self.terminal.linear * ca.sum1(ca.fabs(residual))
            merit += self.terminal.quadratic * ca.sumsqr(residual)
        for name in self.limited:
            lower, upper = self.soft_limits.states[name]
            value = trajectory[self.model.state_index(name), :]
            beyond = ca.fmax(ca.fmax(lower - value, value - upper), 0)
            merit += self.soft_limits.linear * ca.sum2(beyond)
            merit += self.soft_limits.quadratic * ca.sumsqr(beyond)
            violation = ca.fmax(violation, ca.mmax(beyond))
        return merit, violation


def _stage(discrete: DiscreteModel, with_sensitivities: bool) -> ca.Function:
    """One control period: (x, u, p, w) → x⁺ [, ∂x⁺/∂x, ∂x⁺/∂u]."""
    x, u, p, w = discrete.symbols()
    results = [discrete.step(x, u, p, w)]
    if with_sensitivities:
        results += [ca.densify(ca.jacobian(results[0], v)) for v in (x, u)]
    return ca.Function("stage", [x, u, p, w], ca.cse(results))


def _propagated(
    sensitivity: ca.MX | None, a: ca.MX, b: ca.MX, k: int, blocks: npt.NDArray[np.int64]
) -> ca.MX:
    """∂x_{k+1}/∂z for the blocks begun so far: S⁺ = A S, plus B in the present block."""
    if sensitivity is None:
        return b
    n_u = b.shape[1]
    moved = a @ sensitivity
    if blocks[k] != blocks[k - 1]:
        return ca.horzcat(moved, b)
    return ca.horzcat(moved[:, :-n_u], moved[:, -n_u:] + b)


def _check_names(model: Model, weights: Weights, limits: SoftLimits) -> None:
    inputs = names(model.inputs)
    for where, given, known in (
        ("weights.states", weights.states, model.state_names),
        ("weights.inputs", weights.inputs, inputs),
        ("weights.moves", weights.moves, inputs),
        ("soft_limits", limits.states, model.state_names),
    ):
        for name in given:
            if name not in known and not _of_other_axis(name):
                raise ConfigurationError(
                    f"the model has no {name!r}",
                    where=f"{where}.{name}",
                    remedy=nearest(name, known),
                )


def _of_other_axis(name: str) -> bool:
    """Names of the 2 DOF rig, so that one configuration also serves its 1 DOF models."""
    return name in {"alpha_v", "alpha_h", "S_v", "S_h", "omega_v", "omega_h", "u_v", "u_h"}
