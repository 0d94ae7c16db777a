"""The parameters did it: a refit within the priors, and nothing else."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

from experiments.gap.baselines.baseline import diagnosis
from experiments.gap.baselines.fits import parts_of, refit
from trms_cli.gap.diagnosis import Cause, DiagnosisResult
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.shrinkage import measure_shrinkage


@dataclass(frozen=True, kw_only=True)
class ParameterRefit:
    """Maximum a posteriori fit of the nominal parameters; there is never an effect."""

    name: ClassVar[str] = "parameter_refit"

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        start_time = time.perf_counter()
        parts = parts_of(problem)
        fit = refit(problem, parts)
        measured = measure_shrinkage(problem, parts, problem.model, fit.model, fit.model)
        return diagnosis(
            problem,
            "parameters_only",
            [Cause(effects=("parameters_only",), probability=1.0)],
            measured,
            parameters=fit.nominal(),
            refit=fit.values,
            sentence="The nominal parameters were refitted; nothing else was considered.",
            seconds={"all": time.perf_counter() - start_time},
        )
