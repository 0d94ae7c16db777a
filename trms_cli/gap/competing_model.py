"""A model that competes: the nominal one with some effects, over the same windows as all others."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.core.threads import SYMBOLS
from trms_cli.gap.diagnosis import SizeEstimate
from trms_cli.gap.discrepancy import (
    Discrepancy,
    FilterGains,
    TrajectoryLinearisation,
    equation_channels,
    likely_shares,
)
from trms_cli.gap.gain_drift import USUAL_DRIFT, WanderingGains, gain_drift
from trms_cli.gap.problem import CandidateEffect, joint
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox.map_fit import Point, SearchEnd, minimise
from trms_cli.identification.greybox.objective import (
    PosteriorObjective,
    Quadratic,
    huber_roots,
    huber_squares,
    triangles_of_products,
)
from trms_cli.identification.greybox.windows import Residuals, Windows
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FreeParameter,
    Prior,
    acting_parameters,
    free_parameters,
    with_values,
)
from trms_cli.models.model import Model
from trms_cli.simulation.rollout import Rollout


@dataclass(frozen=True)
class Metric:
    """The same linear operation for all who compete, so that their costs can be compared."""

    discrepancy: Discrepancy  #: Linearised along the recording, through the smoothed states
    shares: FloatArray  #: (n_d,); size of the force on each equation over what acts there
    drift: WanderingGains  #: Of the drives' gains
    drift_sizes: FloatArray  #: (n_u,); standard deviation of each drive's gain
    robust: float | None = 4.0  #: Innovations beyond so many sd count linearly (Huber)
    filter_: FilterGains = field(init=False, repr=False)  #: Ready to run

    def __post_init__(self) -> None:
        object.__setattr__(self, "filter_", self.discrepancy.filter(self.shares))

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Innovations of columns (m, c, n_y, k)."""
        return self.discrepancy.whitened(self.filter_, columns)

    @cached_property
    def whitened_drift(self) -> FloatArray:
        """Whitened columns of the gains that wander within each window, scaled, (m, c, n_y, a)."""
        near = self.drift.near
        scaled = self.drift.columns * self.drift.sd(self.drift_sizes)
        near_columns = np.take_along_axis(scaled, np.maximum(near, 0)[:, None, None], axis=-1)
        return self.whitened(np.where((near >= 0)[:, None, None], near_columns, 0.0))

    def losses(self, z: FloatArray) -> FloatArray:
        """Half the robust squares of innovations (m, c, n_y), by window, shape (m,)."""
        return np.asarray(0.5 * huber_squares(z, self.robust).sum(axis=(1, 2)))


#: Slopes per scaled unit beyond this say nothing; in the outputs' units.
_STEEPEST = 1e8


