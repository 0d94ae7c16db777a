"""A rig in a known state: the model fitted to its recordings, and its standing error on them.

No model is exact. The forces that an equation lacks on recordings of a rig in a known state have a
part that is common (other values of the parameters), a part that belongs to a recording (the same
rig on another day), one that wanders slowly, and one that is new every second:

    f = J δ + J β_r + b_r + s(t) + e        cov e = σ_w² + ρ_w² Σ (J_i σ_i)²

with δ ~ N(0, Λ) the parameters' deviations from their priors and J what they do to the force;
β_r ~ N(0, ρ_b² Λ) and b_r ~ N(0, σ_b²) of each recording; s(t) an Ornstein–Uhlenbeck process. How
large they are is learnt from the recordings of the known state. A further recording has sizes of
its own about these (three recordings say little of how much a fourth may differ), over which
predictions are averaged: it is predicted, with all of its covariance, before it is looked at.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.gap.short_runs import MissingForces, ShortRuns
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FreeParameter, with_values
from trms_cli.models.model import Model

#: s. Time over which the slow part forgets itself.
SLOW = 15.0
#: What is believed of the parts' sizes before any recording is seen: centre, as a share of what
#: acts there (σ) or of the parameters' priors (ρ), and standard deviation of the logarithm.
_WHITE, _SLOW, _OFFSET = (0.02, 1.5), (0.015, 1.0), (0.03, 0.7)
_OF_PRIORS, _OF_PRIORS_BETWEEN = (0.1, 1.0), (0.3, 0.7)
#: Factors about the most likely sizes that those of a further recording may have, and the standard
#: deviation of their logarithm: recordings of one state differ by more than a few of them show.
_FACTORS, _VARIES = (1.0, 2.0, 4.0), 0.6
#: Times the variance that the force of a recording's first window has: the rate that it begins with
#: is read off samples on one side alone.
_ONE_SIDED = 10.0
#: Degrees of freedom of the innovations' density: a push of the hand is over within seconds.
_FREEDOM = 6.0


class ErrorSizes(NamedTuple):
    """Sizes of the parts of one equation's standing error."""

    white: float  #: σ_w, in the force's unit
    slow: float
    offset: float  #: σ_b
    of_priors: float  #: ρ_w
    between: float  #: ρ_b


@dataclass(frozen=True)
class ForceSeries:
    """Missing forces of one equation over windows of some recordings, linear in the parameters."""

    force: FloatArray  #: (m,) array; with the parameters at the centres of their priors
    is_observed: BoolArray  #: (m,) array
    slopes: FloatArray  #: (m, n_f) array; per prior standard deviation of each parameter
    recording: IntArray  #: (m,) array
    time: FloatArray  #: (m,) array; s
    first: BoolArray  #: (m,) array; whether a window is the first of its recording

    def only(self, rows: BoolArray) -> "ForceSeries":
        """Some of the windows."""
        return ForceSeries(*(getattr(self, n)[rows] for n in self.__dataclass_fields__))


def covariance(series: ForceSeries, sizes: ErrorSizes) -> FloatArray:
    """Of the forces, (m, m)."""
    together = series.recording[:, None] == series.recording
    apart = np.abs(series.time[:, None] - series.time)
    common = series.slopes @ series.slopes.T
    own = sizes.offset**2 + sizes.slow**2 * np.exp(-apart / SLOW) + sizes.between**2 * common
    white = sizes.white**2 + sizes.of_priors**2 * np.sum(series.slopes**2, axis=1)
    white = white * np.where(series.first, _ONE_SIDED, 1.0)
    return np.asarray(common + np.where(together, own, 0.0) + np.diag(white))


def _log_density(series: ForceSeries, sizes: ErrorSizes) -> float:
    if not len(series.force):
        return 0.0
    factor = np.linalg.cholesky(covariance(series, sizes))
    z = solve_triangular(factor, series.force, lower=True)
    return float(-robust(z).sum() - np.log(np.diag(factor)).sum())


def robust(z: FloatArray) -> FloatArray:
    """Costs of innovations, nats: those of Student's t, so that no single second decides."""
    return np.asarray(0.5 * (_FREEDOM + 1) * np.log1p(z**2 / _FREEDOM))


def robust_weight(z: FloatArray) -> FloatArray:
    """What an innovation counts for in least squares that end at the smallest cost."""
    return np.asarray((_FREEDOM + 1) / (_FREEDOM + z**2))


