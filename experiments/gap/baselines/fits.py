"""Fits of the nominal parameters, alone and with effects, that the baselines share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.diagnosis import FittedParameter, SizeEstimate
from trms_cli.gap.problem import CandidateEffect, GapProblem, Parts, divide, joint
from trms_cli.identification.multiple_shooting import MultipleShooting
from trms_cli.identification.problem import (
    PRIORS,
    FitProblem,
    FreeParameter,
    SilentProgress,
    free_parameters,
    with_values,
)
from trms_cli.models.model import Model


@dataclass(frozen=True)
class Fit:
    """A fitted model."""

    model: Model  #: With the fitted values
    free: tuple[FreeParameter, ...]
    #: ``theta``, ``sd``: (n_f,) arrays; their values and standard deviations
    theta: FloatArray
    sd: FloatArray

    @property
    def values(self) -> dict[str, float]:
        """By name."""
        return {p.name: float(v) for p, v in zip(self.free, self.theta, strict=True)}

    def nominal(self) -> dict[str, FittedParameter]:
        """The nominal parameters as a diagnosis tells them."""
        return {
            p.name: FittedParameter(
                prior=p.prior_mean,
                fitted=float(value),
                sd=float(sd),
                unit=p.unit,
                moved=float(abs(value - p.prior_mean) / p.scale),
            )
            for p, value, sd in zip(self.free, self.theta, self.sd, strict=True)
            if not is_size(p.name)
        }

    def sizes(self) -> dict[str, SizeEstimate]:
        """Sizes of the effects as a diagnosis tells them."""
        return {
            p.name: SizeEstimate(value=float(value), sd=float(sd), unit=p.unit)
            for p, value, sd in zip(self.free, self.theta, self.sd, strict=True)
            if is_size(p.name)
        }


def parts_of(problem: GapProblem) -> Parts:
    """What is fitted and what stays sealed: as the diagnosis divides it."""
    return divide(problem.datasets, problem.block, problem.sealed_share, problem.model.stops)


def is_size(name: str) -> bool:
    """Whether a parameter is an effect's."""
    return "." in name


def nominal_free(model: Model) -> tuple[FreeParameter, ...]:
    """All that has a prior; empty for a model without."""
    if all(p.prior_sd is None for p in model.parameters):
        return ()
    return free_parameters(model.parameters, [PRIORS])


def fit_problem(
    problem: GapProblem,
    parts: Parts,
    effects: Sequence[CandidateEffect] = (),
    starts: Mapping[str, float] | None = None,
    **settings: object,
) -> FitProblem:
    """The nominal parameters and the sizes of some effects, to be fitted together.

    ``starts``: where a search begins instead of at the prior's centre or the typical size.
    """
    model = with_values(joint(problem.model, effects), starts or {})
    priors = {p.name: p for p in nominal_free(problem.model)}
    priors |= {p.name: p for candidate in effects for p in candidate.free}
    free = tuple(
        _starting_at(priors[p.name], p.value) for p in model.parameters if p.name in priors
    )
    return FitProblem(
        model=model,
        datasets=parts.fitted,
        free=free,
        window_length=parts.block,
        seed=problem.seed,
        jobs=problem.jobs,
        **settings,  # type: ignore[arg-type]
    )


def map_fit(problem: FitProblem, starts: int = 2) -> Fit:
    """Maximum a posteriori by multiple shooting from several starts."""
    if not problem.free:
        return Fit(problem.model, (), np.zeros(0), np.zeros(0))
    fit_result = MultipleShooting(starts=starts).fit(problem, SilentProgress())
    n = len(problem.free)
    covariance = np.full((n, n), np.nan) if fit_result.covariance is None else fit_result.covariance
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Fit(with_values(problem.model, fit_result.values), problem.free, fit_result.theta, sd)


def refit(problem: GapProblem, parts: Parts) -> Fit:
    """The nominal parameters alone."""
    return map_fit(fit_problem(problem, parts))


def _starting_at(parameter: FreeParameter, value: float) -> FreeParameter:
    return replace(parameter, start=float(np.clip(value, parameter.lower, parameter.upper)))
