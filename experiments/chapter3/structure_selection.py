"""Which lags and how many hidden units: by the error on data that are not fitted.

Each candidate is trained from several random starts. The error that counts is that of the free
run over the held-out recordings: one step ahead nearly every structure looks good. Taken is the
smallest candidate within one standard error of the best (the rule of Breiman, Friedman, Olshen &
Stone 1984, "Classification and Regression Trees"), by the logarithms of the errors, so that a
factor counts the same everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.identification.blackbox.narx import NarxFit
from trms_cli.identification.problem import FitProblem, FitResult, Progress


@dataclass(frozen=True)
class Candidate:
    """A structure."""

    lags: int  #: The outputs and inputs of 1 … lags samples ago
    hidden: int  #: Units of the one hidden layer


@dataclass(frozen=True)
class AssessedCandidate:
    """A structure with the errors of its trainings, one entry a start."""

    candidate: Candidate
    weights: int
    one_step: tuple[float, ...]  #: Normalised RMS errors over the held-out recordings
    free_run: tuple[float, ...]  #: infinite after a divergence

    @property
    def median(self) -> float:
        """Of the free-run errors."""
        return float(np.median(self.free_run))

    @property
    def level(self) -> float:
        """Mean of the logarithms of the free-run errors."""
        return float(np.mean(np.log(self.free_run)))

    @property
    def standard_error(self) -> float:
        """Of :attr:`level`; 0 for a single start."""
        n = len(self.free_run)
        return float(np.std(np.log(self.free_run), ddof=1) / np.sqrt(n)) if n > 1 else 0.0


def candidate_method(method: NarxFit, candidate: Candidate) -> NarxFit:
    """A method with a candidate's lags and hidden units."""
    lags = tuple(range(1, candidate.lags + 1))
    regressors = replace(method.regressors, output_lags=lags, input_lags=lags)
    return replace(method, hidden=(candidate.hidden,), regressors=regressors)


def assess(
    candidate: Candidate,
    method: NarxFit,
    problem: FitProblem,
    seeds: Sequence[int],
    progress: Progress,
) -> AssessedCandidate:
    """Train a candidate from several starts.

    Raises RecordingError if the recordings cannot be fitted, or nothing is held out.
    """
    narx_fit = candidate_method(method, candidate)
    results = [narx_fit.fit(replace(problem, seed=seed), progress) for seed in seeds]
    return AssessedCandidate(
        candidate,
        int(results[0].details["weights"]),
        tuple(_error(result, "validation_one_step") for result in results),
        tuple(_error(result, "validation_free_run") for result in results),
    )


def select_candidate(assessed: Sequence[AssessedCandidate]) -> AssessedCandidate:
    """The candidate with the fewest weights within one standard error of the best."""
    best = min(assessed, key=lambda one: one.level)
    if not np.isfinite(best.level):  # every one has diverged at least once
        return min(assessed, key=lambda one: one.median)
    limit = best.level + best.standard_error
    return min(
        (one for one in assessed if one.level <= limit), key=lambda one: (one.weights, one.level)
    )


def _error(result: FitResult, key: str) -> float:
    value = result.details["normalised_rms"][key]
    return np.inf if value is None else float(value)
