"""Output-error least squares of many competitors, as if all that is left were white noise.

One candidate at a time is fitted together with the nominal parameters by Levenberg–Marquardt, for
a few steps from two starts: the optimum of the nominal model alone, and the priors' centre. The
standard deviation of each output is the residuals' own, as maximum likelihood has it:

    −2 ln L = Σ_c n_c ln(RSS_c/n_c) + …        BIC = −2 ln L + k ln N
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from experiments.gap.baselines.baseline import diagnosis, places
from experiments.gap.baselines.fits import Fit, fit_problem, map_fit, parts_of
from trms_cli.core.arrays import FloatArray
from trms_cli.gap.diagnosis import Cause, DiagnosisResult, Verdict
from trms_cli.gap.problem import CandidateEffect, GapProblem, Parts, applicable_candidates
from trms_cli.gap.shrinkage import measure_shrinkage
from trms_cli.identification.greybox.map_fit import Point, information, minimise, with_fitted_starts
from trms_cli.identification.greybox.objective import MapObjective, ResidualWeights
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import FitProblem, with_values

#: Steps from each start, then from the better one, and the reduction (nats) that ends a search.
_FIRST_STEPS, _LAST_STEPS, _TOLERANCE = 4, 6, 0.5


@dataclass(frozen=True)
class Competitor:
    """A fitted candidate."""

    effects: tuple[CandidateEffect, ...]
    fit: Fit  #: Without standard deviations
    starts: FloatArray  #: (m, n_x) array; of the windows
    residual_sd: FloatArray  #: (n_y,) array; root mean square of the residuals of each output
    log_likelihood: float  #: Nats, white noise, up to a constant that all share
    #: ``parameters``, ``samples``: How many were fitted, and to how many measured values
    parameters: int
    samples: int

    @property
    def bic(self) -> float:
        """Bayesian information criterion (Schwarz 1978, Ann. Stat. 6)."""
        return -2 * self.log_likelihood + self.parameters * float(np.log(self.samples))


def compete(
    problem: GapProblem,
    parts: Parts,
    effects: Sequence[CandidateEffect],
    nominal: Competitor | None,
    *,
    parameters_fixed: bool = False,
) -> Competitor:
    """Fit the nominal parameters and some effects together.

    ``nominal``: the fit without effects; None fits that. ``parameters_fixed``: whether the
    parameters stay as they are: only the windows' starts are fitted.
    """
    estimation_problem = fit_problem(problem, parts, effects, robust=None, discrepancy="none")
    windows = Windows(estimation_problem)
    sd = windows.declared[0] if nominal is None else nominal.residual_sd
    bounds = (
        (estimation_problem.starts, estimation_problem.starts)
        if parameters_fixed
        else estimation_problem.bounds
    )
    begins: list[tuple[FloatArray, FloatArray | None]] = [(estimation_problem.starts, None)]
    if nominal is not None and not parameters_fixed:
        begins = _beginnings(estimation_problem, windows, effects, nominal)
    search_results = [
        _search(windows, theta, bounds, sd, 0 if parameters_fixed else _FIRST_STEPS, starts)
        for theta, starts in begins
    ]
    best = max(search_results, key=lambda item: item[0])
    for _ in range(0 if parameters_fixed else 3 if nominal is None else 1):
        again = _search(windows, best[1].theta, bounds, best[2], _LAST_STEPS, best[1].starts)
        best = max(best, again, key=lambda item: item[0])
    log_likelihood, point, sd = best
    values = dict(zip(estimation_problem.names, point.theta.tolist(), strict=True))
    unknown = np.full(len(estimation_problem.free), np.nan)
    return Competitor(
        tuple(effects),
        Fit(
            with_values(estimation_problem.model, values),
            estimation_problem.free,
            point.theta,
            unknown,
        ),
        point.starts,
        sd,
        log_likelihood,
        0 if parameters_fixed else len(estimation_problem.free),
        int(windows.measured.sum()),
    )


def fit_with(problem: GapProblem, parts: Parts, effects: Sequence[CandidateEffect]) -> Fit:
    """The nominal parameters and some effects, maximum a posteriori.

    A few steps of plain least squares find the sizes' order; then all is fitted well.
    """
    near = compete(problem, parts, effects, compete(problem, parts, (), None))
    starts: Mapping[str, float] = near.fit.values if np.isfinite(near.bic) else {}
    return map_fit(fit_problem(problem, parts, effects, starts))


def with_deviations(competitor: Competitor, problem: GapProblem, parts: Parts) -> Competitor:
    """The same with the standard deviations of its parameters."""
    estimation_problem = fit_problem(
        problem, parts, competitor.effects, robust=None, discrepancy="none"
    )
    windows, theta = Windows(estimation_problem), competitor.fit.theta
    objective = _objective(windows, theta, competitor.residual_sd)
    fisher_information = information(objective, theta, competitor.starts)
    covariance = fisher_information.covariance(estimation_problem.on_bounds(theta) != 0)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return replace(competitor, fit=replace(competitor.fit, sd=sd))


def _beginnings(
    estimation_problem: FitProblem,
    windows: Windows,
    effects: Sequence[CandidateEffect],
    nominal: Competitor,
) -> list[tuple[FloatArray, FloatArray | None]]:
    """The nominal optimum and the priors' centre, with the likeliest of the effects' sizes."""
    centre, nominal_values = estimation_problem.starts.copy(), nominal.fit.values
    at = np.array(
        [
            nominal_values.get(name, v)
            for name, v in zip(estimation_problem.names, centre, strict=True)
        ]
    )
    objective = _objective(windows, at, nominal.residual_sd)
    starts = objective.centres.copy()
    starts[:, : nominal.starts.shape[1]] = nominal.starts
    for candidate in effects:
        columns = [estimation_problem.names.index(p.name) for p in candidate.free]
        costs = []
        for sizes in candidate.variants:
            at[columns] = sizes
            costs.append(objective.cost(at, starts))
        at[columns] = centre[columns] = candidate.variants[int(np.argmin(costs))]
    return [(at, starts), (centre, None)]


def _search(
    windows: Windows,
    theta: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    sd: FloatArray,
    steps: int,
    starts: FloatArray | None = None,
) -> tuple[float, Point, FloatArray]:
    """Log likelihood, point and residuals' size after some steps."""
    objective = _objective(windows, theta, sd)
    if starts is None:
        point = with_fitted_starts(objective, theta, objective.centres)
    else:
        point = Point(theta, starts, objective.cost(theta, starts))
    if steps and np.isfinite(point.cost):
        # Slopes may overflow where the simulation does not: the search ends where it began.
        with suppress(np.linalg.LinAlgError):
            search = minimise(
                objective, point, bounds=bounds, iterations=steps, tolerance=_TOLERANCE
            )
            point = search.point
    return _likelihood(windows, point)


