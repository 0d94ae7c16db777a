"""What a baseline is, and the form of an answer."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from typing import ClassVar, Protocol, runtime_checkable

import trms_cli
from trms_cli.gap.diagnosis import (
    Cause,
    DiagnosedRecording,
    DiagnosisResult,
    FittedParameter,
    LocationShare,
    Verdict,
)
from trms_cli.gap.problem import CandidateEffect, GapProblem
from trms_cli.gap.shrinkage import Shrinkage
from trms_cli.models.model import names


@runtime_checkable
class Baseline(Protocol):
    """Another way to diagnose."""

    name: ClassVar[str]

    def answer(self, problem: GapProblem) -> DiagnosisResult:
        """Diagnose; the same problem and seed give the same answer."""


def diagnosis(
    problem: GapProblem,
    verdict: Verdict,
    causes: Sequence[Cause],
    measured: Shrinkage,
    *,
    where: Sequence[LocationShare] = (),
    confusable: Sequence[tuple[str, ...]] = (),
    parameters: Mapping[str, FittedParameter] | None = None,
    refit: Mapping[str, float] | None = None,
    sentence: str = "",
    description: Sequence[str] = (),
    seconds: Mapping[str, float] | None = None,
) -> DiagnosisResult:
    """An answer; what is not given is left empty."""
    return DiagnosisResult(
        recordings=tuple(
            DiagnosedRecording(
                file=d.source,
                sha256=d.sha256,
                duration_s=d.duration,
                sample_time_s=d.sample_time,
                channels=names(d.outputs),
            )
            for d in problem.datasets
        ),
        model=problem.model_name,
        seed=problem.seed,
        versions={"trms": trms_cli.__version__, "python": platform.python_version()},
        verdict=verdict,
        where=tuple(where),
        region=(),
        causes=tuple(causes),
        confusable=tuple(confusable),
        not_testable=(),
        detectable={},
        parameters=parameters or {},
        gap=measured.gap,
        shrink=measured.shrink,
        next_experiment=None,
        sentence=sentence,
        description=tuple(description),
        warnings=problem.warnings,
        worse=measured.worse,
        effort=problem.effort,
        seconds=seconds or {},
        refit=refit or {},
    )


def places(candidates: Sequence[CandidateEffect], share: float) -> tuple[LocationShare, ...]:
    """Where named effects act, each with an equal part of a share of the gap."""
    locations = list(
        dict.fromkeys(place for candidate in candidates for place in candidate.locations)
    )
    return tuple(
        LocationShare(location=p, share=share / len(locations), ci95=(0.0, 1.0)) for p in locations
    )