@dataclass
class InnovationObjective(PosteriorObjective):
    """Maximum a posteriori in a metric of the same windows, whose model may differ.

    Its parameters are the model's free ones, then the coefficients of the drives' gains.
    """

    metric: Metric
    centres: FloatArray  #: (m, n_x) array; of the starts' priors

    def __post_init__(self) -> None:
        super().__post_init__()
        sd = self.metric.drift.sd(self.metric.drift_sizes)
        self.scales = np.concatenate([self.scales, sd])
        self.means = np.concatenate([self.means, np.zeros(len(sd))])
        self.precisions = np.concatenate([self.precisions, sd**-2])

    def simulated(self, theta: FloatArray, starts: FloatArray, *, slopes: bool) -> Residuals:
        """The windows' residuals; ``theta``: parameters, then the gains' coefficients.

        Slopes are those in the starts and parameters; those in the coefficients do not change.
        """
        columns = self.metric.drift.columns
        n_f = len(theta) - columns.shape[-1]
        residuals = super().simulated(theta[:n_f], starts, slopes=slopes)
        return residuals._replace(r=residuals.r + columns @ theta[n_f:])

    def slopes(self, residuals: Residuals) -> FloatArray:
        """Slopes in the starts, the parameters and the gains' coefficients, (m, c, n_y, k)."""
        assert residuals.j is not None
        return np.concatenate([residuals.j, self.metric.drift.columns], axis=-1)

    @np.errstate(all="ignore")
    def by_window(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        r = self.simulated(theta, starts, slopes=False).r
        if not np.isfinite(r).all():
            fine = np.asarray(np.isfinite(r).all(axis=(1, 2)))
            parts = self._losses(np.where(fine[:, None, None], r, 0.0), starts)
            return np.where(fine, parts, np.inf)
        return self._losses(r, starts)

    @np.errstate(all="ignore")
    def parabola(self, theta: FloatArray, starts: FloatArray) -> tuple[float, Quadratic, Residuals]:
        residuals = self.simulated(theta, starts, slopes=True)
        m, gaps = len(self.windows), (starts - self.centres) / self.windows.spread
        cost, triangles = np.inf, np.zeros((m, 1, self.windows.n_x + len(theta) + 1))
        if residuals.finite:
            white = self._whitened(residuals)
            z = white[..., -1]
            cost = float(self.metric.losses(z).sum() + 0.5 * np.sum(gaps**2))
            cost += self.of_parameters(theta)
            drift = self.metric.whitened_drift
            own, near = white.shape[-1] - 1, drift.shape[-1]
            rows = np.empty((*z.shape, own + near + 1))
            roots = huber_roots(z, self.metric.robust)[..., None]
            np.multiply(white[..., :-1], roots, out=rows[..., :own])
            np.multiply(drift, roots, out=rows[..., own:-1])
            np.multiply(white[..., -1:], roots, out=rows[..., -1:])
            small = triangles_of_products(rows.reshape(m, -1, rows.shape[-1]))
            triangles = np.zeros((m, small.shape[1], self.windows.n_x + len(theta) + 1))
            triangles[..., :own], triangles[..., -1] = small[..., :own], small[..., -1]
            for j, indices in enumerate(self.metric.drift.near):
                is_valid = indices >= 0
                triangles[j, :, own + indices[is_valid]] = small[j, :, own:-1][:, is_valid].T
        roots = np.sqrt(self.precisions)
        own = (roots * self.scales, roots * (theta - self.means))
        quadratic = Quadratic(triangles, gaps, *own, None)
        return cost if np.isfinite(cost) else np.inf, quadratic, residuals

    def columns(self, residuals: Residuals) -> FloatArray:
        """Whitened slopes, scaled, of all that is fitted, then the residual, (m, c, n_y, k)."""
        return self._whitened(residuals._replace(j=self.slopes(residuals)))

    def _whitened(self, residuals: Residuals) -> FloatArray:
        assert residuals.j is not None
        k = residuals.j.shape[-1]
        columns = np.empty((*residuals.r.shape, k + 1))
        scales = np.concatenate([self.windows.spread, self.scales])[:k]
        scaled = np.multiply(residuals.j, scales, out=columns[..., :-1])
        if not (scaled.max() < _STEEPEST and scaled.min() > -_STEEPEST):
            # where a simulation bounces its slopes may run away though itself it does not
            scaled[~(np.abs(scaled) < _STEEPEST)] = 0.0
        columns[..., -1] = residuals.r
        return self.metric.whitened(columns)

    def _losses(self, r: FloatArray, starts: FloatArray) -> FloatArray:
        z = self.metric.whitened(r[..., None])[..., 0]
        gaps = (starts - self.centres) / self.windows.spread
        return np.asarray(self.metric.losses(z) + 0.5 * np.sum(gaps**2, axis=1))


#: Slopes beyond this, per scaled unit, are those of a simulation that runs away.
_STEEP = 1e9


@dataclass(frozen=True)
class Evidence:
    """A fit's predictive densities and its parameters' spread."""

    predictive: FloatArray  #: (m,) array; log density of each block given the others, nats
    #: (n, n) array; of the free parameters in their units, and of the gains' coefficients
    covariance: FloatArray
    #: (m, n) array; what these would be without each block, to first order
    without: FloatArray


def evidence(
    objective: InnovationObjective,
    theta: FloatArray,
    starts: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> Evidence:
    """Evidence at a fit's optimum.

    ``theta``, (n_f,) array. ``starts``, (m, n_x) array. ``bounds``: A parameter that lies on one is
    taken as known.
    """
    _, quadratic, residuals = objective.parabola(theta, starts)
    n, m = quadratic.n, len(starts)
    nothing = Evidence(
        np.full(m, -np.inf), np.full((len(theta), len(theta)), np.nan), np.tile(theta, (m, 1))
    )
    if not residuals.finite:
        return nothing
    whole = np.asarray(np.linalg.qr(quadratic.rows, mode="r"))
    of_starts = np.log(np.abs(np.einsum("mii->mi", whole[:, :n, :n]))).sum(axis=1)
    r, c = whole[:, n:, n:-1], whole[:, n:, -1]
    if not (np.isfinite(r).all() and np.abs(r).max() < _STEEP):
        return nothing
    near = 1e-6 * objective.scales
    free = (theta > bounds[0] + near) & (theta < bounds[1] - near)
    r = r[..., free]
    prior = np.diag(quadratic.prior_root[free] ** 2)
    each = np.swapaxes(r, 1, 2) @ r
    total = each.sum(axis=0) + prior
    # what a window's log density loses by the spread of its starts and of its innovations
    base = -of_starts - 0.5 * objective.metric.filter_.logdet
    likelihood = base - objective.by_window(theta, starts)
    predictive, without = np.empty(m), np.tile(theta, (m, 1))
    for j in range(m):
        precision_without = total - each[j]
        shift = np.linalg.solve(precision_without, r[j].T @ c[j]) if free.any() else np.zeros(0)
        without[j, free] += objective.scales[free] * shift
        away = c[j] + r[j] @ shift
        spread = np.eye(len(away)) + r[j] @ np.linalg.solve(precision_without, r[j].T)
        _, logdet = np.linalg.slogdet(spread)
        worse = 0.5 * (away @ np.linalg.solve(spread, away) - c[j] @ c[j])
        predictive[j] = likelihood[j] - worse - 0.5 * logdet
    covariance = np.zeros((len(theta), len(theta)))
    inverse = np.linalg.pinv(total, rcond=1e-13, hermitian=True)
    covariance[np.ix_(free, free)] = inverse
    covariance *= np.outer(objective.scales, objective.scales)
    return Evidence(predictive, covariance, np.clip(without, *bounds))


#: Standard deviations of a mean gain beyond which no parameter can stand for it.
_OUTLYING = 6.0
#: Compiled models by nominal model: many recordings of one model are diagnosed in one process.
_ROLLOUTS: WeakKeyDictionary[Model, dict[tuple[object, ...], Rollout]] = WeakKeyDictionary()


@dataclass(frozen=True)
class CandidateFit:
    """Where the search of a structure ended."""

    theta: FloatArray  #: (n_f,) array; nominal parameters, then the effects' sizes
    starts: FloatArray  #: (m, n_x) array
    gains: FloatArray  #: (k,) array; coefficients of the drives' gains
    evidence: Evidence | None = None  #: Where it was asked for
    #: (j, n_f) array; where other searches ended that fit as well
    others: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def score(self) -> float:
        """Summed log predictive density of the blocks, nats; −∞ without evidence."""
        return -np.inf if self.evidence is None else float(self.evidence.predictive.sum())

    @property
    def predictive(self) -> FloatArray:
        """Log predictive density of each block given the others, nats, (m,)."""
        assert self.evidence is not None
        return self.evidence.predictive

    @property
    def sd(self) -> FloatArray:
        """Standard deviation of each free parameter, in its unit, (n_f,)."""
        assert self.evidence is not None
        variance = np.diag(self.evidence.covariance)[: len(self.theta)]
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def point(self) -> FloatArray:
        """Parameters and gains, as an objective has them, (n_f + k,)."""
        return np.concatenate([self.theta, self.gains])


@dataclass(frozen=True)
class FittedModel:
    """A structure fitted in a metric."""

    structure: ModelStructure
    fit: CandidateFit
    metric: Metric
    centres: FloatArray  #: (m, n_x) array; of the priors of the windows' starts

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its effects."""
        return self.structure.names

    @property
    def values(self) -> dict[str, float]:
        """The free parameters by name, where the search ended."""
        return self._by_name(self.fit.theta)

    @property
    def sds(self) -> dict[str, float]:
        """Their standard deviations; zero for what lies on a bound."""
        return self._by_name(self.fit.sd)

    @cached_property
    def at_mean_gains(self) -> FloatArray:
        """The free parameters if the drives' gains of the recordings average one, (n_f,).

        The gains wander about what the drives' parameters say, and hardly anything tells a mean of
        theirs from these: one fit has it here and another one there. A model has no gains beside
        its parameters, and what it is used for next knows the mean alone. These are the means of
        the posterior under that condition, to first order.
        """
        return self._at_mean_gains(self.fit.point)

    @property
    def values_at_mean_gains(self) -> dict[str, float]:
        """As :attr:`at_mean_gains`, by name."""
        return self._by_name(self.at_mean_gains)

    @cached_property
    def model(self) -> Model:
        """The model at the :attr:`at_mean_gains` values."""
        return with_values(self.structure.problem.model, self.values_at_mean_gains)

    def without(self, block: int) -> Model:
        """The model at the values that the other blocks alone would give it."""
        assert self.fit.evidence is not None
        theta = self._at_mean_gains(self.fit.evidence.without[block])
        return with_values(self.structure.problem.model, self._by_name(theta))

    def _by_name(self, theta: FloatArray) -> dict[str, float]:
        return dict(zip(self.structure.problem.names, theta.tolist(), strict=True))

    def _at_mean_gains(self, point: FloatArray) -> FloatArray:
        """Of parameters and gains, (n_f + k,) array."""
        n, fit_evidence = len(self.fit.theta), self.fit.evidence
        if fit_evidence is None or not np.isfinite(fit_evidence.covariance).all():
            return point[:n]
        rows = self.metric.drift.averages
        mean = rows @ point[n:]
        across = fit_evidence.covariance[:, n:] @ rows.T
        whitened = np.linalg.pinv(rows @ across[n:], hermitian=True) @ mean
        if not mean @ whitened < _OUTLYING**2:
            return point[:n]  # no parameter does what a drive's gain does
        theta = point[:n] - across[:n] @ whitened
        free = self.structure.problem.free
        return np.clip(theta, [p.lower for p in free], [p.upper for p in free])

    @cached_property
    def objective(self) -> InnovationObjective:
        """What it was fitted by."""
        structure = self.structure
        starts = structure.starts(self.fit.theta, self.centres)
        return InnovationObjective(structure.windows, self.metric, starts)

    @cached_property
    def unresolved(self) -> dict[str, tuple[float, ...]]:
        """Sizes of effects that other searches, which fit as well, ended far from; by name."""
        theta, sd = self.fit.theta, self.fit.sd
        values = {}
        for i, name in enumerate(self.structure.problem.names):
            # without a deviation it lies on a bound, and the recordings say nothing beyond
            reach = max(_FAR * sd[i], _ANOTHER * abs(theta[i])) if sd[i] > 0 else np.inf
            away = [float(o[i]) for o in self.fit.others if abs(o[i] - theta[i]) > reach]
            if away and name.partition(".")[0] in self.names:
                values[name] = tuple(away)
        return values

    @property
    def sizes(self) -> dict[str, SizeEstimate]:
        """Those of its effects, by ``<effect>.<size>``."""
        theta, sd = self.at_mean_gains, self.fit.sd
        return {
            free.name: SizeEstimate(
                value=float(theta[i]),
                sd=float(sd[i]),
                unit=free.unit,
                others=self.unresolved.get(free.name, ()),
            )
            for i, free in enumerate(self.structure.problem.free)
            if "." in free.name and any(free.name.startswith(f"{n}.") for n in self.names)
        }

    @property
    def moves(self) -> dict[str, float]:
        """How far each parameter lies off its prior, if it has one, in its standard deviations."""
        free = zip(self.at_mean_gains, self.structure.problem.free, strict=True)
        return {p.name: float((v - p.prior_mean) / p.prior_sd) for v, p in free if p.prior_sd}

    @property
    def residuals(self) -> FloatArray:
        """Measured less predicted, the drives' gains as they were fitted, (m, c, n_y)."""
        return -self.objective.simulated(self.fit.point, self.fit.starts, slopes=False).r

    def refitted(self, metric: Metric, **search: Any) -> FittedModel:
        """From where it is, in another metric; ``search``: as of :meth:`ModelStructure.fit`."""
        point = (self.fit.theta, self.fit.starts)
        fitted = self.structure.fit(
            metric, [point], centres=self.centres, gains=self.fit.gains, **search
        )
        return replace(fitted, fit=replace(fitted.fit, others=self.fit.others))

    def in_own_metric(self) -> FittedModel:
        """Refitted with the discrepancy that is most likely for itself."""
        discrepancy, shares = self.metric.discrepancy, self.metric.shares
        own = _alternating_fit(self, discrepancy, shares, rounds=2, iterations=6, tolerance=0.2)
        # sizes and fit in turn may end at a lesser optimum; benches are weighed as they ended
        is_better = own.fit.score > self.fit.score or self.structure.problem.model.bench_sizes
        return own if is_better else self


def _alternating_fit(
    fitted: FittedModel, discrepancy: Discrepancy, shares: FloatArray, rounds: int, **search: Any
) -> FittedModel:
    """A fit and the sizes of its discrepancy in turn, until these hardly change."""
    for _ in range(rounds):
        before = shares
        shares = likely_shares(discrepancy, fitted.residuals, before)
        fitted = fitted.refitted(_likely_drift(fitted, shares), **search)
        if np.max(np.abs(np.log(shares / before))) < 0.1:
            break
    return fitted


def _likely_drift(fitted: FittedModel, shares: FloatArray) -> Metric:
    """The metric with other shares, and with the drift of the gains that is most likely then."""
    metric = replace(fitted.metric, shares=shares)
    drift = metric.drift
    columns = metric.whitened(drift.columns).reshape(-1, len(drift.drive))
    precision = columns.T @ columns + np.diag(drift.sd(metric.drift_sizes) ** -2)
    variance = np.diag(np.linalg.inv(precision))
    return replace(metric, drift_sizes=drift.likely_sizes(fitted.fit.gains, variance))


#: Steps after which the searches from several points are compared.
_TRIAL = 5
#: Nats behind the best from which a search is not gone on with.
_OUTRUN = 60.0
#: Nats behind the best up to which where a search ended fits as well; standard deviations, and
#: share of a size, from which on it is elsewhere: searches end within a few percent of an optimum.
_AS_WELL, _FAR, _ANOTHER = 3.0, 4.0, 0.25
#: Searches whose costs (nats) and parameters (scaled) differ by less have met.
_SAME_OPTIMUM = (0.3, 0.1)


def _leaders(points: Sequence[Point], scales: FloatArray) -> set[int]:
    """Which of some searches are worth more steps."""
    order = sorted(range(len(points)), key=lambda k: points[k].cost)
    leaders: list[int] = []
    for k in order:
        here, best = points[k], points[order[0]]
        has_met = any(
            here.cost - points[i].cost < _SAME_OPTIMUM[0]
            and np.max(np.abs(here.theta - points[i].theta)[: len(scales)] / scales)
            < _SAME_OPTIMUM[1]
            for i in leaders
        )
        if not has_met and here.cost < best.cost + _OUTRUN:
            leaders.append(k)
    return set(leaders)


class ModelStructure:
    """The nominal model with effects, ready to be fitted.

    ``free``: of the nominal model. ``block``: s. ``unseen``: samples at the beginning of each block
    that are not compared: sensors that remember fill their memory there.
    """

    @SYMBOLS
    def __init__(
        self,
        nominal: Model,
        free: Sequence[FreeParameter],
        effects: Sequence[CandidateEffect],
        datasets: Sequence[Dataset],
        block: float,
        unseen: int = 0,
    ) -> None:
        self.effects = tuple(effects)
        self._unseen = unseen
        sizes = [size for candidate in effects for size in candidate.free]
        names = tuple(candidate.name for candidate in effects)
        rollouts = _ROLLOUTS.setdefault(nominal, {})
        step = datasets[0].sample_time
        key = (names, tuple(s.effect for s in effects), round(step, 9), tuple(p.name for p in free))
        rollout = rollouts.get(key)
        model = joint(nominal, self.effects) if rollout is None else rollout.model
        order = {name: i for i, name in enumerate(model.parameters.names)}
        every = sorted((*free, *sizes), key=lambda p: order[p.name])
        self.problem = FitProblem(
            model=model, datasets=tuple(datasets), free=tuple(every), window_length=block, jobs=1
        )
        self.windows = Windows(self.problem, rollout=rollout, unseen=unseen)
        rollouts[key] = self.windows.rollout
        self._with: dict[tuple[str, ...], ModelStructure] = {}

    def with_effects(self, *effects: CandidateEffect) -> ModelStructure:
        """The structure with some effects; each is made once."""
        sorted_effects = sorted(effects, key=lambda e: e.name)
        key = tuple(effect.name for effect in sorted_effects)
        if key not in self._with:
            p = self.problem
            self._with[key] = ModelStructure(
                p.model, p.free, sorted_effects, p.datasets, p.window_length, self._unseen
            )
        return self._with[key]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its effects."""
        return tuple(candidate.name for candidate in self.effects)

    def theta(self, values: Mapping[str, float]) -> FloatArray:
        """The free parameters by name as a vector (n_f,); those not named at their starts."""
        return np.array([values.get(p.name, p.start) for p in self.problem.free])

    def point(
        self, values: Mapping[str, float], nominal: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Where a search may begin: :meth:`theta` and :meth:`starts`."""
        theta = self.theta(values)
        return theta, self.starts(theta, nominal)

    def starts(self, theta: FloatArray, nominal: FloatArray) -> FloatArray:
        """Starts (m, n_x): those of the nominal model's states as given, the rest estimated."""
        n = nominal.shape[1]
        if self.windows.n_x == n:
            return nominal
        estimates = self.windows.starts(self.problem.all_values(theta))
        return np.hstack([nominal, estimates[:, n:]])

    def fit(
        self,
        metric: Metric,
        points: Sequence[tuple[FloatArray, FloatArray]],
        *,
        centres: FloatArray,
        gains: FloatArray | None = None,
        iterations: int = 25,
        tolerance: float = 0.05,
        with_evidence: bool = True,
    ) -> FittedModel:
        """Search from some points and keep the best.

        After a few steps those that lie far behind, or have met another, are searched no further.

        ``points``, sequence of (theta, starts). ``centres``, (m, n_nominal states) array: of the
        starts' priors, the same for all who compete. ``gains``, (k,) array: coefficients of the
        drives' gains to begin with; None: zero.
        """
        wide = metric.drift.reach
        low, high = self.problem.bounds
        bounds = (np.concatenate([low, -wide]), np.concatenate([high, wide]))
        n_f, first = len(low), np.zeros(len(wide)) if gains is None else gains

        def objective(at: Point) -> InnovationObjective:
            return InnovationObjective(self.windows, metric, self.starts(at.theta[:n_f], centres))

        def search(at: Point, steps: int) -> SearchEnd:
            return minimise(objective(at), at, bounds=bounds, iterations=steps, tolerance=tolerance)

        begins = [Point(np.concatenate([theta, first]), starts, np.inf) for theta, starts in points]
        trial = min(_TRIAL, iterations) if len(begins) > 1 else iterations
        ends = [search(point, trial) for point in begins]
        if trial < iterations:
            worth_more = _leaders([end.point for end in ends], self.problem.scales)
            ends = [
                search(end.point, iterations - trial)
                if k in worth_more and end.outcome is FitOutcome.BUDGET_SPENT
                else end
                for k, end in enumerate(ends)
            ]
        at, *rest = sorted((end.point for end in ends), key=lambda p: p.cost)
        as_well = [p.theta[:n_f] for p in rest if p.cost < at.cost + _AS_WELL]
        worth = None
        if with_evidence and np.isfinite(at.cost):
            worth = evidence(objective(at), at.theta, at.starts, bounds)
            worth = replace(worth, predictive=worth.predictive + self._stretch(at.theta[:n_f]))
        others = np.reshape(as_well, (-1, n_f))
        fit = CandidateFit(at.theta[:n_f], at.starts, at.theta[n_f:], worth, others)
        return FittedModel(self, fit, metric, centres)

    def _stretch(self, theta: FloatArray) -> float:
        """What a window's log density lacks where sensors are taken for wrong in scale.

        The prior of the starts stands for what readings say of them: of an angle that is read as
        twice itself it is half as wide. Else the smaller of two scales would be the likelier one.
        """
        values = dict(zip((p.name for p in self.problem.free), theta.tolist(), strict=True))
        sizes = [{p.name.partition(".")[2]: values[p.name] for p in c.free} for c in self.effects]
        model = self.problem.model
        return sum(c.effect.stretch(model, s) for c, s in zip(self.effects, sizes, strict=True))

    def with_fixed_parameters(self) -> ModelStructure:
        """The same with its parameters as they were."""
        structure = copy.copy(self)
        free = tuple(replace(p, lower=p.start, upper=p.start) for p in self.problem.free)
        structure.problem, structure._with = replace(self.problem, free=free), {}
        return structure


#: Sizes of the discrepancy at which the first fits are made, from generous to tight: a wide one
#: leads the search past what a tight one would stumble over.
_FIRST_SHARES = (0.3, 0.05)
#: Prior of a parameter of which the set says nothing, as a share of its value.
_UNTOLD = 0.05


@dataclass(frozen=True)
class Refit(FittedModel):
    """The nominal model before and after, with the most likely discrepancies of the refit."""

    raw: CandidateFit  #: With the parameters as they were, in the metric of the refit


#: Prior standard deviations beyond which a parameter is bent rather than estimated.
_BENT = 3.5


def about_priors(fitted: Refit) -> FittedModel | None:
    """The nominal model at its priors' centre, where the refit had to bend two parameters or more.

    In the discrepancy that is most likely for it there; None where the refit is no such proxy.
    """
    structure = fitted.structure
    theta = structure.theta({})
    moves = [
        abs(value - p.prior_mean) / p.prior_sd
        for value, p in zip(fitted.fit.theta, structure.problem.free, strict=True)
        if p.prior_sd
    ]
    if sum(move > _BENT for move in moves) < 2:
        return None
    fit, metric = replace(fitted.raw, theta=theta), fitted.metric
    raw = FittedModel(structure, fit, metric, fitted.centres)
    shares = likely_shares(metric.discrepancy, raw.residuals, metric.shares)
    return replace(raw, metric=replace(metric, shares=shares))


def nominal_parameters(model: Model) -> tuple[FreeParameter, ...]:
    """Parameters that a refit may move, with their priors.

    Those that have a prior; where a set tells none at all, each that acts, within five percent.
    """
    names = [p.name for p in model.parameters if p.prior_sd is not None and p.value != 0.0]
    if names:
        return free_parameters(model.parameters, names)
    parameters = [p for p in model.parameters if "." not in p.name and p.value != 0.0]
    try:
        acting_names = acting_parameters(model)
        free_names = [p.name for p in parameters if p.name in acting_names and p.name != "g"]
        return free_parameters(
            model.parameters, free_names, priors={n: Prior(relative_sd=_UNTOLD) for n in free_names}
        )
    except TrmsError:
        return ()


def refit(
    model: Model,
    free: Sequence[FreeParameter],
    datasets: Sequence[Dataset],
    block: float,
    unseen: int = 0,
    quanta: Mapping[str, float] | None = None,
) -> Refit:
    """Fit the nominal model and the size of its discrepancy in turn.

    The equations are linearised about the states that a smoother reads from the data, with forces
    large enough to follow them: about the model's own simulation they would be those of another
    motion where the gap is large.
    """
    structure = ModelStructure(model, free, (), datasets, block, unseen)
    windows = structure.windows
    linearisation = TrajectoryLinearisation(windows)
    theta = structure.theta({})
    p = structure.problem.all_values(theta)
    centres = windows.starts(p)
    channels = equation_channels(model)
    first = Discrepancy(windows, linearisation.along(p, centres), channels)
    trajectory = linearisation.through(p, _smoothed_states(first))
    fitting = Discrepancy(windows, trajectory, channels, start_share=0.0)
    point = (theta, centres)
    drift = gain_drift(windows, trajectory, quanta)
    usual, count = np.full(drift.drives, USUAL_DRIFT), len(channels)
    for share in _FIRST_SHARES:
        metric = Metric(fitting, np.full(count, share), drift, usual)
        fitted = structure.fit(metric, [point], centres=centres, tolerance=0.5, with_evidence=False)
        point = (fitted.fit.theta, fitted.fit.starts)
    p = structure.problem.all_values(point[0])
    trajectory = linearisation.along(p, point[1])
    trajectory = linearisation.through(p, _smoothed_states(replace(first, trajectory=trajectory)))
    fitting = Discrepancy(windows, trajectory, channels, start_share=0.0)
    drift = gain_drift(windows, trajectory, quanta)
    metric = replace(fitted.metric, discrepancy=fitting, drift=drift)
    fitted = _alternating_fit(
        replace(fitted, metric=metric), fitting, np.full(count, _FIRST_SHARES[-1]), rounds=3
    )
    points = [(theta, fitted.fit.starts), (theta, centres)]
    # with its parameters as they were, only the windows' starts are fitted
    raw = structure.with_fixed_parameters().fit(fitted.metric, points, centres=centres).fit
    return Refit(structure, fitted.fit, fitted.metric, centres, raw)


def _smoothed_states(discrepancy: Discrepancy) -> FloatArray:
    """States that follow the data, (m, c, n)."""
    r = discrepancy.windows.target - discrepancy.trajectory.y
    r = np.where(np.isfinite(r), r, 0.0)
    x, _ = discrepancy.smoothed(np.full(len(discrepancy.channels), 0.5), r)
    n = discrepancy.trajectory.x.shape[-1]
    return np.asarray(discrepancy.trajectory.x + x[..., :n])