def _objective(windows: Windows, theta: FloatArray, sd: FloatArray) -> MapObjective:
    """Residuals over one standard deviation an output."""
    n_y = windows.declared.shape[1]
    weights = ResidualWeights(
        np.maximum(windows.declared, sd), np.ones(n_y), windows.share, windows.problem.robust
    )
    return MapObjective(windows, weights, windows.starts(windows.problem.all_values(theta)))


def _likelihood(windows: Windows, point: Point) -> tuple[float, Point, FloatArray]:
    """At the most likely standard deviation of each output, not below the declared one."""
    with np.errstate(all="ignore"):
        r = windows.residuals(windows.problem.all_values(point.theta), point.starts).r
        count = windows.measured.sum(axis=(0, 1))
        squares = np.sum(r**2, axis=(0, 1)) / np.maximum(count, 1)
    if not np.isfinite(squares).all():
        return -np.inf, point, windows.declared.max(axis=0)
    variance = np.maximum(squares, np.mean(windows.declared**2, axis=0))
    value = -0.5 * float(np.sum(count * (np.log(variance) + squares / variance)))
    return value, point, np.sqrt(variance)


#: Causes of less probability are not told.
_LEAST_PROBABILITY = 1e-6
_VERDICTS: dict[tuple[str, ...], Verdict] = {
    ("no_gap",): "no_gap",
    ("parameters_only",): "parameters_only",
}


@dataclass(frozen=True, kw_only=True)
class WhiteNoiseBic:
    """Each candidate fitted with the nominal parameters; ``exp(−BIC/2)`` are the probabilities."""

    name: ClassVar[str] = "white_noise_bic"

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        start_time = time.perf_counter()
        parts = parts_of(problem)
        nominal = compete(problem, parts, (), None)
        field: dict[tuple[str, ...], Competitor] = {
            ("no_gap",): compete(problem, parts, (), nominal, parameters_fixed=True),
            ("parameters_only",): nominal,
        }
        candidates, _ = applicable_candidates(problem.model, problem.candidates)
        for name, candidate in candidates.items():
            # A force that noise drives has no simulation to be compared with.
            if not candidate.stochastic:
                field[(name,)] = compete(problem, parts, (candidate,), nominal)
        fitted = time.perf_counter() - start_time
        ranked = sorted(field.items(), key=lambda item: item[1].bic)
        weights = np.exp([-(entry.bic - ranked[0][1].bic) / 2 for _, entry in ranked])
        probability = (weights / weights.sum()).tolist()
        best, winner = ranked[0][0], with_deviations(ranked[0][1], problem, parts)
        ranked[0] = (best, winner)
        share = 1 - float(np.mean((winner.residual_sd / nominal.residual_sd) ** 2))
        return diagnosis(
            problem,
            _VERDICTS.get(best, "effect"),
            [
                Cause(effects=effects, probability=p, parameters=entry.fit.sizes())
                for (effects, entry), p in zip(ranked, probability, strict=True)
                if p > _LEAST_PROBABILITY
            ],
            measure_shrinkage(problem, parts, problem.model, nominal.fit.model, winner.fit.model),
            where=places(winner.effects, float(np.clip(share, 0.0, 1.0))),
            parameters=winner.fit.nominal(),
            refit=nominal.fit.values,
            sentence=f"{', '.join(best)} has the lowest BIC on white-noise simulation error.",
            seconds={"fits": fitted, "all": time.perf_counter() - start_time},
        )
