"""A maximum a posteriori fit from one start: rounds of least squares and of weighing residuals.

Far from the optimum a residual is large because the parameters are wrong, not because of noise.
The first rounds therefore measure residuals by their own size, and each round that follows by the
size they have then, until that no longer changes: the deviations come down to the declared noise
where the model can follow the data, and stay above it where it cannot.

The least squares are Levenberg and Marquardt's, the windows' starts eliminated at every step.
Damping follows Nielsen (IMM-REP-1999-05): it falls smoothly with a good step and grows ever faster
with bad ones, which carries the search over the kinks of dry friction. Bounds are part of each
step's least-squares problem, so that a parameter may slide along its bound and leave it again.

A profile likelihood is how the cost grows when one parameter is held away from its optimum. All
others and the starts are fitted again at every value (Venzon & Moolgavkar 1988, Applied Statistics
37). Where the cost is not a parabola, or a bound is near, the interval in which it stays within
half the χ² quantile of the best is better than one from the covariance.

What the data say of the parameters at the fitted point can be trusted only so far.
Residuals of a good fit are not white: an encoder's rounding stays the same while the beam is slow,
and what a model misses lasts for seconds. With slopes ``B̃`` of the whitened residuals in the
parameters (the windows' starts eliminated) the score ``Σ B̃ᵀ r`` then has the covariance

    M = Σ_c Σ_{s,t} B̃_c(s)ᵀ γ_c(t − s) B̃_c(t)

with γ_c the autocovariance of channel c, estimated from the residuals, tapered by Parzen's window
so that M stays positive (Newey & West 1987, Econometrica 55, with the autocovariance pooled over
all windows instead of that of the products: 15 parameters cannot be told from a dozen windows).

Identifiability: Brun, Reichert & Künsch (2001, Water Resources Research 37) call a set of
parameters collinear when the change that one of them makes can nearly be made up for by the others:
with the normalised columns of the set's sensitivities, ``γ = 1/√λ_min`` of their Gram matrix. From
γ of about 10 to 15 on a set cannot be identified together: 1/γ of the effect of one is all that the
others cannot imitate.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.identification.greybox.objective import (
    MapObjective,
    PosteriorObjective,
    Quadratic,
    ResidualWeights,
    eliminate_starts,
    sizes,
)
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import FitOutcome


def autocovariance(z: FloatArray, measured: BoolArray, lags: int) -> FloatArray:
    """Tapered autocovariance of each channel's whitened residuals, shape (n_y, lags + 1).

    ``z``: (m, c, n_y) array; 0 where nothing was measured. ``lags``: the longest, in samples.
    """
    size = 2 ** int(np.ceil(np.log2(z.shape[1] + lags + 1)))
    spectrum = np.fft.rfft(z, size, axis=1)
    raw = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, : lags + 1].sum(axis=0)
    # Divided by the number of samples, not of pairs: only so is it positive at all frequencies.
    count = np.maximum(measured.sum(axis=(0, 1)), 1)
    return np.asarray((raw / count).T * parzen(lags))


def parzen(lags: int) -> FloatArray:
    """Parzen's lag window, 1 at lag 0 and 0 beyond the last, shape (lags + 1,)."""
    x = np.arange(lags + 1) / (lags + 1)
    return np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3)


def score_covariances(slopes: FloatArray, gamma: FloatArray) -> FloatArray:
    """Covariance of each channel's part of the score, shape (n_y, n_f, n_f).

    ``slopes``: (m, c, n_y, n_f) array; of the whitened residuals; 0 where nothing was measured.
    ``gamma``: (n_y, lags + 1) array.
    """
    lags = gamma.shape[1] - 1
    length = slopes.shape[1]
    size = 2 ** int(np.ceil(np.log2(length + lags)))
    kernel = np.zeros((gamma.shape[0], size))
    kernel[:, : lags + 1] = gamma
    kernel[:, size - lags :] = gamma[:, :0:-1]
    density = np.fft.rfft(kernel, axis=1).real  # (n_y, frequencies)
    covariances = []
    for c in range(slopes.shape[2]):
        spectrum = np.fft.rfft(slopes[:, :, c], size, axis=1)
        smooth = np.fft.irfft(spectrum * density[c][None, :, None], size, axis=1)[:, :length]
        covariances.append(np.einsum("mtf,mtg->fg", slopes[:, :, c], smooth))
    matrices = np.array(covariances)
    return np.asarray((matrices + matrices.swapaxes(1, 2)) / 2)


