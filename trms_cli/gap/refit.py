"""The nominal model refitted within its priors, and how much its equations still err."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.gap.discrepancy import (
    Discrepancy,
    TrajectoryLinearisation,
    likely_shares,
    usual_channels,
)
from trms_cli.gap.fitting import CandidateFit, Metric, ModelStructure
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FreeParameter, free_parameters
from trms_cli.models.model import Model

#: Sizes of the discrepancy at which the first fits are made, from generous to tight: a wide one
#: leads the search past what a tight one would stumble over.
_FIRST_SHARES = (0.3, 0.05)
#: Prior of a parameter of which the set says nothing, as a share of its value.
_UNTOLD = 0.05


@dataclass(frozen=True)
class Refit:
    """The nominal model, before and after."""

    structure: ModelStructure  #: Without effects beyond the model's own
    raw: CandidateFit  #: With the parameters as they were, in the metric of the refit
    fit: CandidateFit
    metric: Metric  #: With the most likely discrepancies of the refit
    centres: FloatArray  #: (m, n_x) array; of the priors of the windows' starts


def nominal_parameters(model: Model) -> tuple[FreeParameter, ...]:
    """Parameters that a refit may move, with their priors.

    Those that have a prior; where a set tells none at all, each that acts, within five percent.
    """
    names = [p.name for p in model.parameters if p.prior_sd is not None and p.value != 0.0]
    if names:
        return free_parameters(model.parameters, names)
    known = [p for p in model.parameters if "." not in p.name and p.value != 0.0]
    try:
        from trms_cli.identification.problem import Prior, acting_parameters

        used = acting_parameters(model)
        chosen = [p.name for p in known if p.name in used and p.name != "g"]
        return free_parameters(
            model.parameters, chosen, priors={n: Prior(relative_sd=_UNTOLD) for n in chosen}
        )
    except TrmsError:
        return ()


def refit(
    model: Model,
    free: Sequence[FreeParameter],
    datasets: Sequence[Dataset],
    block: float,
    *,
    robust: float | None = 4.0,
) -> Refit:
    """CandidateFit the nominal model and the size of its discrepancy in turn.

    The equations are linearised about the states that a smoother reads from the data, with forces
    large enough to follow them: about the model's own simulation they would be those of another
    motion where the gap is large.
    """
    structure = ModelStructure(model, free, (), datasets, block)
    windows = structure.windows
    linearisation = TrajectoryLinearisation(windows)
    theta = structure.theta({})
    p = structure.problem.all_values(theta)
    centres = windows.starts(p)
    channels = usual_channels(model)
    count = len(channels)
    first = Discrepancy(windows, linearisation.along(p, centres), channels)
    trajectory = linearisation.through(p, _followed(first, centres, p))
    fitting = Discrepancy(windows, trajectory, channels, start_share=0.0)
    starts = centres
    for share in _FIRST_SHARES:
        metric = Metric(fitting, np.full(count, share), robust)
        fit = structure.fit(
            metric, [(theta, starts)], centres=centres, tolerance=0.5, with_evidence=False
        )
        theta, starts = fit.theta, fit.starts
    followed = _followed(
        replace(first, trajectory=linearisation.along(structure.problem.all_values(theta), starts)),
        starts,
        structure.problem.all_values(theta),
    )
    trajectory = linearisation.through(structure.problem.all_values(theta), followed)
    fitting = Discrepancy(windows, trajectory, channels, start_share=0.0)
    shares = np.full(count, _FIRST_SHARES[-1])
    for _ in range(3):
        before = shares
        shares = likely_shares(fitting, structure.residuals(fit), shares)
        metric = Metric(fitting, shares, robust)
        fit = structure.fit(metric, [(fit.theta, fit.starts)], centres=centres)
        if np.max(np.abs(np.log(shares / before))) < 0.1:
            break
    return Refit(structure, unfitted(structure, fit, metric, centres), fit, metric, centres)


def unfitted(
    structure: ModelStructure, fit: CandidateFit, metric: Metric, centres: FloatArray
) -> CandidateFit:
    """The model with its parameters as they were: only the windows' starts are fitted."""
    theta = structure.theta({})
    held = fixed_parameters(structure, theta)
    return held.fit(metric, [(theta, fit.starts), (theta, centres)], centres=centres)


def fixed_parameters(structure: ModelStructure, theta: FloatArray) -> ModelStructure:
    """The structure with its parameters held."""
    import copy

    held = copy.copy(structure)
    free = tuple(
        replace(p, lower=float(v), upper=float(v))
        for p, v in zip(structure.problem.free, theta, strict=True)
    )
    held.problem = replace(structure.problem, free=free)
    return held


def own_metric(
    structure: ModelStructure, fit: CandidateFit, metric: Metric, centres: FloatArray
) -> tuple[CandidateFit, Metric]:
    """A structure refitted with the discrepancy that is most likely for itself."""
    for _ in range(2):
        shares = likely_shares(metric.discrepancy, structure.residuals(fit), metric.shares)
        change = np.max(np.abs(np.log(shares / metric.shares)))
        metric = Metric(metric.discrepancy, shares, metric.robust)
        fit = structure.fit(
            metric, [(fit.theta, fit.starts)], centres=centres, iterations=6, tolerance=0.2
        )
        if change < 0.1:
            break
    return fit, metric


def _followed(discrepancy: Discrepancy, starts: FloatArray, p: FloatArray) -> FloatArray:
    """States that follow the data, (m, c, n)."""
    r = discrepancy.windows.target - discrepancy.trajectory.y
    r = np.where(np.isfinite(r), r, 0.0)
    shares = np.full(len(discrepancy.channels), 0.5)
    x, _ = discrepancy.smoothed(shares, r)
    n = discrepancy.trajectory.x.shape[-1]
    followed: FloatArray = discrepancy.trajectory.x + x[..., :n]
    return followed
