"""The optimal control problem of ``newton_mpc`` as a sparse NLP, for its peers.

Multiple shooting over the same discretised step, with the same weights, horizon, input blocks,
input bounds and exact penalty of the terminal equality (see :mod:`trms_cli.controllers.horizon`):
no equation is written a second time. The unknowns are ordered stage by stage,

    x_0, u_0, x_1, u_1, …, x_N, v⁺, v⁻        x_N − x_s = scale · (v⁺ − v⁻),  v⁺, v⁻ ≥ 0

where a stage's x also holds the last command as soon as moves are weighted or limited: the
structure that fatrop detects. With v⁺ and v⁻ the exact penalty μ|v| + νv² is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.horizon import blocks_of
from trms_cli.controllers.newton_mpc import NewtonMpc, typical_sizes
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model, names

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Ocp:
    """The problem and where its parts are.

    Attributes
    ----------
    nlp : dict
        ``x, p, f, g`` for ``casadi.nlpsol``. Parameters: x_0 with memory, last command, references
        (n_r, N), x_s, u_s, w.
    lower, upper : (n,) arrays
        Of the unknowns.
    g_lower, g_upper : (m,) arrays
    equality : list of bool
        Which rows of g are equalities.
    layout : list of (str, int)
        Kind (``x``, ``u``, ``v``) and size of the unknowns, in order.
    n_state : int
        Of a stage's state, the last command included.
    """

    discrete: DiscreteModel
    periods: int
    nlp: dict[str, ca.MX]
    lower: FloatArray
    upper: FloatArray
    g_lower: FloatArray
    g_upper: FloatArray
    equality: list[bool]
    layout: list[tuple[str, int]]
    n_state: int

    @property
    def stage_size(self) -> int | None:
        """Unknowns of a stage but the last; None when inputs are blocked."""
        kinds = [kind for kind, _ in self.layout if kind != "v"]
        alternating = (["x", "u"] * self.periods) + ["x"]
        return self.layout[0][1] + self.layout[1][1] if kinds == alternating else None


def build(config: NewtonMpc, model: Model, sample_time: float) -> Ocp:
    """State the problem that a configuration of ``newton_mpc`` poses at each sample.

    Raises
    ------
    NotImplementedError
        For soft limits on states, which no benchmark uses.
    """
    if config.soft_limits:
        raise NotImplementedError("the peers' problem has no soft limits on states")
    discrete = discretise(model, sample_time, config.integration_steps)
    blocks = blocks_of(config.prediction_horizon, config.move_blocks)
    return _Builder(config, discrete, blocks).build()


class _Builder:
    def __init__(
        self, config: NewtonMpc, discrete: DiscreteModel, blocks: npt.NDArray[np.int64]
    ) -> None:
        model = discrete.model
        self.config, self.discrete, self.model = config, discrete, model
        self.blocks, self.n = blocks, len(blocks)
        inputs = names(model.inputs)
        self.rho = np.array([config.input_weights.get(name, 0.0) for name in inputs])
        self.s = np.array([config.move_weights.get(name, 0.0) for name in inputs])
        self.rate = sample_time_bounds(config, inputs, discrete.step_length)
        self.remembers = bool(self.s.any() or np.isfinite(self.rate).any())
        self.unknowns: list[ca.MX] = []
        self.layout: list[tuple[str, int]] = []
        self.lower: list[FloatArray] = []
        self.upper: list[FloatArray] = []
        self.rows: list[ca.MX] = []
        self.g_lower: list[FloatArray] = []
        self.g_upper: list[FloatArray] = []
        self.objective = ca.MX(0)
        self.at = {
            "x0": ca.MX.sym("x0", discrete.n_x),
            "u_previous": ca.MX.sym("u_previous", model.n_u),
            "r": ca.MX.sym("r", len(model.controlled), self.n),
            "x_s": ca.MX.sym("x_s", model.n_x),
            "u_s": ca.MX.sym("u_s", model.n_u),
            "w": ca.MX.sym("w", model.n_w),
        }

    def build(self) -> Ocp:
        model, n_u = self.model, self.model.n_u
        n_state = self.discrete.n_x + (n_u if self.remembers else 0)
        u_lower, u_upper = model.input_bounds()
        z = self._unknown("x_0", n_state, -np.inf, np.inf)
        start = ca.vertcat(self.at["x0"], *([self.at["u_previous"]] if self.remembers else []))
        u = ca.MX()
        for k in range(self.n):
            x, last = z[: self.discrete.n_x], z[self.discrete.n_x :]
            begins_block = k == 0 or self.blocks[k] != self.blocks[k - 1]
            if begins_block:
                u = self._unknown(f"u_{k}", n_u, u_lower, u_upper)
                if self.remembers:
                    self.objective += ca.dot(ca.DM(self.s), (u - last) ** 2)
            self.objective += ca.dot(ca.DM(self.rho), (u - self.at["u_s"]) ** 2)
            after = self.discrete.step(x, u, model.parameters.values, self.at["w"])
            z_next = self._unknown(f"x_{k + 1}", n_state, -np.inf, np.inf)
            arriving = ca.vertcat(after, *([u] if self.remembers else []))
            self._row(z_next - arriving, 0.0, 0.0)
            if k == 0:
                self._row(z - start, 0.0, 0.0)
            limited = np.flatnonzero(np.isfinite(self.rate)).tolist()
            if begins_block and limited:
                self._row((u - last)[limited], -self.rate[limited], self.rate[limited])
            z = z_next
            self._state_cost(z[: model.n_x], self.at["r"][:, k])
            # From the step, not from the next state: the stages stay apart.
            self._rate_cost((after - x) / self.discrete.step_length)
        if self.config.terminal == "equality":
            self._terminal(z[: model.n_x])
        g_lower, g_upper = np.concatenate(self.g_lower), np.concatenate(self.g_upper)
        return Ocp(
            self.discrete,
            self.n,
            {
                "x": ca.vertcat(*self.unknowns),
                "p": ca.vertcat(*(ca.vec(value) for value in self.at.values())),
                "f": self.objective,
                "g": ca.vertcat(*self.rows),
            },
            np.concatenate(self.lower),
            np.concatenate(self.upper),
            g_lower,
            g_upper,
            (g_lower == g_upper).tolist(),
            self.layout,
            n_state,
        )

    def _rate_cost(self, rate: ca.MX) -> None:
        for name, weight in self.config.rate_weights.items():
            if weight > 0 and name in self.model.controlled:
                self.objective += weight * rate[self.model.state_index(name)] ** 2

    def _state_cost(self, x: ca.MX, r: ca.MX) -> None:
        model = self.model
        for name, weight in self.config.state_weights.items():
            if weight > 0 and name in model.state_names:
                row = model.state_index(name)
                goal = (
                    r[model.controlled.index(name)]
                    if name in model.controlled
                    else self.at["x_s"][row]
                )
                self.objective += weight * (x[row] - goal) ** 2

    def _terminal(self, x: ca.MX) -> None:
        n_x = self.model.n_x
        beyond = self._unknown("v", 2 * n_x, 0.0, np.inf)
        v = beyond[:n_x] - beyond[n_x:]
        scale = typical_sizes(self.discrete)
        self._row((x - self.at["x_s"]) / ca.DM(scale) - v, 0.0, 0.0)
        self.objective += self.config.terminal_linear * ca.sum1(beyond)
        self.objective += self.config.terminal_quadratic * ca.sumsqr(v)

    def _unknown(
        self, name: str, size: int, lower: float | FloatArray, upper: float | FloatArray
    ) -> ca.MX:
        symbol = ca.MX.sym(name, size)
        self.unknowns.append(symbol)
        self.layout.append((name[0], size))
        self.lower.append(np.broadcast_to(lower, size).astype(float))
        self.upper.append(np.broadcast_to(upper, size).astype(float))
        return symbol

    def _row(self, row: ca.MX, lower: float | FloatArray, upper: float | FloatArray) -> None:
        self.rows.append(row)
        self.g_lower.append(np.broadcast_to(lower, row.shape[0]).astype(float))
        self.g_upper.append(np.broadcast_to(upper, row.shape[0]).astype(float))


def sample_time_bounds(
    config: NewtonMpc, inputs: tuple[str, ...], sample_time: float
) -> FloatArray:
    """Largest move of each input in a control period, V; infinite for none."""
    return np.array([config.input_rate_limits.get(name, np.inf) * sample_time for name in inputs])
