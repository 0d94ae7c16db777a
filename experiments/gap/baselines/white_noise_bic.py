"""Bayesian information criterion on white-noise simulation error: the textbook's model choice."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from experiments.gap.baselines.baseline import diagnosis, places
from experiments.gap.baselines.fits import parts_of
from experiments.gap.baselines.white_noise import Competitor, compete, with_deviations
from trms_cli.gap.candidates import applicable_candidates
from trms_cli.gap.diagnosis import Cause, Diagnosis, Verdict
from trms_cli.gap.problem import GapProblem
from trms_cli.gap.shrinkage import measure_shrinkage

#: Causes of less probability are not told.
_TOLD = 1e-6
_VERDICTS: dict[tuple[str, ...], Verdict] = {
    ("no_gap",): "no_gap",
    ("parameters_only",): "parameters_only",
}


@dataclass(frozen=True, kw_only=True)
class WhiteNoiseBic:
    """Each candidate fitted with the nominal parameters; ``exp(−BIC/2)`` are the probabilities."""

    name: ClassVar[str] = "white_noise_bic"

    def answer(self, problem: GapProblem) -> Diagnosis:
        """See :class:`~experiments.gap.baselines.baseline.Baseline`."""
        begun = time.perf_counter()
        parts = parts_of(problem)
        nominal = compete(problem, parts, (), None)
        field: dict[tuple[str, ...], Competitor] = {
            ("no_gap",): compete(problem, parts, (), nominal, held=True),
            ("parameters_only",): nominal,
        }
        found, _ = applicable_candidates(problem.model, problem.candidates)
        for name, candidate in found.items():
            # A force that noise drives has no simulation to be compared with.
            if not candidate.stochastic:
                field[(name,)] = compete(problem, parts, (candidate,), nominal)
        fitted = time.perf_counter() - begun
        ranked = sorted(field.items(), key=lambda item: item[1].bic)
        weights = np.exp([-(entry.bic - ranked[0][1].bic) / 2 for _, entry in ranked])
        probability = (weights / weights.sum()).tolist()
        best, winner = ranked[0][0], with_deviations(ranked[0][1], problem, parts)
        ranked[0] = (best, winner)
        share = 1 - float(np.mean((winner.residual_sd / nominal.residual_sd) ** 2))
        return diagnosis(
            problem,
            _VERDICTS.get(best, "effect"),
            [
                Cause(effects=effects, probability=p, parameters=entry.fit.sizes())
                for (effects, entry), p in zip(ranked, probability, strict=True)
                if p > _TOLD
            ],
            measure_shrinkage(problem, parts, problem.model, nominal.fit.model, winner.fit.model),
            where=places(winner.chosen, float(np.clip(share, 0.0, 1.0))),
            parameters=winner.fit.nominal(),
            refit=nominal.fit.values,
            sentence=f"{', '.join(best)} has the lowest BIC on white-noise simulation error.",
            seconds={"fits": fitted, "all": time.perf_counter() - begun},
        )
