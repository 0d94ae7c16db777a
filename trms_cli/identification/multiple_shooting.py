"""Multiple shooting: least squares with exact sensitivities over windows with starts of their own.

The recordings are cut into windows, each simulated from a start that is fitted along with the
parameters (Bock 1983; Ljung's output-error fit is the case of one window). Short memory keeps the
cost close to a parabola where one long simulation would not be, and lets a model with an error of
its own be fitted without that error growing over minutes. See ``docs/grey-box.md``.
"""

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.plugins import require_known
from trms_cli.identification.greybox import map_fit
from trms_cli.identification.greybox.objective import sizes
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    HistoryPoint,
    Progress,
)
from trms_cli.models.model import names

#: Gaps between windows as a share of the starts' spread: a few mrad and 10 mrad/s when joined
#: softly; when joined hard the gaps are below what any sensor sees.
_JOINED = {"free": None, "penalty": 0.03, "equality": 1e-4}
#: Fits that agree differ in the logarithm of their posterior by less than this, nats.
_AGREEMENT = 0.5


@dataclass(frozen=True, kw_only=True)
class MultipleShooting:
    """Levenberg–Marquardt from several starts."""

    #: Whether the end of a window has to meet the start of the next: not at all, nearly, or exactly
    #: (one simulation from end to end)
    continuity: Literal["free", "penalty", "equality"] = "free"
    #: Points to search from: first the model's values, then the optimum of the model without its
    #: effects (or the priors' centre where it has none), then draws from the priors
    starts: Annotated[int, Meta(ge=1)] = 2
    iterations: Annotated[int, Meta(ge=1)] = 100  #: Least-squares steps from each start at most
    tolerance: Annotated[float, Meta(gt=0)] = 1e-3  #: Fall of the cost that ends a search, nats
    profiles: tuple[str, ...] = ()  #: Parameters whose profile is wanted; ``all`` for every one

    fits_parameters: ClassVar[bool] = True

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        start_time = time.perf_counter()
        profile_names = _profiled(self.profiles, problem)
        windows = Windows(problem)
        settings = map_fit.MapSettings(
            iterations=self.iterations, tolerance=self.tolerance, gap_sd=_JOINED[self.continuity]
        )
        watcher = _Watcher(progress, problem, self.starts, self.iterations, start_time)
        fits: list[map_fit.MapFit] = []
        for k in range(self.starts):
            theta = watcher.begin(k)
            if theta is None:
                theta = _starting_point(k, problem, windows, settings)
            fits.append(map_fit.fit_from(windows, theta, settings, watch=watcher))
            watcher.evaluations += fits[-1].objective.evaluations
            if watcher.stopped:
                break
        # The most probable of the fits that could be simulated, else the first.
        best = fits[int(np.argmin(_standings(fits)))]
        details = _details(problem, fits, best)
        if best.information is not None and not watcher.stopped:
            details["profiles"] = _profiles(best, profile_names, watcher)
        return FitResult(
            method="multiple_shooting",
            outcome=FitOutcome.INTERRUPTED if watcher.stopped else best.outcome,
            cost=best.point.cost,
            values=dict(zip(problem.names, best.point.theta.tolist(), strict=True)),
            covariance=best.covariance,
            history=watcher.history,
            evaluations=watcher.evaluations,
            seconds=time.perf_counter() - start_time,
            details=details,
        )


class _Watcher:
    """Passes the search's steps on to the progress, keeps the history and where searches are.

    A fit that was interrupted goes on from the last point of each search; those that had ended
    are at their end after a step or two.
    """

    def __init__(
        self, progress: Progress, problem: FitProblem, starts: int, iterations: int, begun: float
    ) -> None:
        self._progress, self._starts, self._iterations = progress, starts, iterations
        self._begin_time, self._start = begun, 0
        points = (progress.saved() or {}).get("points", [])
        self._points: list[list[float]] = [p for p in points if len(p) == len(problem.free)]
        self.history: list[HistoryPoint] = []
        self.stopped = False
        self.evaluations = 0

    def begin(self, start: int) -> FloatArray | None:
        """Note which search begins; where an earlier fit had come with it, if it had begun."""
        self._start = start
        return np.array(self._points[start]) if start < len(self._points) else None

    def __call__(self, iteration: int, point: map_fit.Point) -> bool:
        # A search seldom takes more than a third of the steps that it may.
        share = 1 - 0.1 ** (3 * iteration / self._iterations)
        fraction = (self._start + share) / self._starts
        message = f"start {self._start + 1} of {self._starts}, step {iteration}"
        self.history.append(
            HistoryPoint(
                self.evaluations + iteration, time.perf_counter() - self._begin_time, point.cost
            )
        )
        self._points[self._start :] = [point.theta.tolist(), *self._points[self._start + 1 :]]
        self._progress.save({"points": self._points})
        self.stopped = self.stopped or not self._progress.update(fraction, point.cost, message)
        return not self.stopped


