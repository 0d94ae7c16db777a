"""Moving-horizon estimator: the best trajectory over the last moments, within bounds.

At each sample the trajectory over the last ``horizon`` seconds is fitted to what was measured in
them, to the model, and to what was known at their beginning (:mod:`trms_cli.observers.mhe_window`).
The weight of the beginning, the arrival cost, is the covariance of an arrival filter that runs
beside and takes over the estimator's mean at every sample, so that no measurement counts twice
(Rao, Rawlings & Mayne 2003, "Constrained state estimation for nonlinear discrete-time systems",
IEEE TAC 48: the filtering update). On a linear model without bounds the estimate is the Kalman
filter's, whatever the horizon is.

The arrival filter also gates outliers, predicts the next measurement, and stands in where a
problem is not solved, in the first moments before the window is full, and after a recovery.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.core.qp import Daqp
from trms_cli.models.estimate import Estimate
from trms_cli.observers.augmentation import Augmentation, FilterOptions, augment
from trms_cli.observers.ekf import Ekf
from trms_cli.observers.mhe_window import INPUTS, OUTPUTS, bounded, smoothing_step
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterState, RecursiveFilter
from trms_cli.observers.ukf import Ukf

FloatArray = npt.NDArray[np.float64]

_ARRIVAL: dict[str, type[RecursiveFilter]] = {"ekf": Ekf, "ukf": Ukf}
#: A result this many standard deviations from the arrival filter's, without any bound to explain
#: it, is a diverged iteration.
_FURTHEST = 20.0
#: What the window keeps of each sample, oldest first.
_KEPT = ("memory", "u", "known", "y", "believed")
_COLUMNS = ("trajectory", *_KEPT)


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

    horizon: Annotated[float, Meta(gt=0)] = 0.3  #: s, length of the window; at least one sample
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
            held = trajectory[state.rows]
            if state.rows.size and ((held < lower) | (held > upper)).any():
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
            if name not in augmented.names:
                raise ConfigurationError(
                    f"the estimator has no state {name!r}",
                    where="observer.bounds",
                    remedy=nearest(name, augmented.names),
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

    Parameters
    ----------
    memory : (n_m,) array
        Of the input path, before the sample.
    """
    inputs, (_, covariance, _, u, y, _, _, known) = state.inputs, state.arrival.function.inputs[:8]
    believed = state.arrival.present & (state.arrival.estimate.rejected == 0)
    for name, value in zip(_KEPT, (memory, u, known, y, believed), strict=True):
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
    qp, centre, slopes = bounded(state.inputs, state.outputs, state.rows, state.lower, state.upper)
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
