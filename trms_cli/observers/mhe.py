"""Moving-horizon estimator: the best trajectory over the last moments, within bounds.

At each sample the trajectory over the last ``horizon`` seconds is fitted to what was measured in
them, to the model, and to what was known at their beginning.
The weight of the beginning, the arrival cost, is the covariance of an arrival filter that runs
beside and takes over the estimator's mean at every sample, so that no measurement counts twice
(Rao, Rawlings & Mayne 2003, "Constrained state estimation for nonlinear discrete-time systems",
IEEE TAC 48: the filtering update). On a linear model without bounds the estimate is the Kalman
filter's, whatever the horizon is.

The arrival filter also gates outliers, predicts the next measurement, and stands in where a
problem is not solved, in the first moments before the window is full, and after a recovery.

The least-squares problem, solved for one linearisation at a time:

    min  |z_0 − ẑ_0|²_{P⁻¹} + Σ_k |z_{k+1} − F(z_k)|²_{Q⁻¹} + Σ_k |y_k − h(z_k)|²_{R⁻¹}
    s.t. lower ≤ z_k ≤ upper

A Gauss–Newton step without bounds is a Kalman smoother of the model linearised along the last
trajectory (Bell 1994, "The iterated Kalman smoother as a Gauss–Newton method", SIAM J. Optim. 4):
compiled, linear in the length of the window, and never divides by a process noise that may be
zero. Where its result leaves the bounds, the same step is solved as a dense quadratic program in
the normalised noises ξ (z_0 = ẑ_0 + L ξ_0, F's error √q ξ_k), whose Hessian I + JᵀJ no noise level
makes singular.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.core.qp import Daqp, Qp
from trms_cli.core.ranges import Positive
from trms_cli.models.estimate import Estimate
from trms_cli.observers.augmentation import Augmentation, FilterOptions, augment
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.kalman_step import (
    diagonal,
    exact_measurement,
    exact_transition,
    gain_stage,
    joseph,
)
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterState, RecursiveFilter
from trms_cli.observers.ukf import Ukf

_ARRIVAL: dict[str, type[RecursiveFilter]] = {"ekf": Ekf, "ukf": Ukf}
#: A result this many standard deviations from the arrival filter's, without any bound to explain
#: it, is a diverged iteration.
_FURTHEST = 20.0
#: What the window keeps of each sample, oldest first.
_KEPT = ("memory", "u", "known", "y", "believed")
_COLUMNS = ("trajectory", *_KEPT)
INPUTS = (
    *("trajectory", "arrival", "P", "memory", "u", "known", "y", "believed"),
    *("p", "q", "r", "floor"),
)
OUTPUTS = ("smoothed", "moved", "A", "seen", "H")


def smoothing_step(augmented: Augmentation, length: int) -> ca.Function:
    """One Gauss–Newton step over ``length`` samples, without bounds.

    Inputs: trajectory to linearise along (n, length + 1), mean and covariance at its beginning,
    and for each sample the memory before it, command and known torques during it, measurement and
    mask at its end. Outputs: the smoothed trajectory; for :func:`solve_bounded` F(z_k) (n, length)
    and its slopes side by side (n, n·length), h(z_k) (n_y, length) and its slopes (n_y, n·length).
    """
    model, n, n_y = augmented.model, augmented.n, len(augmented.channels)
    Z, arrival = ca.MX.sym("trajectory", n, length + 1), ca.MX.sym("arrival", n)
    P_0, memory = ca.MX.sym("P", n, n), ca.MX.sym("memory", augmented.n_m, length)
    u, w_known = ca.MX.sym("u", model.n_u, length), ca.MX.sym("known", model.n_w, length)
    y, believed = ca.MX.sym("y", n_y, length), ca.MX.sym("believed", n_y, length)
    p = ca.MX.sym("p", len(model.parameters))
    q, r, floor = ca.MX.sym("q", n), ca.MX.sym("r", n_y), ca.MX.sym("floor", n)

    repeated = ca.repmat(p, 1, length)
    successors, A, _ = exact_transition(augmented).map(length)(
        Z[:, :length], memory, u, repeated, w_known
    )
    readings, H = exact_measurement(augmented).map(length)(Z[:, 1:], u, repeated)
    forward, backward = _forward(n, n_y), gain_stage(n, n)
    m, P = arrival, P_0
    filtered, predicted = [(m, P)], []
    for k in range(length):
        A_k, H_k = A[:, k * n : (k + 1) * n], H[:, k * n : (k + 1) * n]
        m_prior, P_prior, m, P = forward(
            *(m, P, Z[:, k], successors[:, k], A_k, Z[:, k + 1], readings[:, k], H_k),
            *(y[:, k], believed[:, k], q, r, floor),
        )
        predicted.append((m_prior, P_prior))
        filtered.append((m, P))
    smoothed = [m]
    for k in reversed(range(length)):
        m_k, P_k = filtered[k]
        m_prior, P_prior = predicted[k]
        gain = backward(P_k @ A[:, k * n : (k + 1) * n].T, P_prior)
        smoothed.append(m_k + gain @ (smoothed[-1] - m_prior))
    return ca.Function(
        "mhe_step",
        [Z, arrival, P_0, memory, u, w_known, y, believed, p, q, r, floor],
        [ca.horzcat(*reversed(smoothed)), successors, A, readings, H],
        list(INPUTS),
        list(OUTPUTS),
    )


def _forward(n: int, n_y: int) -> ca.Function:
    """One sample of the Kalman filter of the model linearised at z and at z⁺."""
    m, P = ca.MX.sym("m", n), ca.MX.sym("P", n, n)
    z, successor, A = ca.MX.sym("z", n), ca.MX.sym("moved", n), ca.MX.sym("A", n, n)
    z_next, reading, H_all = ca.MX.sym("z_next", n), ca.MX.sym("seen", n_y), ca.MX.sym("H", n_y, n)
    y, believed = ca.MX.sym("y", n_y), ca.MX.sym("believed", n_y)
    q, r, floor = ca.MX.sym("q", n), ca.MX.sym("r", n_y), ca.MX.sym("floor", n)
    m_prior = successor + A @ (m - z)
    P_prior = A @ P @ A.T + diagonal(q)
    H = H_all * ca.repmat(believed, 1, n)
    cross = P_prior @ H.T
    gain = gain_stage(n, n_y)(cross, H @ cross + diagonal(believed * r + (1 - believed)))
    m_next = m_prior + gain @ (believed * (y - reading - H_all @ (m_prior - z_next)))
    reduction = ca.MX.eye(n) - gain @ H
    P_next = joseph(reduction @ P_prior @ reduction.T, gain, believed * r, floor)
    return ca.Function(
        "forward",
        [m, P, z, successor, A, z_next, reading, H_all, y, believed, q, r, floor],
        [m_prior, P_prior, m_next, P_next],
    )


def solve_bounded(
    inputs: dict[str, FloatArray],
    outputs: dict[str, FloatArray],
    rows: npt.NDArray[np.intp],
    lower: FloatArray,
    upper: FloatArray,
) -> tuple[Qp, FloatArray, FloatArray]:
    """The same step with bounds, as a quadratic program.

    ``inputs``, ``outputs``: of :func:`smoothing_step`, by name. ``rows``: (k,); entries of z that
    are bounded. ``lower``, ``upper``: (k,). Returns the program in ξ, (n (length + 1),), with
    ``centre``, (n, length + 1), and ``slopes``, (length + 1, n, n (length + 1)): the trajectory is
    ``centre[:, k] + slopes[k] @ ξ``.
    """
    Z, A, H = inputs["trajectory"], outputs["A"], outputs["H"]
    n, count = Z.shape
    root_q, weight = np.sqrt(inputs["q"]), inputs["believed"] / inputs["r"][:, None]
    slopes, centre = np.zeros((count, n, n * count)), np.empty((n, count))
    slopes[0, :, :n] = np.linalg.cholesky(inputs["P"])
    centre[:, 0] = inputs["arrival"]
    for k in range(count - 1):
        A_k = A[:, k * n : (k + 1) * n]
        centre[:, k + 1] = outputs["moved"][:, k] + A_k @ (centre[:, k] - Z[:, k])
        slopes[k + 1] = A_k @ slopes[k]
        own = np.arange(n * (k + 1), n * (k + 2))
        slopes[k + 1, np.arange(n), own] += root_q
    sensed = np.stack([H[:, k * n : (k + 1) * n] @ slopes[k + 1] for k in range(count - 1)])
    offset = np.stack(
        [
            inputs["y"][:, k]
            - outputs["seen"][:, k]
            - H[:, k * n : (k + 1) * n] @ (centre[:, k + 1] - Z[:, k + 1])
            for k in range(count - 1)
        ]
    )
    J = sensed.reshape(-1, n * count)
    w = weight.T.ravel()
    limited = slopes[:, rows].reshape(-1, n * count)
    around = centre[rows].T.ravel()
    free = np.full(n * count, np.inf)
    qp = Qp(
        hessian=np.eye(n * count) + (J.T * w) @ J,
        gradient=-J.T @ (w * offset.ravel()),
        rows=limited,
        lower=np.concatenate([-free, np.tile(lower, count) - around]),
        upper=np.concatenate([free, np.tile(upper, count) - around]),
        linear=np.full(len(limited), np.inf),
        quadratic=np.zeros(len(limited)),
    )
    return qp, centre, slopes


@dataclass
class MheState:
    """The estimator at a sample."""

    arrival: FilterState  #: Of the arrival filter; its mean is the estimator's
    augmented: Augmentation
    function: BufferedFunction  #: A Gauss–Newton step over the window
    inputs: dict[str, FloatArray]  #: Its arrays by name
    outputs: dict[str, FloatArray]  #: the inputs hold the window
    means: FloatArray  #: (n, length + 1) array
    #: (length + 1, n, n) array; what was known at each sample of the window, then
    covariances: FloatArray
    rows: npt.NDArray[np.intp]  #: (k,) int array; entries of z that have bounds
    lower: FloatArray  #: (k,) arrays
    upper: FloatArray  #: (k,) arrays
    workspace: Any  #: Of the QP solver
    filled: int = -1  #: Samples since the window was begun, −1 before the first
    #: Samples at which a full window gave no estimate and the arrival filter's stood
    fallbacks: int = 0
    bounded: int = 0  #: Samples at which a bound was active


@dataclass(frozen=True, kw_only=True)
class Mhe(FilterOptions):
    """Moving-horizon estimator; other fields are those of
    :class:`trms_cli.observers.augmentation.FilterOptions`.
    """

    horizon: Positive = 0.3  #: s, length of the window; at least one sample
    #: Gauss–Newton steps a sample; the window is linearised anew along the last result at each
    #: sample, so that one is seldom far from the optimum
    iterations: Annotated[int, Meta(ge=1)] = 1
    #: The filter whose covariance weighs the window's beginning. Sigma points see that a rotor that
    #: stands still can turn yaw either way; a Jacobian there, where thrust has no slope, does not.
    arrival: Literal["ekf", "ukf"] = "ukf"
    #: Lowest and highest value of states or disturbances, by name, in their units
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    within_stops: bool = True  #: Whether angles are also bounded by the model's mechanical stops

    def init(self, setup: ObserverSetup) -> MheState:
        """A fresh state; see :class:`trms_cli.observers.observer.Observer`."""
        augmented = augment(setup, self)
        length = max(1, round(self.horizon / setup.sample_time))
        function = BufferedFunction(smoothing_step(augmented, length))
        shape = function.function
        # Columns are samples, also where there is only one of them.
        inputs = {
            name: array.reshape(shape.size_in(i), order="F") if name in _COLUMNS else array
            for i, (name, array) in enumerate(zip(INPUTS, function.inputs, strict=True))
        }
        outputs = {
            name: array.reshape(shape.size_out(i), order="F")
            for i, (name, array) in enumerate(zip(OUTPUTS, function.outputs, strict=True))
        }
        inputs["p"][:] = augmented.model.parameters.values
        inputs["q"][:], inputs["r"][:] = augmented.q, augmented.r
        inputs["floor"][:] = augmented.floor
        n = augmented.n
        rows, lower, upper = self._bounds(augmented)
        return MheState(
            arrival=self._filter().start(setup, augmented),
            augmented=augmented,
            function=function,
            inputs=inputs,
            outputs=outputs,
            means=np.zeros((n, length + 1)),
            covariances=np.zeros((length + 1, n, n)),
            rows=rows,
            lower=lower,
            upper=upper,
            workspace=Daqp().start(),
        )

    def step(
        self,
        state: MheState,
        command: FloatArray,
        measurement: FloatArray,
        truth: Mapping[str, float] | None,
        known: FloatArray | None = None,
    ) -> Estimate:
        """The estimate at this sample; see :class:`trms_cli.observers.observer.Observer`."""
        arrival = state.arrival
        before, recoveries = arrival.function.inputs[2].copy(), arrival.recoveries
        estimate = self._filter().step(arrival, command, measurement, truth, known)
        if arrival.recoveries > recoveries:
            state.filled = -1  # what was known before is not believed any more
        _remember(state, before)
        best = arrival.function.inputs[0].copy()
        if state.filled >= state.inputs["u"].shape[1]:
            solved = self._solve(state, best)
            if solved is None:
                state.fallbacks += 1
                state.inputs["trajectory"][...] = state.means
            else:
                best = solved
        best[state.rows] = np.clip(best[state.rows], state.lower, state.upper)
        state.means[:, -1] = state.inputs["trajectory"][:, -1] = best
        _take_over(state, best)
        return estimate

    def _solve(self, state: MheState, filtered: FloatArray) -> FloatArray | None:
        """The newest state of the best trajectory, (n,); None where there is none."""
        inputs, outputs = state.inputs, state.outputs
        inputs["arrival"][:] = state.means[:, 0]
        inputs["P"][...] = state.covariances[0]
        lower, upper = state.lower[:, None], state.upper[:, None]
        at_bound = False
        for _ in range(self.iterations):
            state.function()
            trajectory = outputs["smoothed"]
            if not np.isfinite(trajectory).all():
                return None
            bounded_rows = trajectory[state.rows]
            if state.rows.size and ((bounded_rows < lower) | (bounded_rows > upper)).any():
                within = _within_bounds(state)
                if within is None:
                    return None
                at_bound, trajectory = True, within
            inputs["trajectory"][...] = trajectory
        best = inputs["trajectory"][:, -1].copy()
        if at_bound:
            state.bounded += 1
            return best
        spread = np.sqrt(np.diag(state.arrival.function.inputs[1]))
        return best if np.all(np.abs(best - filtered) <= _FURTHEST * spread) else None

    def _filter(self) -> RecursiveFilter:
        shared = {item.name: getattr(self, item.name) for item in fields(FilterOptions)}
        return _ARRIVAL[self.arrival](**shared)

    def _bounds(
        self, augmented: Augmentation
    ) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray]:
        """Bounded entries of z, and their bounds."""
        model = augmented.model
        limits: dict[str, tuple[float, float]] = {}
        if self.within_stops:
            limits = {name: (-stop, stop) for name, stop in model.stops.items()}
        for name, (low, high) in self.bounds.items():
            require_known(
                name, augmented.names, f"the estimator has no state {name!r}", "observer.bounds"
            )
            if not low < high:
                raise ConfigurationError(
                    f"[{low:g}, {high:g}] given",
                    where=f"observer.bounds.{name}",
                    remedy="the lower bound first, and below the upper one",
                )
            limits[name] = (low, high)
        rows = [i for i, name in enumerate(augmented.names) if name in limits]
        pairs = np.array([limits[augmented.names[i]] for i in rows]).reshape(-1, 2)
        return np.array(rows, dtype=np.intp), pairs[:, 0], pairs[:, 1]


def _remember(state: MheState, memory: FloatArray) -> None:
    """Put the last sample into the window, which forgets its oldest.

    ``memory``: (n_m,) array; of the input path, before the sample.
    """
    inputs, (_, covariance, _, u, y, _, _, w_known) = (
        state.inputs,
        state.arrival.function.inputs[:8],
    )
    believed = state.arrival.present & (state.arrival.estimate.rejected == 0)
    for name, value in zip(_KEPT, (memory, u, w_known, y, believed), strict=True):
        inputs[name][:, :-1] = inputs[name][:, 1:]
        inputs[name][:, -1] = value
    for columns in (state.means, inputs["trajectory"]):
        columns[:, :-1] = columns[:, 1:]
        columns[:, -1] = state.arrival.function.inputs[0]
    state.covariances[:-1] = state.covariances[1:]
    state.covariances[-1] = covariance
    state.filled += 1


def _within_bounds(state: MheState) -> FloatArray | None:
    """The trajectory of the present linearisation within the bounds; None if there is none."""
    qp, centre, slopes = solve_bounded(
        state.inputs, state.outputs, state.rows, state.lower, state.upper
    )
    result = Daqp().solve(state.workspace, qp)
    if not result.solved:
        return None
    return centre + (slopes @ result.z).T


def _take_over(state: MheState, best: FloatArray) -> None:
    """Make an estimate the arrival filter's own, from which it goes on."""
    augmented, function = state.augmented, state.arrival.function
    function.inputs[0][:] = best
    function.outputs[0][:] = best
    of_torques = state.arrival.estimate.disturbance
    for k, equation in enumerate(augmented.equations):
        of_torques[equation] = function.inputs[7][equation] + best[augmented.n_s + k]
