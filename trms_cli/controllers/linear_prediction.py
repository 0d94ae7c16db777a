"""The prediction of a linear model over a horizon, condensed to the future inputs.

With Δx = x − x_s and v = u − u_s the distances to a steady state, and δ what the linear model
drifts by there (zero where it was linearised at that state),

    Δx⁺ = A Δx + B v + δ        Δx_k = Aᵏ Δx_0 + Σ_i A^{k−1−i} (B v_i + δ)

The inputs are constant over blocks. The objective is that of
:class:`~trms_cli.controllers.horizon.Horizon`, as a sum of squares |G v + e_0|² + ….
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Qp

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class StageCost:
    """Weights of the objective in the model's order."""

    #: (n,) array; q of the squared deviation of each state, 1/unit²; memory of the input path
    #: included
    states: FloatArray
    rates: FloatArray  #: (n,) array; d of the squared mean rate of a state over a period, s²/unit²
    #: ``inputs``, ``moves``: (n_u,) arrays; ρ of the deviation from the steady-state input and s of
    #: the change, 1/V²
    inputs: FloatArray
    moves: FloatArray
    period: float  #: T, s

    def terminal(self, A: FloatArray, B: FloatArray) -> FloatArray:
        """Root L of the cost to go |L (Δx, v_last)|² of the unconstrained problem.

        The Riccati equation of the state with the last input beside it, whose stage cost is that
        of a period: the state that it leads to, the rate on the way, the input and its change.

        Raises ConfigurationError if there is no solution.
        """
        from scipy.linalg import solve_discrete_are

        n, n_u = B.shape
        F, G = np.zeros((n + n_u, n + n_u)), np.vstack([B, np.eye(n_u)])
        F[:n, :n] = A
        last = np.zeros((n_u, n + n_u))
        last[:, n:] = -np.eye(n_u)
        ahead = np.hstack([A, np.zeros((n, n_u)), B])
        moved = ahead.copy()
        moved[:, :n] -= np.eye(n)
        change = np.hstack([last, np.eye(n_u)])
        inputs = np.hstack([np.zeros((n_u, n + n_u)), np.eye(n_u)])
        cost = (
            ahead.T * self.states @ ahead
            + moved.T * (self.rates / self.period**2) @ moved
            + change.T * self.moves @ change
            + inputs.T * self.inputs @ inputs
        )
        m = n + n_u
        try:
            P = solve_discrete_are(F, G, cost[:m, :m], cost[m:, m:], s=cost[:m, m:])
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ConfigurationError(
                f"the cost beyond the horizon has no Riccati solution here: {error}",
                where="controller.operating_point",
                remedy="choose a point with both rotors turning, a weight on inputs or moves, "
                "or terminal=none",
            ) from error
        values, vectors = np.linalg.eigh((P + P.T) / 2)
        return np.asarray(np.sqrt(values.clip(min=0.0))[:, None] * vectors.T)


@dataclass(frozen=True)
class Limits:
    """What inputs and states have to keep."""

    lower: FloatArray  #: (n_u,) arrays; of the inputs, V
    upper: FloatArray  #: (n_u,) arrays; of the inputs, V
    moves: FloatArray  #: (n_u,) array; largest change of an input in a period, V; infinite for none
    states: FloatArray  #: (n_limited, 2) array; soft limits of the limited states, in their units
    linear: float  #: Price of violating these
    quadratic: float  #: Price of violating these