def _starting_point(
    k: int, problem: FitProblem, windows: Windows, settings: map_fit.MapSettings
) -> FloatArray:
    """Where the search number ``k`` begins: the model as it is, a standard place, draws."""
    first = problem.starts
    if k == 0:
        return first
    if k == 1:
        effects = np.array(["." in name for name in problem.names])
        if effects.any() and not effects.all():
            # With the effects' sizes held, the model's own parameters are fitted first: where the
            # search for both at once loses its way, this one may not, and the other way round.
            return map_fit.fit_from(windows, first, settings, held=effects).point.theta
        if not np.array_equal(problem.prior_means, first):
            return problem.prior_means
    generator = np.random.default_rng(np.random.SeedSequence([problem.seed, 0x57A7, k]))
    low, high = problem.bounds
    draw = problem.prior_means + problem.scales * generator.standard_normal(len(first))
    return np.clip(draw, low, high)


def _standings(fits: list[map_fit.MapFit]) -> FloatArray:
    """Minus the logarithm of each fit's posterior, nats, up to a constant; infinite for failures.

    Each fit weighs residuals by their own size, and a worse one allows itself larger ones. Here
    the size is part of the likelihood: ``n/φ log σ`` for n samples of an output, of which φ say
    as much as one (the median over the fits, so that all are measured alike).
    """
    standings = np.full(len(fits), np.inf)
    able = [k for k, fit in enumerate(fits) if fit.information is not None]
    if not able:
        return standings
    samples = np.median([fits[k].objective.weights.samples for k in able], axis=0)
    for k in able:
        objective, point = fits[k].objective, fits[k].point
        windows = objective.windows
        r = windows.residuals(windows.problem.all_values(point.theta), point.starts).r
        size = sizes(r, windows.measured, windows.declared)
        floored = np.maximum(1.0, size) if windows.problem.discrepancy == "estimate" else 1.0
        count = windows.measured.sum(axis=(0, 1)) * windows.share / samples
        standings[k] = np.sum(count * (np.log(floored) + 0.5 * (size / floored) ** 2))
        standings[k] += objective.of_priors(point.theta, point.starts)
    return standings


def _details(
    problem: FitProblem, fits: list[map_fit.MapFit], best: map_fit.MapFit
) -> dict[str, Any]:
    """What the result says beside its values, as JSON has it."""
    judge, standings = best.objective, _standings(fits)
    least = standings.min()
    behind = [float(s - least) if np.isfinite(s) else None for s in standings]
    details: dict[str, Any] = {
        "starts": [
            {
                "outcome": fit.outcome.value,
                "behind_best": nats,
                "iterations": fit.iterations,
                "values": dict(zip(problem.names, fit.point.theta.tolist(), strict=True)),
            }
            for fit, nats in zip(fits, behind, strict=True)
        ],
        "starts_agree": all(s is not None and s < _AGREEMENT for s in behind),
    }
    covariance = best.covariance
    if best.information is None or covariance is None:
        return details
    judgement = map_fit.identifiability(best.information, problem.names, covariance)
    at = problem.on_bounds(best.point.theta)
    weights, declared = judge.weights, judge.windows.declared
    return details | {
        "on_bounds": [name for name, on in zip(problem.names, at, strict=True) if on],
        "identifiability": asdict(judgement),
        "outputs": {
            name: {
                "declared_sd": float(declared[0, i]),
                "used_sd": float(weights.sd[0, i]),
                "samples_per_independent_one": float(weights.samples[i]),
                "whitened_rms": float(best.information.size[i]),
            }
            for i, name in enumerate(names(problem.model.outputs))
        },
    }


def _profiled(requested_names: tuple[str, ...], problem: FitProblem) -> tuple[str, ...]:
    if "all" in requested_names:
        return problem.names
    for name in requested_names:
        allowed_names = (*problem.names, "all")
        require_known(name, allowed_names, f"{name!r} is not free", "method.profiles")
    return requested_names


def _profiles(
    best: map_fit.MapFit, parameter_names: tuple[str, ...], watcher: _Watcher
) -> Mapping[str, Any]:
    covariance = best.covariance
    assert best.information is not None and covariance is not None
    problem = best.objective.windows.problem
    curvature = np.linalg.pinv(
        best.information.of_data + np.diag(best.information.prior), rcond=1e-13, hermitian=True
    )
    profiles = {}
    for name in parameter_names:
        i = problem.names.index(name)
        plain = float(np.sqrt(max(curvature[i, i], 0.0)) * problem.scales[i])
        sd = float(np.sqrt(covariance[i, i])) or plain
        # The cost's own curvature takes residuals as white; the covariance does not.
        along = map_fit.profile(
            best.objective, best.point, name, sd, factor=(plain / sd) ** 2, watch=watcher
        )
        profiles[name] = {
            "values": along.values.tolist(),
            "rise": along.rise.tolist(),
            "interval_95": [v if np.isfinite(v) else None for v in along.interval],
        }
        if watcher.stopped:
            break
    return profiles