#: Share of a window up to which residuals are taken to hang together, and the same in s.
_LONGEST_SHARE, _LONGEST_LAG = 0.3, 3.0
#: Directions of a channel's information below this share of its largest say nothing.
_HEARD = 1e-12


@dataclass(frozen=True)
class Information:
    """Curvature and spread of the cost's slope, in scaled parameters."""

    #: (n_y, n_f, n_f) array; of each output's residuals, each as if white and of unit variance:
    #: Fisher's information with the starts eliminated
    curvature: FloatArray
    #: (n_y, n_f, n_f) array; covariance of each output's slope, with the residuals'
    #: autocorrelation, and the copies in overlapping windows; see :func:`information`
    score: FloatArray
    trust: FloatArray  #: (n_y,) array; weight that each output has in the cost
    prior: FloatArray  #: (n_f,) array; precision of the priors, scaled
    scales: FloatArray  #: (n_f,) array
    size: FloatArray  #: (n_y,) array; root mean square of the whitened residuals
    share: float = 1.0  #: Of the weight of a sample that each of the windows over it has

    @property
    def of_data(self) -> FloatArray:
        """Curvature of the data's part of the cost, (n_f, n_f), scaled."""
        return np.asarray(np.einsum("c,cfg->fg", self.trust, self.curvature))

    def covariance(self, is_held: BoolArray | None = None) -> FloatArray:
        """Covariance of the estimate about the truth, (n_f, n_f), in the parameters' units.

        ``H⁻¹ (Σ trust² M + P) H⁻¹`` with ``H = Σ trust F + P``: the sandwich of misspecified
        likelihoods (White 1982, Econometrica 50), where the prior is taken at its word: the
        truth is a draw from it. Where the residuals are as assumed it is ``H⁻¹``.

        ``is_held``: (n_f,) array of bool or None; parameters on a bound; they get no variance and
        pass none on.
        """
        free = np.ones(len(self.scales), dtype=bool) if is_held is None else ~is_held
        inner = np.ix_(free, free)
        h = (self.of_data + np.diag(self.prior))[inner]
        spread = (np.einsum("c,cfg->fg", self.trust**2, self.score) + np.diag(self.prior))[inner]
        inverse = np.linalg.pinv(h, rcond=1e-13, hermitian=True)
        covariance = np.zeros((len(self.scales), len(self.scales)))
        covariance[inner] = inverse @ spread @ inverse
        whole: FloatArray = covariance * np.outer(self.scales, self.scales)
        return (whole + whole.T) / 2

    def samples_per_sample(self) -> FloatArray:
        """φ of each output: how much wider its scores are than white residuals' (n_y,).

        The mean ratio over the directions in parameter space, each weighted by how much the
        output narrows it. It is of residuals in time; copies of them in overlapping windows are
        not counted here, for the cost's weights have that share already.
        """
        h = self.of_data + np.diag(self.prior)
        inverse = np.linalg.pinv(h, rcond=1e-13, hermitian=True)
        ratios = np.ones(len(self.trust))
        for c in range(len(ratios)):
            white = np.trace(inverse @ self.curvature[c])
            if white > 0:
                ratios[c] = self.share * np.trace(inverse @ self.score[c]) / white
        return ratios