@dataclass(frozen=True)
class ForcePrediction:
    """What one choice of sizes foretells of an equation's forces on further recordings."""

    log_weight: float  #: Belief in the sizes, nats
    mean: FloatArray  #: (m,) array
    #: (m, m) array; symmetric root of the inverse covariance: what is constant stays spread over
    #: all windows, where innovations one after the other would have it in the first
    whitener: FloatArray
    constant: float  #: nats; of the density


@dataclass(frozen=True)
class StandingError:
    """The standing error of one equation, learnt."""

    reference: ForceSeries  #: Seen windows of the recordings of the known state
    scale: float  #: What acts in the equation, in the force's unit
    sizes: ErrorSizes  #: Most likely
    sessions: int = 1  #: Recordings of the known state that are not parts of one

    @classmethod
    def fit(
        cls,
        reference: ForceSeries,
        scale: float,
        sessions: int = 1,
        begin: ErrorSizes | None = None,
    ) -> "StandingError":
        """The most likely sizes, given recordings of the known state.

        ``scale``: What acts in the equation, in the force's unit. ``begin``: sizes at which the
        search begins; None: those that are believed before.
        """
        from scipy.optimize import minimize  # 0.4 s to import

        observed_series = reference.only(reference.is_observed)
        believed = [*((c * scale, s) for c, s in (_WHITE, _SLOW, _OFFSET))]
        believed += [_OF_PRIORS, _OF_PRIORS_BETWEEN]
        centres, spreads = np.log([c for c, _ in believed]), np.array([s for _, s in believed])

        def cost(v: FloatArray) -> float:
            with np.errstate(all="ignore"):
                value = -_log_density(observed_series, ErrorSizes(*np.exp(v)))
            return value + 0.5 * float(np.sum(((v - centres) / spreads) ** 2))

        solution = minimize(
            cost,
            centres if begin is None else np.log(begin),
            method="L-BFGS-B",
            bounds=[(c - 6, c + 6) for c in centres],
            options={"maxiter": 40},
        )
        return cls(observed_series, scale, ErrorSizes(*np.exp(solution.x)), sessions)

    def predictions(
        self, series: ForceSeries, more: FloatArray | float = 0.0, only: Collection[int] = ()
    ) -> Iterator[ForcePrediction]:
        """Of further recordings, for several sizes of what differs between recordings and slowly.

        The windows of ``series`` that are not seen are foretold as well. ``more``: covariance of a
        further force on them. ``only``: which of the sizes; empty: all.
        """
        own = series.slopes @ self.reference.slopes.T
        reference_factor = cho_factor(covariance(self.reference, self.sizes), lower=True)
        mean = own @ cho_solve(reference_factor, self.reference.force)
        explained_covariance = own @ cho_solve(reference_factor, own.T)
        spread = _VARIES * np.sqrt(1 + 2 / max(self.sessions, 1))
        for number, (offset, slow) in enumerate(product(_FACTORS, _FACTORS)):
            if only and number not in only:
                continue
            sizes = ErrorSizes(
                self.sizes.white,
                self.sizes.slow * slow,
                self.sizes.offset * offset,
                self.sizes.of_priors * offset,
                self.sizes.between * offset,
            )
            weight = -0.5 * float(np.sum((np.log([offset, slow]) / spread) ** 2))
            conditional_covariance = covariance(series, sizes) - explained_covariance
            size, turn = np.linalg.eigh(
                (conditional_covariance + conditional_covariance.T) / 2 + more
            )
            size = np.maximum(size, 1e-12 * size[-1:])
            whitener = (turn / np.sqrt(size)) @ turn.T
            yield ForcePrediction(weight, mean, whitener, -0.5 * float(np.log(size).sum()))


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
    for remaining in reversed(range(_ROUNDS + 1)):
        values = {f.name: f.prior_mean + d * f.scale for f, d in zip(free, deviation, strict=True)}
        fitted_model = with_values(model, values)
        forces = runs.forces(fitted_model.parameters.values)
        slopes = _slopes(runs, fitted_model, free, forces)
        series = _series(runs, forces, slopes, deviation)
        errors = tuple(StandingError.fit(s, _scale(s, deviation, free), sessions) for s in series)
        if not remaining:
            break
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
        step *= min(1.0, _LONGEST / max(np.abs(step).max(initial=0.0), 1e-12))
        ends = [(end - f.prior_mean) / f.scale for f in free for end in (f.lower, f.upper)]
        low, high = np.reshape(ends, (-1, 2)).T
        deviation = np.clip(deviation + step, low + 0.05, high - 0.05)
    return KnownState(fitted_model, free, deviation, sd, errors, runs)


#: Rounds of the fit, the longest step of one in prior deviations, and the step of the slopes.
_ROUNDS, _LONGEST, _STEP = 3, 2.0, 0.2


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
