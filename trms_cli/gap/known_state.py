"""A rig in a known state: the model fitted to its recordings, and what it lacks on them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.short_runs import MissingForces, ShortRuns
from trms_cli.gap.standing import ForceSeries, StandingError, covariance
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FreeParameter, with_values
from trms_cli.models.model import Model


@dataclass(frozen=True)
class KnownState:
    """A model fitted to recordings of a rig in a known state, with what it lacks on them."""

    model: Model  #: At the fitted values
    free: tuple[FreeParameter, ...]  #: That were fitted, and that may be what changes
    deviation: FloatArray  #: (n_f,) array; from their priors' centres, in their deviations
    sd: FloatArray  #: (n_f,) array; what the recordings leave of it
    errors: tuple[StandingError, ...]  #: By equation
    runs: ShortRuns  #: Over the recordings of the known state

    def series(self, runs: ShortRuns, forces: MissingForces) -> tuple[ForceSeries, ...]:
        """Missing forces over any recordings by equation, linear about the fitted values."""
        slopes = _slopes(runs, self.model, self.free, forces)
        return _series(runs, forces, slopes, self.deviation)


def known_state(
    model: Model, free: Sequence[FreeParameter], references: Sequence[Dataset]
) -> KnownState:
    """Fit the parameters to recordings of the known state, and learn the standing error."""
    free = tuple(f for f in free if f.prior_sd)
    # pieces of one recording share its day
    sessions = len({dataset.sha256 or str(i) for i, dataset in enumerate(references)})
    if len(references) == 1:  # how much its halves differ stands for how much recordings do
        whole = references[0]
        half = len(whole) // 2
        references = (whole.part(0, half), whole.part(half, len(whole)))
    runs = ShortRuns(model, references)
    deviation, sd = np.zeros(len(free)), np.ones(len(free))
    for _ in range(_ROUNDS):
        fitted_model = with_values(model, _values(free, deviation))
        forces = runs.forces(fitted_model.parameters.values)
        slopes = _slopes(runs, fitted_model, free, forces)
        series = _series(runs, forces, slopes, deviation)
        errors = tuple(
            StandingError.fit(s, _scale(s, deviation, free), sessions) for e, s in enumerate(series)
        )
        total, right = np.eye(len(free)), np.zeros(len(free))
        for error in errors:
            reference = error.reference
            own = covariance(reference, error.sizes) - reference.slopes @ reference.slopes.T
            weighted_columns = np.linalg.solve(
                own, np.column_stack([reference.slopes, reference.force])
            )
            total += reference.slopes.T @ weighted_columns[:, :-1]
            right -= reference.slopes.T @ weighted_columns[:, -1]
        sd = np.sqrt(np.diag(np.linalg.inv(total)))
        step = np.linalg.solve(total, right) - deviation
        deviation = _clip_to_bounds(
            free, deviation + step * min(1.0, _LONGEST / max(np.abs(step).max(initial=0.0), 1e-12))
        )
    fitted_model = with_values(model, _values(free, deviation))
    forces = runs.forces(fitted_model.parameters.values)
    slopes = _slopes(runs, fitted_model, free, forces)
    errors = tuple(
        StandingError.fit(s, _scale(s, deviation, free), sessions)
        for e, s in enumerate(_series(runs, forces, slopes, deviation))
    )
    return KnownState(fitted_model, free, deviation, sd, errors, runs)


#: Rounds of the fit, the longest step of one in prior deviations, and the step of the slopes.
_ROUNDS, _LONGEST, _STEP = 3, 2.0, 0.2


def _values(free: Sequence[FreeParameter], deviation: FloatArray) -> dict[str, float]:
    return {f.name: f.prior_mean + d * f.scale for f, d in zip(free, deviation, strict=True)}


def _clip_to_bounds(free: Sequence[FreeParameter], deviation: FloatArray) -> FloatArray:
    low = np.array([(f.lower - f.prior_mean) / f.scale for f in free])
    high = np.array([(f.upper - f.prior_mean) / f.scale for f in free])
    return np.clip(deviation, low + 0.05, high - 0.05)


def _slopes(
    runs: ShortRuns, model: Model, free: Sequence[FreeParameter], forces: MissingForces
) -> FloatArray:
    """Of the missing forces per prior deviation of each parameter, (m, e, n_f)."""
    slopes = np.zeros((*forces.force.shape, len(free)))
    for i, f in enumerate(free):
        p = model.parameters.values
        at = model.parameters.names.index(f.name)
        step = _STEP if p[at] + _STEP * f.scale < f.upper else -_STEP
        p[at] += step * f.scale
        slopes[..., i] = (runs.forces(p).force - forces.force) / step
    return np.nan_to_num(slopes)


def _series(
    runs: ShortRuns, forces: MissingForces, slopes: FloatArray, deviation: FloatArray
) -> tuple[ForceSeries, ...]:
    is_observed = np.isfinite(forces.force)
    series = []
    for e in range(forces.force.shape[1]):
        force = np.nan_to_num(forces.force[:, e])
        moves = is_observed[:, e] & ~forces.at_rest[:, e]
        # where the model holds the axis and the rig does, too, nothing is seen of the force
        usual = np.median(np.abs(force[moves])) if moves.any() else 0.0
        quiet = forces.at_rest[:, e] & (np.abs(force) < _QUIET * usual)
        centred_force = force - slopes[:, e] @ deviation
        series.append(
            ForceSeries(
                centred_force,
                is_observed[:, e] & ~quiet,
                slopes[:, e],
                runs.recording,
                runs.begin,
                ~runs.windows.follows,
            )
        )
    return tuple(series)


#: Times the usual missing force up to which an axis that the model holds is held on the rig.
_QUIET = 4.0


def _scale(series: ForceSeries, deviation: FloatArray, free: Sequence[FreeParameter]) -> float:
    """What acts in an equation: the largest contribution of a parameter, its root mean square.

    Of an equation without a free parameter, what it lacks.
    """
    observed_series = series.only(series.is_observed)
    if not len(observed_series.force):
        return 1e-9
    values = np.array(
        [(f.prior_mean + d * f.scale) / f.scale for f, d in zip(free, deviation, strict=True)]
    )
    parts = np.abs(observed_series.slopes * values).max(axis=1, initial=0.0)
    missing = observed_series.force + observed_series.slopes @ deviation
    return float(max(np.sqrt(np.mean(parts**2)), np.sqrt(np.mean(missing**2)), 1e-9))