def information(objective: MapObjective, theta: FloatArray, starts: FloatArray) -> Information:
    """Information at a point, by one simulation with slopes.

    Windows that lie end to end have residuals of their own, and the covariances of their slopes
    add up. Where they overlap, ``k = 1/share`` windows hold copies of one residual. Sort the
    windows into k families, each end to end: the slope is ``S = Σ S_i``, one term a family, and

        cov S ≤ k Σ_i cov S_i = k M

    (Cauchy and Schwarz), M being the sum over all windows as if they were independent. The two
    sides are equal where the families' slopes are the same, which they nearly are: they come
    from the same samples. The score is therefore ``M / share``. With the cost's weights ``share/φ``
    the overlap then leaves ``(share/φ)² M/share``, which is what one family gives.

    ``theta``: (n_f,) array. ``starts``: (m, n_x) array.
    """
    _, quadratic, residuals = objective.parabola(theta, starts)
    assert residuals.j is not None
    windows, weights = objective.windows, objective.weights
    n = windows.n_x
    slopes = objective.scaled(residuals.j)
    to_starts = eliminate_starts(quadratic, 0.0).to_starts
    projected = slopes[..., n:] + np.einsum("mtyn,mnf->mtyf", slopes[..., :n], to_starts)
    z = weights.whitened(residuals.r)
    score = z
    if weights.robust is not None:
        score = np.clip(z, -weights.robust, weights.robust)
        # Beyond the threshold the cost is a straight line and tells nothing of the curvature.
        inside = (np.abs(z) <= weights.robust) & windows.measured
    else:
        inside = windows.measured
    projected = projected / weights.sd[:, None, :, None] * windows.measured[..., None]
    lags = min(_LONGEST_LAG / windows.sample_time, _LONGEST_SHARE * z.shape[1])
    gamma = autocovariance(score, windows.measured, max(1, int(lags)))
    count = np.maximum(windows.measured.sum(axis=(0, 1)), 1)
    white = np.einsum("mtyf,mtyg->yfg", projected * inside[..., None], projected)
    covariances = score_covariances(projected, gamma)
    floored = np.array([_at_least(*pair) for pair in zip(white, covariances, strict=True)])
    return Information(
        curvature=white,
        score=floored / windows.share,
        trust=weights.trust,
        prior=objective.precisions * objective.scales**2,
        scales=objective.scales,
        size=np.sqrt((z**2).sum(axis=(0, 1)) / count),
        share=windows.share,
    )


def _at_least(white: FloatArray, estimate: FloatArray) -> FloatArray:
    """A score's covariance, no smaller in any direction than that of white residuals.

    Fitted starts and parameters take the slow part out of the residuals, so that their estimated
    autocorrelation errs to the small side; an interval must not profit from that.
    """
    values, vectors = np.linalg.eigh(white)
    is_informed = values > _HEARD * max(float(values.max(initial=0.0)), 1e-300)
    root = vectors[:, is_informed] * np.sqrt(values[is_informed])
    inverse = vectors[:, is_informed] / np.sqrt(values[is_informed])
    ratio, directions = np.linalg.eigh(inverse.T @ estimate @ inverse)
    scaled = root @ directions
    return np.asarray((scaled * np.maximum(ratio, 1.0)) @ scaled.T)


#: Brun's threshold.
COLLINEAR = 15.0
#: Share of the prior's deviation above which the data have said next to nothing.
_UNINFORMED = 0.9
#: Sets of up to so many parameters are looked at.
_LARGEST_SET = 4


@dataclass(frozen=True)
class CollinearSet:
    """Parameters whose effects on these data imitate each other."""

    names: tuple[str, ...]  #: A smallest set: without any one of them the others can be told apart
    index: float  #: Collinearity γ


@dataclass(frozen=True)
class Identifiability:
    """What the data alone say of each parameter."""

    #: Standard deviation after the data over that before; only where there is a prior
    prior_remaining: dict[str, float]
    #: γ of each parameter against all others: how many times its own effect is larger than what of
    #: it the others cannot imitate
    collinearity: dict[str, float]
    confounded: tuple[CollinearSet, ...]  #: The worst first
    silent: tuple[str, ...]  #: Parameters that these data do not depend on at all
    #: Parameters of which the data say next to nothing, so that the prior decided: those of whose
    #: prior's deviation more than nine tenths remain, and the silent ones
    uninformed: tuple[str, ...]


