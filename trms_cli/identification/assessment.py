"""What is to be said of a fit: uncertainty of the parameters, errors of the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.free_runs import WindowRuns, window_runs
from trms_cli.identification.problem import FitProblem, FitResult, with_values
from trms_cli.models.model import Model

#: What a method's details say of the parameters, and what the document says elsewhere.
_TOLD, _ELSEWHERE = ("identifiability", "outputs", "profiles"), ("on_bounds",)


@dataclass
class Assessment:
    """A fit with all that is told of it."""

    result: FitResult
    #: Of the parameters, as JSON has it; empty for a network
    statistics: dict[str, Any] = field(default_factory=dict)
    #: ``before``, ``after``: Free runs of the model as it was and as fitted, over ``fit`` and
    #: ``held_out``
    before: dict[str, list[WindowRuns]] = field(default_factory=dict)
    after: dict[str, list[WindowRuns]] = field(default_factory=dict)

    @property
    def deviations(self) -> dict[str, float | None]:
        """Standard deviations of the fitted parameters, absolute; None where there is none."""
        covariance = self.result.covariance
        if covariance is None:
            return dict.fromkeys(self.result.values)
        roots = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        return {
            name: float(sd) if np.isfinite(sd) and sd > 0 else None
            for name, sd in zip(self.result.values, roots, strict=True)
        }

    @property
    def correlation(self) -> FloatArray | None:
        """Correlation of the estimates, (n_f, n_f); NaN beside one without variance."""
        from trms_cli.identification.greybox.information import correlations

        covariance = self.result.covariance
        return None if covariance is None else correlations(covariance)


def assess(problem: FitProblem, result: FitResult) -> Assessment:
    """What the data say of the fitted parameters; nothing yet of errors."""
    told = {key: result.details[key] for key in _TOLD if key in result.details}
    details = {key: value for key, value in result.details.items() if key not in told}
    result = replace(result, details={k: v for k, v in details.items() if k not in _ELSEWHERE})
    if not result.values or not np.isfinite(result.cost) or result.covariance is not None:
        return Assessment(result, told)
    return _at_point(problem, result, told)


def _at_point(problem: FitProblem, result: FitResult, told: dict[str, Any]) -> Assessment:
    """Covariance and identifiability, for a method that knows no slopes."""
    from trms_cli.identification.greybox.information import identifiability
    from trms_cli.identification.greybox.map_fit import MapSettings, fit_from
    from trms_cli.identification.greybox.windows import Windows

    every = np.ones(len(result.values), dtype=bool)
    fit = fit_from(Windows(problem), result.theta, MapSettings(), held=every)
    covariance = fit.covariance
    if fit.information is None or covariance is None:
        return Assessment(result, told)
    judged_so = identifiability(fit.information, problem.names, covariance)
    return Assessment(
        replace(result, covariance=covariance), told | {"identifiability": asdict(judged_so)}
    )


def judge(problem: FitProblem, assessment: Assessment, fitted: Model | None = None) -> None:
    """Simulate what was fitted and what was held out, with the old model and the new.

    ``fitted``: the model that a network was trained to; None: the problem's with the fitted values.
    """
    after = fitted or with_values(problem.model, assessment.result.values)
    parts = {"fit": problem.datasets, "held_out": problem.validation}
    for part, datasets in parts.items():
        length = problem.window_length
        assessment.after[part] = window_runs(after, datasets, length, jobs=problem.jobs)
        if fitted is None:
            assessment.before[part] = window_runs(
                problem.model, datasets, length, jobs=problem.jobs
            )


def at_bounds(problem: FitProblem, values: Mapping[str, float]) -> dict[str, str]:
    """Which fitted values lie on a bound: ``lower`` or ``upper`` by name."""
    at = problem.on_bounds(np.array([values[name] for name in problem.names]))
    words = {-1: "lower", 1: "upper"}
    return {name: words[on] for name, on in zip(problem.names, at.tolist(), strict=True) if on}
