"""The oracle: it knows which effects the rig has, and only fits them. The reference of a shrink.

What no candidate stands for (an effect outside the library) it cannot add; then it is a refit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

from experiments.gap.baselines.baseline import diagnosis, places
from experiments.gap.baselines.fits import parts_of, refit
from experiments.gap.baselines.white_noise import fit_with
from trms_cli.gap.diagnosis import Cause, DiagnosisResult, Verdict
from trms_cli.gap.problem import GapProblem, applicable_candidates
from trms_cli.gap.shrinkage import measure_shrinkage


@dataclass(frozen=True, kw_only=True)
class Oracle:
    """The rig's effects are known, their sizes and the nominal parameters are not."""

    effects: tuple[str, ...]  #: What the rig has; names that are no candidates are passed over

    name: ClassVar[str] = "oracle"

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        start_time = time.perf_counter()
        parts = parts_of(problem)
        plain = refit(problem, parts)
        candidates, _ = applicable_candidates(problem.model, problem.candidates)
        selected_candidates = [candidates[name] for name in self.effects if name in candidates]
        verdict: Verdict = "parameters_only"
        fit, cause = plain, "parameters_only"
        if self.effects and not selected_candidates:
            verdict, cause = "none_of_these", "none_of_these"
        effects: tuple[str, ...] = (cause,)
        if selected_candidates:
            fit = fit_with(problem, parts, selected_candidates)
            verdict, effects = "effect", tuple(s.name for s in selected_candidates)
        return diagnosis(
            problem,
            verdict,
            [Cause(effects=effects, probability=1.0, parameters=fit.sizes())],
            measure_shrinkage(problem, parts, problem.model, plain.model, fit.model),
            where=places(selected_candidates, 1.0),
            parameters=fit.nominal(),
            refit=plain.values,
            sentence="The effects were known, and fitted.",
            seconds={"all": time.perf_counter() - start_time},
        )