def identifiability(
    information: Information, names: Sequence[str], covariance: FloatArray
) -> Identifiability:
    """Judge the parameters of a fit.

    ``covariance``: (n_f, n_f) array; of the estimate, in the parameters' units.
    """
    fisher = information.of_data
    size = np.sqrt(np.diag(fisher))
    loud = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)
    columns = np.flatnonzero(loud).tolist()
    gram = fisher[np.ix_(columns, columns)] / np.outer(size[columns], size[columns])
    sd = np.sqrt(np.diag(covariance))
    remaining = {
        name: float(sd[i] / information.scales[i])
        for i, name in enumerate(names)
        if information.prior[i] > 0
    }
    inverse = np.linalg.pinv(gram, rcond=1e-14, hermitian=True)
    # γ of each against all the others: the root of its variance inflation
    against_all = np.sqrt(np.maximum(np.diag(inverse), 1.0))
    silent = tuple(names[i] for i in np.flatnonzero(~loud).tolist())
    return Identifiability(
        remaining,
        {names[i]: float(against_all[k]) for k, i in enumerate(columns)},
        tuple(_confounded(gram, [names[i] for i in columns])),
        silent,
        tuple(n for n in names if remaining.get(n, 0.0) > _UNINFORMED or n in silent),
    )


def correlations(covariance: FloatArray) -> FloatArray:
    """Correlation matrix; NaN beside a parameter without variance, its own included."""
    sd = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix: FloatArray = covariance / np.outer(sd, sd)
    return matrix


def _confounded(gram: FloatArray, names: Sequence[str]) -> list[CollinearSet]:
    results: list[tuple[tuple[int, ...], float]] = []
    for size in range(2, min(_LARGEST_SET, len(names)) + 1):
        sets = np.array(list(combinations(range(len(names)), size)))
        for subset, _ in results:  # a larger set around a known one says nothing new
            inside = np.isin(sets, subset).sum(axis=1) == len(subset)
            sets = sets[~inside]
        if not len(sets):
            break
        least = np.linalg.eigvalsh(gram[sets[:, :, None], sets[:, None, :]])[:, 0]
        index = 1 / np.sqrt(np.maximum(least, 1e-16))
        bad = np.flatnonzero(index > COLLINEAR)
        results += [(tuple(sets[k].tolist()), float(index[k])) for k in bad]
    results.sort(key=lambda item: -item[1])
    return [CollinearSet(tuple(names[i] for i in rows), index) for rows, index in results]


#: First damping, in the scaled units: as strong as the priors.
_FIRST_DAMPING = 1.0
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e12
#: Steps whose reductions stay below the tolerance before the search ends.
_SMALL_STEPS = 2


class Point(NamedTuple):
    """A point of the search."""

    theta: FloatArray  #: (n_f,) array
    starts: FloatArray  #: (m, n_x) array
    cost: float


class SearchEnd(NamedTuple):
    """Where a search ended, and why."""

    point: Point
    outcome: FitOutcome
    iterations: int


