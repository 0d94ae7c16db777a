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

A Gauss–Newton step is a Kalman smoother of the model linearised along the last trajectory (Bell
1994, "The iterated Kalman smoother as a Gauss–Newton method", SIAM J. Optim. 4): compiled, linear
in the length of the window, and never divides by a process noise that may be zero. It is the mirror
of the recursion of ``newton_mpc``, and treats bounds as that does: an entry that leaves its bounds
is held there, by a measurement that is far surer than what is known of it, and all that stand wrong
change at once until none does. What is held stays beyond its bound by its multiplier times the
variance of that measurement: an entry that the bound does not hold back has come inside.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Literal

import casadi as ca
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
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
_COLUMNS = ("trajectory", "held", "bound", *_KEPT)
INPUTS = (
    *("trajectory", "arrival", "P", "held", "bound", "memory", "u", "known", "y", "believed"),
    *("p", "q", "r", "floor"),
)
#: Variance of the measurement that holds an entry at its bound, as a share of the entry's at the
#: window's beginning; and how far beside its bound an entry still stands on it, as a share of its
#: standard deviation there, and how far one that is held may be off.
_HOLDING, _ON_BOUND, _ACCURACY = 1e-7, 1e-11, 1e-7
#: Changes of what is held at the bounds, usually two or three; after the first ones a single entry
#: at once, which is slower and does not cycle (Murty 1974, Linear Algebra Appl. 9).
_ROUNDS, _AT_ONCE = 60, 8
OUTPUTS = ("smoothed", "moved", "A", "seen", "H")


def smoothing_step(augmented: Augmentation, length: int, rows: Sequence[int] = ()) -> ca.Function:
    """One Gauss–Newton step over ``length`` samples.

    ``rows``: entries of z that may be held at a bound. Inputs: trajectory to linearise along (n,
    length + 1), mean and covariance at its beginning, for each of its points which of the rows are
    held (1 or 0) and where (k, length + 1), and for each sample the memory before it, command and
    known torques during it, measurement and mask at its end. Outputs: the smoothed trajectory;
    F(z_k) (n, length) and its slopes side by side (n, n·length), h(z_k) (n_y, length) and its
    slopes (n_y, n·length).
    """
    model, n, n_y = augmented.model, augmented.n, len(augmented.channels)
    Z, arrival = ca.MX.sym("trajectory", n, length + 1), ca.MX.sym("arrival", n)
    held, bound = (ca.MX.sym(name, len(rows), length + 1) for name in ("held", "bound"))
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
    hold, variances = _hold(n, rows), _HOLDING * ca.diag(P_0)[list(rows)] + 1e-300
    m, P = hold(arrival, P_0, held[:, 0], bound[:, 0], variances)
    filtered, predicted = [(m, P)], []
    for k in range(length):
        A_k, H_k = A[:, k * n : (k + 1) * n], H[:, k * n : (k + 1) * n]
        m_prior, P_prior, m, P = forward(
            *(m, P, Z[:, k], successors[:, k], A_k, Z[:, k + 1], readings[:, k], H_k),
            *(y[:, k], believed[:, k], q, r, floor),
        )
        m, P = hold(m, P, held[:, k + 1], bound[:, k + 1], variances)
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
        [Z, arrival, P_0, held, bound, memory, u, w_known, y, believed, p, q, r, floor],
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


def _hold(n: int, rows: Sequence[int]) -> ca.Function:
    """Mean and covariance with some entries at their bounds, one after another."""
    m, P = ca.SX.sym("m", n), ca.SX.sym("P", n, n)
    held, bound, variances = (ca.SX.sym(name, len(rows)) for name in ("held", "bound", "variances"))
    m_next, P_next = m, P
    for k, row in enumerate(rows):
        column = P_next[:, row]
        gain = held[k] / (column[row] + variances[k]) * column
        m_next = m_next + gain * (bound[k] - m_next[row])
        P_next = P_next - gain @ column.T
    return ca.Function("hold", [m, P, held, bound, variances], [m_next, P_next])


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
        rows, lower, upper = self._bounds(augmented)
        function = BufferedFunction(smoothing_step(augmented, length, rows.tolist()))
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
                state.inputs["held"][...] = 0.0
                state.inputs["trajectory"][...] = state.means
            else:
                best = solved
        best[state.rows] = np.clip(best[state.rows], state.lower, state.upper)
        state.means[:, -1] = state.inputs["trajectory"][:, -1] = best
        _take_over(state, best)
        return estimate

    def _solve(self, state: MheState, filtered: FloatArray) -> FloatArray | None:
        """The newest state of the best trajectory, (n,); None where there is none."""
        inputs = state.inputs
        inputs["arrival"][:] = state.means[:, 0]
        inputs["P"][...] = state.covariances[0]
        for _ in range(self.iterations):
            trajectory = _within_bounds(state)
            if trajectory is None:
                return None
            inputs["trajectory"][...] = trajectory
        best = inputs["trajectory"][:, -1].copy()
        if inputs["held"].any():
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
    for name in ("held", "bound"):
        inputs[name][:, :-1] = inputs[name][:, 1:]
    for columns in (state.means, inputs["trajectory"]):
        columns[:, :-1] = columns[:, 1:]
        columns[:, -1] = state.arrival.function.inputs[0]
    state.covariances[:-1] = state.covariances[1:]
    state.covariances[-1] = covariance
    state.filled += 1


def _within_bounds(state: MheState) -> FloatArray | None:
    """The trajectory of the present linearisation within the bounds; None if there is none."""
    held, bound, rows = state.inputs["held"], state.inputs["bound"], state.rows
    lower, upper = state.lower[:, None], state.upper[:, None]
    sd = np.sqrt(state.covariances[0][rows, rows])[:, None]
    for round_ in range(_ROUNDS):
        state.function()
        trajectory = state.outputs["smoothed"]
        if not np.isfinite(trajectory).all():
            return None
        z = trajectory[rows]
        if not held.any() and (z >= lower).all() and (z <= upper).all():
            return trajectory
        is_lower = np.where(held, bound - lower < upper - bound, lower - z > z - upper)
        edge = np.where(is_lower, lower, upper)
        outwards = np.where(is_lower, -1.0, 1.0) * (z - np.where(held, bound, edge))
        wrong = (outwards > np.where(held, -_ON_BOUND, _ON_BOUND) * sd) != held
        if not wrong.any():
            off = np.where(held, z - edge, 0.0)
            if (np.abs(off) <= _ACCURACY * sd).all():
                return trajectory
            bound -= off
            continue
        if round_ >= _AT_ONCE:
            sample, row = np.argwhere(wrong.T)[-1]
            wrong[:] = False
            wrong[row, sample] = True
        held[wrong] = 1.0 - held[wrong]
        bound[wrong] = edge[wrong]
    return None


def _take_over(state: MheState, best: FloatArray) -> None:
    """Make an estimate the arrival filter's own, from which it goes on."""
    augmented, function = state.augmented, state.arrival.function
    function.inputs[0][:] = best
    function.outputs[0][:] = best
    of_torques = state.arrival.estimate.disturbance
    for k, equation in enumerate(augmented.equations):
        of_torques[equation] = function.inputs[7][equation] + best[augmented.n_s + k]
