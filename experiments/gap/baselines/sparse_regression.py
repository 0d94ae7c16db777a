"""Sparse regression on the smoothed residual force, in the manner of SINDy.

The force that the refitted model lacks is regressed on a library of terms by sequentially
thresholded least squares (Brunton, Proctor & Kutz 2016, PNAS 113), the threshold chosen by
cross-validation over blocks with the rule of one standard error. What the nominal parameters can
add within their priors is projected out of both sides first, for no term should be credited with
it. The term that explains most names the effect. It has no probabilities: what stands there are
the terms' shares of what is explained.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from experiments.gap.baselines.baseline import diagnosis
from experiments.gap.baselines.fits import Fit, parts_of, refit
from experiments.gap.baselines.force_terms import AddedForces, Term, columns
from experiments.gap.baselines.restoring_force import Motion, motion
from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.effects.extended_model import extend_model
from trms_cli.gap.diagnosis import Cause, DiagnosisResult, LocationShare
from trms_cli.gap.problem import CandidateEffect, GapProblem, applicable_candidates
from trms_cli.gap.shrinkage import measure_shrinkage
from trms_cli.identification.problem import with_values
from trms_cli.models.model import Model, names

#: Standard deviation of a term's contribution, in that of the force, below which it goes.
_THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6)
_FOLDS, _SWEEPS = 5, 10


class SupportedTerm(NamedTuple):
    """A term that stayed."""

    coefficient: float
    gain: float  #: Nats that it explains of its equation beside the others that stayed
    share: float  #: Of the equation's force, 0 to 1


@dataclass(frozen=True, kw_only=True)
class SparseRegression:
    """SINDy on the restoring force."""

    name: ClassVar[str] = "sparse_regression"

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        start_time = time.perf_counter()
        parts = parts_of(problem)
        fit = refit(problem, parts)
        trajectory = motion(fit.model, parts.fitted, [p.name for p in fit.free], parts.block)
        supported_terms = sparse_terms(fit, trajectory)
        corrected = (
            with_terms(fit, trajectory, tuple(supported_terms)) if supported_terms else fit.model
        )
        causes = _causes(supported_terms, problem)
        return diagnosis(
            problem,
            "effect" if supported_terms else "parameters_only",
            causes,
            measure_shrinkage(problem, parts, problem.model, fit.model, corrected),
            where=_where(
                supported_terms, applicable_candidates(problem.model, problem.candidates)[0]
            ),
            confusable=[term.effects for term in supported_terms if len(term.effects) > 1],
            parameters=fit.nominal(),
            refit=fit.values,
            sentence=_sentence(supported_terms),
            description=[
                f"{term.location}: {entry.coefficient:+.3g} × {term.name}, "
                f"{100 * entry.share:.0f} % of the residual force"
                for term, entry in supported_terms.items()
            ],
            seconds={"all": time.perf_counter() - start_time},
        )


def sparse_terms(fit: Fit, trajectory: Motion) -> dict[Term, SupportedTerm]:
    """Terms that stay, those that explain most first.

    Each has to earn what the extended Bayesian information criterion asks for one of so many
    (Chen & Chen 2008, Biometrika 95).
    """
    terms, values = columns(fit.model, trajectory)
    scales = np.array([p.scale for p in fit.free])
    supported_terms: dict[Term, SupportedTerm] = {}
    for i, place in enumerate(names(fit.model.disturbances)):
        term_columns = [k for k, term in enumerate(terms) if term.location == place]
        if not term_columns:
            continue
        force = trajectory.force[:, i]
        library = values[:, term_columns]
        # A parameter moves by its prior; neighbouring samples of a smoothed force are one.
        ridge = float(np.var(force)) * len(force) / trajectory.independent
        outside = _Projector(trajectory.of_parameters[:, i] * scales, ridge)
        y, columns_ = outside(force[:, None])[:, 0], outside(library)
        coefficients = _regressed(columns_, y, trajectory.block)
        rss = _rss(columns_, y, coefficients)
        for k, value in coefficients.items():
            without = _rss(columns_, y, {j: c for j, c in coefficients.items() if j != k})
            gain = 0.5 * trajectory.independent * float(np.log(without / rss))
            share = 1 - rss / without
            if gain < 0.5 * np.log(trajectory.independent) + np.log(len(terms)):
                continue
            supported_terms[terms[term_columns[k]]] = SupportedTerm(value, gain, share)
    return dict(sorted(supported_terms.items(), key=lambda item: -item[1].gain))


def with_terms(fit: Fit, trajectory: Motion, selected_terms: tuple[Term, ...]) -> Model:
    """The refitted model with some terms; their coefficients together with all parameters.

    All equations at once, each in units of its force, the parameters held by their priors.
    """
    terms, values = columns(fit.model, trajectory)
    places = names(fit.model.disturbances)
    scales = np.array([p.scale for p in fit.free])
    size = np.maximum(np.std(trajectory.force, axis=0), 1e-300)
    n_f, rows, targets = len(fit.free), [], []
    worth = np.sqrt(trajectory.independent / len(trajectory.force))
    for i, place in enumerate(places):
        block = np.zeros((len(trajectory.force), n_f + len(selected_terms)))
        block[:, :n_f] = trajectory.of_parameters[:, i] * scales
        for k, term in enumerate(selected_terms):
            if term.location == place:
                block[:, n_f + k] = values[:, terms.index(term)]
        rows.append(block * worth / size[i])
        targets.append(trajectory.force[:, i] * worth / size[i])
    own = np.hstack([np.eye(n_f), np.zeros((n_f, len(selected_terms)))])
    a, b = np.vstack([*rows, own]), np.concatenate([*targets, np.zeros(n_f)])
    width = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    solved, *_ = np.linalg.lstsq(a / width, b, rcond=1e-10)
    solved = solved / width
    low = np.array([p.lower for p in fit.free])
    high = np.array([p.upper for p in fit.free])
    theta = np.clip(fit.theta + solved[:n_f] * scales, low, high)
    parameters = dict(zip((p.name for p in fit.free), theta.tolist(), strict=True))
    coefficients = dict(zip(selected_terms, solved[n_f:].tolist(), strict=True))
    added = AddedForces(coefficients=coefficients)
    return extend_model(with_values(fit.model, parameters), {"regressed_force": added})


class _Projector:
    """Takes out of columns what nuisances explain under a ridge."""

    def __init__(self, nuisances: FloatArray, ridge: float) -> None:
        self._n = nuisances
        inner = nuisances.T @ nuisances + ridge * np.eye(nuisances.shape[1])
        self._gain = np.linalg.solve(inner, nuisances.T) if nuisances.size else nuisances.T

    def __call__(self, values: FloatArray) -> FloatArray:
        residual: FloatArray = values - self._n @ (self._gain @ values)
        return residual


def _regressed(columns_: FloatArray, y: FloatArray, block: IntArray) -> dict[int, float]:
    """Coefficients of the terms that stay, by column; the threshold by cross-validation."""
    fold = block % _FOLDS
    errors = np.zeros((len(_THRESHOLDS) + 1, _FOLDS))
    for f in range(_FOLDS):
        train, test = fold != f, fold == f
        if not test.any() or not train.any():
            continue
        errors[-1, f] = np.mean(y[test] ** 2)
        for t, threshold in enumerate(_THRESHOLDS):
            coefficients = _thresholded(columns_[train], y[train], threshold)
            residual = y[test] - sum(c * columns_[test, k] for k, c in coefficients.items())
            errors[t, f] = np.mean(residual**2)
    mean = errors.mean(axis=1)
    best = int(np.argmin(mean))
    spread = np.std(errors[best] - errors, axis=1, ddof=1) / np.sqrt(_FOLDS)
    # The last row is the empty model; the sparsest within one standard error of the best.
    near = [t for t in range(len(mean)) if mean[t] <= mean[best] + spread[t]]
    threshold_index = max(near)
    return (
        {}
        if threshold_index == len(_THRESHOLDS)
        else _thresholded(columns_, y, _THRESHOLDS[threshold_index])
    )


def _thresholded(columns_: FloatArray, y: FloatArray, threshold: float) -> dict[int, float]:
    """Least squares, small contributions dropped, again."""
    size = np.std(columns_, axis=0)
    active_set = np.flatnonzero(size > 1e-12 * max(1e-300, float(size.max(initial=0.0))))
    least = threshold * float(np.std(y))
    for _ in range(_SWEEPS):
        if not active_set.size:
            return {}
        scaled = columns_[:, active_set] / size[active_set]
        c, *_ = np.linalg.lstsq(scaled, y, rcond=1e-8)
        large = np.abs(c) >= least
        if large.all():
            return {int(k): float(v / size[k]) for k, v in zip(active_set, c, strict=True)}
        active_set = active_set[large]
    return {}


def _rss(columns_: FloatArray, y: FloatArray, coefficients: Mapping[int, float]) -> float:
    """With the coefficients of these columns fitted anew."""
    active_columns = columns_[:, list(coefficients)]
    if not coefficients:
        return float(y @ y)
    c, *_ = np.linalg.lstsq(active_columns / np.std(active_columns, axis=0), y, rcond=1e-8)
    residual = y - active_columns / np.std(active_columns, axis=0) @ c
    return float(residual @ residual)


def _causes(supported_terms: Mapping[Term, SupportedTerm], problem: GapProblem) -> list[Cause]:
    """Effects by their terms' shares of all gains; no probabilities."""
    gains: dict[str, float] = defaultdict(float)
    for term, entry in supported_terms.items():
        names_ = [e for e in term.effects if e in problem.candidates] or ["none_of_these"]
        for name in names_:
            gains[name] += entry.gain / len(names_)
    total = sum(gains.values())
    if not total > 0:
        return [Cause(effects=("parameters_only",), probability=1.0)]
    ordered = sorted(gains.items(), key=lambda item: -item[1])
    return [Cause(effects=(name,), probability=gain / total) for name, gain in ordered]


def _where(
    supported_terms: Mapping[Term, SupportedTerm], candidates: Mapping[str, CandidateEffect]
) -> list[LocationShare]:
    """Where the effects that terms speak for act; a term that speaks for none, at its equation."""
    gains: dict[str, float] = defaultdict(float)
    for term, entry in supported_terms.items():
        effect_locations = [candidates[e].locations for e in term.effects if e in candidates]
        places = effect_locations[0] if effect_locations else (term.location,)
        for place in places:
            gains[place] += entry.gain / len(places)
    total = sum(gains.values())
    return [
        LocationShare(location=place, share=gain / total, ci95=(0.0, 1.0))
        for place, gain in sorted(gains.items(), key=lambda item: -item[1])
        if total > 0
    ]


def _sentence(supported_terms: Mapping[Term, SupportedTerm]) -> str:
    if not supported_terms:
        return "No term of the library explains the residual force in cross-validation."
    term = next(iter(supported_terms))
    return f"{term.name} on {term.location} explains most of the residual force."