def minimise(
    objective: PosteriorObjective,
    point: Point,
    *,
    bounds: tuple[FloatArray, FloatArray],
    iterations: int,
    tolerance: float,
    watch: Callable[[int, Point], bool] = lambda k, point: True,
) -> SearchEnd:
    """Lower the cost until no step promises more than the tolerance.

    ``point``: where to begin; its cost is not read. ``bounds``: each (n_f,); equal where a
    parameter is held. ``iterations``: at most so many steps, bad ones included. ``tolerance``: in
    the cost's unit; a change of 0.5 is one standard deviation of one parameter, so that a
    thousandth lies far below what any data can tell. ``watch``: told the iteration and the best
    point; False ends the search.
    """
    theta = np.clip(point.theta, *bounds)
    cost, quadratic, _ = objective.parabola(theta, point.starts)
    best = Point(theta, point.starts, cost)
    if not np.isfinite(cost):
        return SearchEnd(best, FitOutcome.FAILED, 0)
    damping, growth, small = _FIRST_DAMPING, 2.0, 0
    for k in range(iterations):
        if not watch(k, best):
            return SearchEnd(best, FitOutcome.INTERRUPTED, k)
        dx, dtheta = step(quadratic, damping, best.theta, bounds, objective.scales)
        here = quadratic.cost(np.zeros_like(dx), np.zeros_like(dtheta))
        promised = here - quadratic.cost(dx, dtheta)
        if promised < tolerance and damping <= _FIRST_DAMPING:
            return SearchEnd(best, FitOutcome.CONVERGED, k)
        theta = np.clip(best.theta + dtheta * objective.scales, *bounds)
        trial_starts = best.starts + dx * objective.windows.spread
        cost, starts = objective.better_starts(theta, trial_starts, best.starts)
        gained = best.cost - cost
        if gained > 0:
            small = small + 1 if gained < tolerance else 0
            cost, quadratic, _ = objective.parabola(theta, starts)
            best = Point(theta, starts, cost)
            if small >= _SMALL_STEPS:
                return SearchEnd(best, FitOutcome.CONVERGED, k + 1)
            quality = min(gained / promised, 1.0) if promised > 0 else 0.0
            damping = max(damping * max(1 / 5, 1 - (2 * quality - 1) ** 3), _LEAST_DAMPING)
            growth = 2.0
        else:
            damping, growth = damping * growth, growth * 2
            if damping > _MOST_DAMPING or promised < 0.01 * tolerance:
                outcome = FitOutcome.CONVERGED if promised < tolerance else FitOutcome.STUCK
                return SearchEnd(best, outcome, k + 1)
    return SearchEnd(best, FitOutcome.BUDGET_SPENT, iterations)


