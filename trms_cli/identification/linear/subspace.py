"""Method ``subspace``: a state space from the past of inputs and outputs, without a search.

Predictor-based subspace identification (PBSID_opt). With the innovation form

    x(k+1) = A x(k) + B u(k) + K e(k)        y(k) = C x(k) + e(k)

and Ã = A − K C, the output follows from the past p samples z_j(k) = (y(k−j), u(k−j)) alone, up to
Ãᵖ, which vanishes:

    y(k) ≈ Σ_j M_j z_j(k) + e(k),    M_j = C Ã^(j−1) [K B]           (least squares, VARX)
    C Ã^i x(k) ≈ Σ_j M_{i+j} z_j(k)                                  i = 0 … f − 1

The second line over all i is Γ x(k); its singular value decomposition gives the states, of which
the n with the largest singular values are kept. C follows from regressing y on x, e is what is
left, and A and K from regressing x(k+1) on x, u and e; B from the predictor of A, C and K, which is
linear in it: how a command acts within a few samples is what a controller lives on, and the
states' own noise hides most of it from the regression. N4SID and MOESP project on future inputs,
which are correlated with past noise under feedback; a recording of a closed loop biases them, and
not this one. Any rows will do, so that missing samples and several recordings are no obstacle.

Poles on or outside the unit circle are reflected.

The states are T x: the outputs, the rates of the angles (C(A − I)x/T_s, what an angle changes by
where the command is that of the operating point), and what these do not tell of the state, with a
standard deviation of 0.1 over the recordings, for which an observer's figures for states without a
kind are made (:class:`trms_cli.observers.augmentation.InitialSd`).

Sources: A. Chiuso (2007), "The role of vector autoregressive modeling in predictor-based subspace
identification", Automatica 43(6); G. van der Veen, J.-W. van Wingerden, M. Bergamasco, M. Lovera &
M. Verhaegen (2013), "Closed-loop subspace identification methods: an overview", IET Control Theory
& Applications 7(10); M. Verhaegen & V. Verdult (2007), "Filtering and System Identification".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.linear.linear_data import (
    LinearData,
    Regression,
    regression,
    require_rows,
)
from trms_cli.identification.linear.linear_fit import (
    LinearEstimate,
    LinearMethod,
    Orders,
    choices,
    jackknife_sd,
)
from trms_cli.models.black_box import ANGLE
from trms_cli.models.model import Signal
from trms_cli.models.state_space import DiscreteStateSpace

#: Poles beyond this modulus are brought inside: a free run forgets its start within the hour.
_LARGEST_POLE = 0.99999
#: Standard deviation of the states beyond the outputs, over the fitted recordings.
_STATE_SD = 0.1
#: Singular values below this share of the largest are rounding.
_RANK = 1e-10


@dataclass(frozen=True, kw_only=True)
class Subspace(LinearMethod):
    """Subspace identification of a state space (PBSID_opt)."""

    order: Orders = (2, 3, 4, 5, 6, 8, 10, 12)  #: n, states; at least as many as outputs
    past: Annotated[int, Meta(ge=2, le=500)] = 40  #: p, samples that a state is read from
    future: Annotated[int, Meta(ge=2, le=500)] = 20  #: f, samples ahead that it must explain

    name: ClassVar[str] = "subspace"

    def candidates(self, data: LinearData) -> list[dict[str, int]]:
        orders = choices(self.order, "method.order")
        if self.future > self.past:
            raise ConfigurationError(
                f"{self.future} samples ahead from {self.past} past ones",
                where="method.future",
                remedy="look ahead no farther than back",
            )
        least, most = data.n_y, self.future * data.n_y
        usable = [order for order in orders if least <= order <= most]
        if not usable:
            raise ConfigurationError(
                f"{list(orders)} given for {data.n_y} outputs",
                where="method.order",
                remedy=f"give an order from {least} (a state for each output) to {most}",
            )
        return [{"order": order} for order in usable]

    def look_back(self, orders: Mapping[str, int]) -> int:
        return self.past

    def estimate(
        self, data: LinearData, orders: Mapping[str, int], first: int | None = None
    ) -> LinearEstimate:
        n = orders["order"]
        rows = regression(data, self.past, self.past, first)
        require_rows(data, len(rows), self.past * (data.n_y + data.n_u))
        states, singular_values = self._states(data, rows.y, rows.past, rows.commands, n)
        C = np.asarray(np.linalg.lstsq(states, rows.y, rcond=None)[0].T, dtype=np.float64)
        error = rows.y - states @ C.T
        now = np.concatenate([np.arange(run.start, run.stop - 1) for run in rows.runs])
        # u(k) is the newest past command of the next row.
        commands = rows.commands[now + 1, : data.n_u]
        known = np.hstack([states[now], commands, error[now]])
        following = np.linalg.lstsq(known, states[now + 1], rcond=None)[0].T
        A, _, K = np.split(following, [n, n + data.n_u], axis=1)
        covariance = states.T @ states / len(states)
        T, rates = _coordinates(A, C, covariance, data)
        A, reflected = _stable(T @ A @ np.linalg.inv(T))
        if not reflected:  # by what a rate is; without the rounding
            for row, output in enumerate(rates, start=data.n_y):
                A[output] = 0.0
                A[output, [output, row]] = 1.0, data.sample_time
        K = _stable_gain(A, T @ K, error.T @ error / len(error))
        B = _input_matrix(A, K, error, rows, states @ T.T, data)
        angles = [data.output_signals[i] for i in rates]
        rest = n - data.n_y - len(rates)
        more = [
            *(Signal(f"{s.name}_rate", f"{s.unit}/s", f"rate of {s.name}") for s in angles),
            *(Signal(f"state_{i}", "1", f"state {i} of the rest") for i in range(1, rest + 1)),
        ]
        scales = np.concatenate([data.output_sd[rates], np.ones(rest)])
        own = np.concatenate([data.output_sd, scales])
        return LinearEstimate(
            orders={"order": n},
            state_space=data.state_space(A, B, np.std(error @ K.T, axis=0), more, scales),
            residuals=error,
            parameters=n * (2 * data.n_y + data.n_u),
            details={
                "singular_values": (singular_values / singular_values[0]).tolist(),
                "poles_reflected": reflected,
                "innovation_gain": (own[:, None] * K / data.output_sd).tolist(),
            },
        )

    def uncertainty(
        self, data: LinearData, space: DiscreteStateSpace, parts: Sequence[DiscreteStateSpace]
    ) -> dict[str, Any]:
        """Standard deviations of A and B, each model brought to the coordinates of the whole one.

        The coordinates are those in which its observability matrix is nearest in least squares.
        """
        whole = _observability(data, space)
        aligned = []
        for part in parts:
            T = np.linalg.lstsq(whole, _observability(data, part), rcond=None)[0]
            aligned.append(np.hstack([T @ part.A @ np.linalg.inv(T), T @ part.B]))
        spread = jackknife_sd(aligned, (space.n_x, space.n_x + len(space.inputs)))
        A, B = np.split(spread, [space.n_x], axis=1)
        return {"A_sd": _finite_rows(A), "B_sd": _finite_rows(B)}

    def _states(
        self, data: LinearData, y: FloatArray, past: FloatArray, commands: FloatArray, n: int
    ) -> tuple[FloatArray, FloatArray]:
        """States of the rows (N, n), and all singular values of Γ x."""
        p, f, n_y, n_u = self.past, self.future, data.n_y, data.n_u
        z = np.hstack([past, commands])
        gram = z.T @ z / len(z)
        # Slow signals are nearly collinear over many lags; what rounding decides is left out.
        values, vectors = np.linalg.eigh(gram)
        kept = values > _RANK * values[-1]
        root = vectors[:, kept] * np.sqrt(values[kept])  # gram = root rootᵀ
        inverse = vectors[:, kept] / values[kept] @ vectors[:, kept].T
        markov = (y.T @ z / len(z)) @ inverse  # (n_y, p (n_y + n_u))
        of_past = markov[:, : p * n_y].reshape(n_y, p, n_y)
        of_commands = markov[:, p * n_y :].reshape(n_y, p, n_u)
        gamma = np.zeros((f, n_y, z.shape[1]))
        for i in range(f):
            left = p - i
            gamma[i, :, : left * n_y] = of_past[:, i:].reshape(n_y, -1)
            gamma[i, :, p * n_y : p * n_y + left * n_u] = of_commands[:, i:].reshape(n_y, -1)
        stacked = gamma.reshape(f * n_y, -1)
        left_vectors, sizes, _ = np.linalg.svd(stacked @ root, full_matrices=False)
        states = z @ (stacked.T @ left_vectors[:, :n]) / np.sqrt(sizes[:n])
        return states, sizes[: 2 * n]


def _coordinates(
    A: FloatArray, C: FloatArray, covariance: FloatArray, data: LinearData
) -> tuple[FloatArray, list[int]]:
    """T (n, n) of the states that are told, and the outputs whose rates are among them."""
    n = len(A)
    rates = [i for i, signal in enumerate(data.output_signals) if signal.unit == ANGLE]
    if data.n_y + len(rates) > n:
        rates = []
    known = np.vstack([C, C[rates] @ (A - np.eye(n)) / data.sample_time])
    spread = covariance @ known.T
    left = np.eye(n) - spread @ np.linalg.solve(known @ spread, known)
    values, vectors = np.linalg.eigh(left @ covariance @ left.T)
    kept = slice(len(known), None)  # the smallest are those that are known
    scale = np.sqrt(np.maximum(values[kept], np.finfo(float).tiny)) / _STATE_SD
    return np.vstack([known, (vectors[:, kept] / scale).T @ left]), rates


def _stable_gain(A: FloatArray, K: FloatArray, covariance: FloatArray) -> FloatArray:
    """K (n, n_y) with which the predictor A − K C forgets; C gives the first states.

    Where it does not, that of the stationary Kalman filter for the same noise, K e of the states
    and e of the outputs, ``covariance`` of e: its zeros are reflected into the unit circle. None
    at all where that filter does not exist.
    """
    n, n_y = K.shape
    C = np.eye(n_y, n)
    if np.abs(np.linalg.eigvals(A - K @ C)).max() < _LARGEST_POLE:
        return K
    from scipy.linalg import solve_discrete_are

    cross = K @ covariance
    try:
        P = solve_discrete_are(A.T, C.T, cross @ K.T, covariance, s=cross)
        gain = np.linalg.solve(C @ P @ C.T + covariance, (A @ P @ C.T + cross).T).T
        if np.abs(np.linalg.eigvals(A - gain @ C)).max() < _LARGEST_POLE:
            return np.asarray(gain, dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError):
        pass
    return np.zeros_like(K)


def _input_matrix(
    A: FloatArray,
    K: FloatArray,
    error: FloatArray,
    rows: Regression,
    states: FloatArray,
    data: LinearData,
) -> FloatArray:
    """B (n, n_u) with which the predictor of A, C and K errs least, one step ahead, over the rows.

    Its predictions are linear in B. ``error``: (N, n_y), residuals by whose covariance outputs are
    weighed. ``states``: (N, n), of which those at the beginnings of the runs are taken.
    """
    n, n_y, n_u = len(A), data.n_y, data.n_u
    damped = A - K @ np.eye(n_y, n)
    whitening = np.linalg.inv(np.linalg.cholesky(error.T @ error / len(error)))
    at = np.repeat(np.arange(n), n_u), np.arange(n * n_u)
    gram, right = np.zeros((n * n_u, n * n_u)), np.zeros(n * n_u)
    for run in rows.runs:
        # u(k) is the newest past command of the next row.
        commands = rows.commands[run][1:, :n_u]
        base, slopes = states[run.start], np.zeros((n, n * n_u))
        bases, responses = np.empty((len(commands), n_y)), np.empty((len(commands), n_y, n * n_u))
        for k, (u, y) in enumerate(zip(commands, rows.y[run], strict=False)):
            bases[k], responses[k] = base[:n_y], slopes[:n_y]
            base, slopes = damped @ base + K @ y, damped @ slopes
            slopes[at] += np.tile(u, n)
        left = ((rows.y[run][:-1] - bases) @ whitening.T).ravel()
        weighed = (whitening @ responses).reshape(-1, n * n_u)
        gram += weighed.T @ weighed
        right += weighed.T @ left
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    solution = np.linalg.lstsq(gram / np.outer(scale, scale), right / scale, rcond=1e-12)[0]
    return np.asarray((solution / scale).reshape(n, n_u), dtype=np.float64)


def _observability(data: LinearData, space: DiscreteStateSpace) -> FloatArray:
    """Outputs of the next samples by state, in units of the spread, (n·n_y, n)."""
    rows, power = [], np.eye(space.n_x)
    for _ in range(space.n_x):
        rows.append(power[: space.n_y] / data.output_sd[:, None])
        power = power @ space.A
    return np.vstack(rows)


def _finite_rows(matrix: FloatArray) -> list[list[float | None]]:
    return [[float(v) if np.isfinite(v) else None for v in row] for row in matrix]


def _stable(A: FloatArray) -> tuple[FloatArray, int]:
    """A with its poles inside the unit circle, reflected on it where they are not; how many."""
    values, vectors = np.linalg.eig(A)
    size = np.abs(values)
    outside = size > _LARGEST_POLE
    if not outside.any():
        return A, 0
    inside = np.minimum(1.0 / np.maximum(size, 1.0), _LARGEST_POLE)
    values = np.where(outside, values / size * inside, values)
    return np.real(vectors * values @ np.linalg.inv(vectors)), int(outside.sum())
