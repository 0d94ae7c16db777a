"""Those who know the key: the reference of a shrink, and of what a name can be worth at all.

The oracle knows which effects the rig has, and fits them. What no candidate stands for (an effect
outside the library) it cannot add; then it is a refit. A second one knows the values as well, and
fits nothing.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from experiments.gap.baselines.baseline import diagnosis, places
from experiments.gap.baselines.fits import parts_of, refit
from experiments.gap.baselines.white_noise import fit_with
from trms_cli.gap.diagnosis import (
    Cause,
    DiagnosisResult,
    FittedParameter,
    SizeEstimate,
    Verdict,
)
from trms_cli.gap.problem import CandidateEffect, GapProblem, applicable_candidates, joint
from trms_cli.gap.shrinkage import measure_shrinkage
from trms_cli.identification.problem import with_values


@dataclass(frozen=True, kw_only=True)
class RigTruth:
    """What the key says of a rig."""

    effects: tuple[str, ...] = ()
    #: Of parameters and of the effects' sizes (``<effect>.<size>``), by name, SI units
    values: Mapping[str, float] = field(default_factory=dict)


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
        selected_candidates = _selected(self.effects, problem)
        verdict, effects = _answer(self.effects, selected_candidates)
        fit = fit_with(problem, parts, selected_candidates) if selected_candidates else plain
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


@dataclass(frozen=True, kw_only=True)
class TrueValues:
    """The rig's effects, their sizes and its parameters are known; the laws are the library's.

    What is left is what the rig's own laws and its nuisances do otherwise, which a fit may take up.
    """

    truth: RigTruth

    name: ClassVar[str] = "true_values"

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        start_time = time.perf_counter()
        parts = parts_of(problem)
        plain = refit(problem, parts)
        selected_candidates = _selected(self.truth.effects, problem)
        verdict, effects = _answer(self.truth.effects, selected_candidates)
        model = joint(problem.model, selected_candidates) if selected_candidates else problem.model
        known_values = {n: v for n, v in self.truth.values.items() if n in model.parameters}
        model = with_values(model, known_values)
        nominal, sizes = {}, {}
        for parameter in model.parameters:
            if parameter.name in problem.model.parameters:
                nominal[parameter.name] = FittedParameter(
                    prior=problem.model.parameters[parameter.name].value,
                    fitted=parameter.value,
                    sd=0.0,
                    unit=parameter.unit,
                    moved=None,
                )
            else:
                sizes[parameter.name] = SizeEstimate(
                    value=parameter.value, sd=0.0, unit=parameter.unit
                )
        return diagnosis(
            problem,
            verdict,
            [Cause(effects=effects, probability=1.0, parameters=sizes)],
            measure_shrinkage(problem, parts, problem.model, plain.model, model),
            where=places(selected_candidates, 1.0),
            parameters=nominal,
            refit=plain.values,
            sentence="The effects, their sizes and the parameters were known.",
            seconds={"all": time.perf_counter() - start_time},
        )


def _selected(effects: tuple[str, ...], problem: GapProblem) -> list[CandidateEffect]:
    candidates, _ = applicable_candidates(problem.model, problem.candidates)
    return [candidates[name] for name in effects if name in candidates]


def _answer(
    effects: tuple[str, ...], selected_candidates: list[CandidateEffect]
) -> tuple[Verdict, tuple[str, ...]]:
    """Verdict, and the effects of the only cause."""
    if selected_candidates:
        return "effect", tuple(candidate.name for candidate in selected_candidates)
    if effects:
        return "none_of_these", ("none_of_these",)
    return "parameters_only", ("parameters_only",)