def step(
    quadratic: Quadratic,
    damping: float,
    theta: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    scales: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The damped parabola's minimum within bounds: changes of starts and parameters, scaled."""
    reduction = eliminate_starts(quadratic, damping)
    n_f = len(theta)
    rows = np.vstack(
        [reduction.factor, np.diag(quadratic.prior_root), np.sqrt(damping) * np.eye(n_f)]
    )
    target = -np.concatenate([reduction.residual, quadratic.prior_gap, np.zeros(n_f)])
    low, high = (bounds[0] - theta) / scales, (bounds[1] - theta) / scales
    dtheta = bounded_least_squares(rows, target, low, high)
    return reduction.starts(dtheta), dtheta


def bounded_least_squares(
    rows: FloatArray, target: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """``min |rows·x − target|²`` with ``low ≤ x ≤ high``; held where the two are equal."""
    x = np.zeros(rows.shape[1])
    is_held = low == high
    x[is_held] = low[is_held]
    free = ~is_held
    if not free.any():
        return x
    a, b = rows[:, free], target - rows[:, is_held] @ x[is_held]
    inner, *_ = np.linalg.lstsq(a, b, rcond=None)
    if ((inner < low[free]) | (inner > high[free])).any():
        from scipy.optimize import lsq_linear  # 0.4 s to import, and seldom needed

        # The triangle says the same in fewer rows.
        q, r = np.linalg.qr(a)
        inner = lsq_linear(r, q.T @ b, (low[free], high[free]), method="bvls").x
    x[free] = np.clip(inner, low[free], high[free])
    return x


#: Least-squares steps in the rounds before the last, and the reduction (nats) that ends a round.
_ROUND_ITERATIONS, _ROUND_TOLERANCE = 12, 0.5
_ROUNDS = 8
#: Relative change of the residuals' scales that no longer needs another round.
_SETTLED = 0.1
#: Joints that are to be tighter than this are tightened to it by factors of ten.
_FIRST_JOINT = 0.03
#: Gauss–Newton steps on the starts alone before anything is weighed.
_START_STEPS = 3


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """How a fit goes about it."""

    iterations: int = 100  #: Least-squares steps in the last round at most
    tolerance: float = 1e-3  #: Reduction of the cost that ends it, nats
    gap_sd: float | None = None  #: See :class:`MapObjective`


class MapFit(NamedTuple):
    """Where a fit ended."""

    point: Point
    outcome: FitOutcome
    objective: MapObjective  #: With the weights of the last round
    information: Information | None  #: None where nothing could be simulated
    iterations: int

    @property
    def covariance(self) -> FloatArray | None:
        """Of the estimate, (n_f, n_f); parameters on a bound have none."""
        if self.information is None:
            return None
        problem = self.objective.windows.problem
        return self.information.covariance(problem.on_bounds(self.point.theta) != 0)


def fit_from(
    windows: Windows,
    theta: FloatArray,
    settings: MapSettings,
    *,
    held: BoolArray | None = None,
    watch: Callable[[int, Point], bool] = lambda k, point: True,
) -> MapFit:
    """Fit from parameters ``theta`` (n_f,); those that are ``held`` stay where they are.

    ``watch``: told the number of steps so far and the best point; False ends the fit.
    """
    problem = windows.problem
    bounds = problem.bounds
    if held is not None:
        bounds = (np.where(held, theta, bounds[0]), np.where(held, theta, bounds[1]))
    centres = windows.starts(problem.all_values(theta))
    joints = _joints(settings.gap_sd)
    objective = MapObjective(windows, _declared(windows), centres, joints[0])
    point = with_fitted_starts(objective, theta, centres)
    if not np.isfinite(point.cost):
        return MapFit(point, FitOutcome.FAILED, objective, None, 0)
    objective.weights = fit_weights(objective, point, None)
    last_information, steps, outcome = None, 0, FitOutcome.CONVERGED
    for round_ in range(_ROUNDS):
        objective.gap_sd = joints[min(round_, len(joints) - 1)]
        search = minimise(
            objective,
            point,
            bounds=bounds,
            iterations=_ROUND_ITERATIONS,
            tolerance=_ROUND_TOLERANCE,
            watch=lambda k, at, steps=steps: watch(steps + k, at),  # type: ignore[misc]
        )
        point, steps = search.point, steps + search.iterations
        if search.outcome is FitOutcome.INTERRUPTED:
            outcome = search.outcome
            break
        last_information = information(objective, point.theta, point.starts)
        weights = fit_weights(objective, point, last_information)
        before, objective.weights = objective.weights, weights
        scale = before.sd / weights.sd * np.sqrt(before.samples / weights.samples)
        if np.max(np.abs(np.log(scale))) < _SETTLED and round_ + 1 >= len(joints):
            break
    if outcome is not FitOutcome.INTERRUPTED:
        search = minimise(
            objective,
            point,
            bounds=bounds,
            iterations=settings.iterations,
            tolerance=settings.tolerance,
            watch=lambda k, at: watch(steps + k, at),
        )
        point, outcome, steps = search.point, search.outcome, steps + search.iterations
    last_information = information(objective, point.theta, point.starts)
    return MapFit(point, outcome, objective, last_information, steps)


def _joints(last: float | None) -> list[float | None]:
    """Joints between windows, tightened by steps: a stiff one lets the search move by hairs."""
    if last is None:
        return [None]
    joints: list[float | None] = [last]
    while (joints[0] or 0.0) < _FIRST_JOINT:
        joints.insert(0, min(10 * (joints[0] or 0.0), _FIRST_JOINT))
    return joints


def with_fitted_starts(objective: MapObjective, theta: FloatArray, starts: FloatArray) -> Point:
    """The parameters as they are, with the starts that fit best to them."""
    fixed_bounds = (theta, theta)
    best = Point(theta, starts, objective.cost(theta, starts))
    for _ in range(_START_STEPS):
        _, quadratic, residuals = objective.parabola(theta, best.starts)
        if not residuals.finite:
            break
        dx, _ = step(quadratic, 1e-6, theta, fixed_bounds, objective.scales)
        trial = best.starts + dx * objective.windows.spread
        cost = objective.cost(theta, trial)
        if not cost < best.cost:
            break
        gained, best = best.cost - cost, Point(theta, trial, cost)
        if gained < 1e-3 * cost:
            break
    return best


def fit_weights(
    objective: MapObjective, point: Point, information: Information | None
) -> ResidualWeights:
    """Weights that fit the residuals at a point; see :class:`ResidualWeights`."""
    windows, problem = objective.windows, objective.windows.problem
    if problem.discrepancy == "none" and information is not None:
        return _declared(windows)
    p = problem.all_values(point.theta)
    r = windows.residuals(p, point.starts).r
    size = np.maximum(1.0, sizes(r, windows.measured, windows.declared))
    samples = objective.weights.samples
    if information is not None:
        samples = np.maximum(1.0, information.samples_per_sample())
    return ResidualWeights(windows.declared * size, samples, windows.share, problem.robust)


def _declared(windows: Windows) -> ResidualWeights:
    n_y = windows.declared.shape[1]
    return ResidualWeights(windows.declared, np.ones(n_y), windows.share, windows.problem.robust)


#: Half the 95 % quantile of χ² with one degree of freedom.
_RISE_95 = 3.841458820694124 / 2
#: The profile is followed to this many times that rise, to show its shape beyond the interval.
_FOLLOWED = 1.5
_ITERATIONS, _TOLERANCE = 30, 1e-3
_MOST_STEPS = 24


@dataclass(frozen=True)
class Profile:
    """The cost along one parameter."""

    values: FloatArray  #: (k,) array; ascending, in the parameter's unit
    rise: FloatArray  #: (k,) array; above the optimum's; negative if the fit had missed the best
    #: 95 %, by the likelihood ratio; infinite on a side where the profile stays below the quantile
    #: as far as it was followed, the bound where it ends there
    interval: tuple[float, float]


def profile(
    objective: MapObjective,
    best: Point,
    name: str,
    sd: float,
    *,
    factor: float = 1.0,
    watch: Callable[[int, Point], bool] = lambda k, point: True,
) -> Profile:
    """Follow the cost to both sides of an optimum, each fit beginning at the one before.

    ``objective``: with the weights of the fit. ``sd``: of the free parameter ``name``; steps are
    half of it. ``factor``: the rise is multiplied by it before it is compared: how much larger the
    curvature of the cost would be if the residuals' correlation were in it.
    """
    problem = objective.windows.problem
    column = problem.names.index(name)
    low, high = problem.bounds
    values, rises = [float(best.theta[column])], [0.0]
    ends = []
    for direction, bound in ((-1.0, low[column]), (1.0, high[column])):
        point, stride, end = best, 0.5 * sd, direction * np.inf
        for _ in range(_MOST_STEPS):
            value = float(point.theta[column] + direction * stride)
            value = float(np.clip(value, low[column], high[column]))
            if value == point.theta[column]:
                end = float(bound)
                break
            theta = point.theta.copy()
            theta[column] = value
            fixed_bounds = (low.copy(), high.copy())
            fixed_bounds[0][column] = fixed_bounds[1][column] = value
            minimum = minimise(
                objective,
                point._replace(theta=theta),
                bounds=fixed_bounds,
                iterations=_ITERATIONS,
                tolerance=_TOLERANCE,
                watch=watch,
            ).point
            rise = factor * (minimum.cost - best.cost)
            before = factor * (point.cost - best.cost)
            if before < _RISE_95 <= rise:
                share = _root_share(before, rise)
                end = float(point.theta[column] + share * (value - point.theta[column]))
            values.append(value)
            rises.append(rise)
            point = minimum
            if not np.isfinite(rise) or rise > _FOLLOWED * _RISE_95:
                break
            if rise < 0.25 * _RISE_95:  # flat: longer strides
                stride *= 1.5
        ends.append(end)
    order = np.argsort(values)
    return Profile(np.array(values)[order], np.array(rises)[order], (ends[0], ends[1]))


def _root_share(before: float, after: float) -> float:
    """Where between two values the rise passes the quantile, as of a parabola."""
    roots = np.sqrt(np.maximum([before, after, _RISE_95], 0.0))
    return float((roots[2] - roots[0]) / max(roots[1] - roots[0], 1e-12))
