"""How far the gap shrinks, on the part of the recordings that nothing was chosen on."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.gap.answer.belief import Believed
from trms_cli.gap.blocks import Parts
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.race.contest import Contest
from trms_cli.gap.shrinkage import Measured, measure
from trms_cli.models.model import Model
from trms_cli.simulation.rollout import Rollout

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Far:
    """The opened seal."""

    measured: Measured
    raw: Model  #: As their free runs were made
    refit: Model  #: As their free runs were made
    corrected: Model  #: As their free runs were made
    plain: Rollout  #: Of the first two, and of the last
    richer: Rollout  #: Of the first two, and of the last


def how_far(problem: GapProblem, parts: Parts, raced: Contest, believed: Believed) -> Far:
    """Free runs of the model as it was, refitted, and corrected."""
    refit = raced.refit
    fitted = with_values(problem.model, refit.contestant.values(refit.fit.theta))
    corrected = fitted
    plain = richer = refit.contestant.windows.rollout
    if believed.corrected is not None:
        entry = believed.corrected
        corrected = with_values(
            entry.contestant.problem.model, entry.contestant.values(entry.fit.theta)
        )
        richer = entry.contestant.windows.rollout
    measured = measure(problem, parts, problem.model, fitted, corrected, (plain, richer))
    return Far(measured, problem.model, fitted, corrected, plain, richer)


def with_values(model: Model, values: Mapping[str, float]) -> Model:
    """The same model with other values of some parameters."""
    other = copy.copy(model)
    other.parameters = model.parameters.replaced(dict(values), where="parameters")
    return other