class Condensed:
    """One linear model over one horizon.

    Parameters
    ----------
    A, B : (n, n), (n, n_u) arrays
    blocks : (N,) int array
        Block of each period.
    cost : StageCost
    terminal : (m, n + n_u) array or None
        L; see :meth:`StageCost.terminal`.
    limited : list of int
        States that have soft limits.

    Attributes
    ----------
    hessian : (n_z, n_z) array
        Of the objective in v, block by block; slightly regularised.
    limited_slopes : (n_limited·N, n_z) array
        Of the limited states, period by period.
    effect : (n_u,) array
        How far each input held over the whole horizon moves the weighted states.
    """

    #: Added to the Hessian's diagonal, 1/V²: inputs without influence stay where they are.
    regularisation = 1e-9

    def __init__(
        self,
        A: FloatArray,
        B: FloatArray,
        blocks: IntArray,
        cost: StageCost,
        terminal: FloatArray | None,
        limited: list[int],
    ) -> None:
        n, n_u = B.shape
        periods, n_blocks = len(blocks), int(blocks[-1]) + 1
        powers = np.empty((periods + 1, n, n))
        powers[0] = np.eye(n)
        for k in range(periods):
            np.dot(powers[k], A, out=powers[k + 1])
        sums = np.zeros((periods + 1, n, n))
        np.cumsum(powers[:-1], axis=0, out=sums[1:])
        held = sums @ B  # of an input from the first period on
        begin = np.searchsorted(blocks, np.arange(n_blocks))
        end = np.append(begin[1:], periods)
        now = np.arange(periods + 1)[:, None]
        slopes = held[(now - begin).clip(0)] - held[(now - end).clip(0)]
        self._slopes = slopes.transpose(0, 2, 1, 3).reshape(periods + 1, n, n_blocks * n_u)
        self._powers, self._sums = powers, sums
        self._terminal = terminal
        self._states = np.flatnonzero(cost.states)
        self._rates = np.flatnonzero(cost.rates)
        self._root_states = np.sqrt(cost.states[self._states])
        self._root_rates = np.sqrt(cost.rates[self._rates]) / cost.period
        ends = np.zeros((n_u, n_blocks * n_u))
        ends[:, -n_u:] = np.eye(n_u)
        self._G = self._errors(self._slopes, ends)
        difference = np.eye(n_blocks * n_u) - np.eye(n_blocks * n_u, k=-n_u)
        self.difference = difference
        self._moves = np.tile(cost.moves, n_blocks)
        inputs = (np.bincount(blocks)[:, None] * cost.inputs).ravel()
        self.hessian = 2.0 * (
            self._G.T @ self._G + np.diag(inputs) + difference.T * self._moves @ difference
        ) + self.regularisation * np.eye(n_blocks * n_u)
        self.limited_slopes = self._slopes[1:, limited].reshape(-1, n_blocks * n_u)
        self._limited = limited
        self.effect = np.sqrt((self._root_states[:, None] * held[-1, self._states]) ** 2).sum(0)

    def free(self, start: FloatArray, drift: FloatArray) -> FloatArray:
        """Δx_0 … Δx_N with v = 0, shape (N + 1, n)."""
        return np.asarray(self._powers @ start + self._sums @ drift)

    def gradient(self, free: FloatArray, goals: FloatArray, last: FloatArray) -> FloatArray:
        """Of the objective at v = 0.

        Parameters
        ----------
        free : (N + 1, n) array
            From :meth:`free`.
        goals : (N, n) array
            Where the states should be, relative to x_s.
        last : (n_u,) array
            The last command, relative to u_s.
        """
        shifted = free.copy()
        shifted[1:] -= goals
        errors = self._errors(shifted[:, :, None], np.zeros((len(last), 1)), free)[:, 0]
        gradient = 2.0 * (self._G.T @ errors)
        gradient[: len(last)] -= 2.0 * self._moves[: len(last)] * last
        return np.asarray(gradient)

    def states(self, free: FloatArray, v: FloatArray) -> FloatArray:
        """Δx_0 … Δx_N under the inputs v (n_z,), shape (N + 1, n)."""
        return np.asarray(free + self._slopes @ v)

    def program(
        self,
        gradient: FloatArray,
        free: FloatArray,
        limits: Limits,
        x_s: FloatArray,
        u_s: FloatArray,
        last: FloatArray,
    ) -> Qp:
        """The quadratic program in v: rows of limited moves (hard), then of states (soft).

        Parameters
        ----------
        gradient, free
            From :meth:`gradient` and :meth:`free`.
        x_s, u_s
            The steady state.
        last : (n_u,) array
            The last command, relative to u_s.
        """
        blocks = len(gradient) // len(last)
        lower, upper = (np.tile(bound - u_s, blocks) for bound in (limits.lower, limits.upper))
        moves, before = np.tile(limits.moves, blocks), np.zeros(len(gradient))
        before[: len(last)] = last
        hard = np.isfinite(moves)
        present = (free[1:, self._limited] + x_s[self._limited]).ravel()
        ranges = np.tile(limits.states, (len(free) - 1, 1))
        soft = len(present)
        return Qp(
            self.hessian,
            gradient,
            np.concatenate([self.difference[hard], self.limited_slopes]),
            np.concatenate([lower, (before - moves)[hard], ranges[:, 0] - present]),
            np.concatenate([upper, (before + moves)[hard], ranges[:, 1] - present]),
            np.concatenate([np.full(hard.sum(), np.inf), np.full(soft, limits.linear)]),
            np.concatenate([np.ones(hard.sum()), np.full(soft, limits.quadratic)]),
        )

    def _errors(
        self, along: FloatArray, ends: FloatArray, moving: FloatArray | None = None
    ) -> FloatArray:
        """Weighted errors of trajectories (N + 1, n, columns) and last inputs (n_u, columns).

        ``moving`` (N + 1, n), where it is given, is what rates and the end are taken of.
        """
        columns = along.shape[2]
        path = along if moving is None else moving[:, :, None]
        at = self._root_states[:, None] * along[1:, self._states]
        rate = self._root_rates[:, None] * np.diff(path[:, self._rates], axis=0)
        parts = [at.reshape(-1, columns), rate.reshape(-1, columns)]
        if self._terminal is not None:
            parts.append(self._terminal @ np.vstack([path[-1], ends]))
        return np.concatenate(parts)
