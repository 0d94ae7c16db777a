"""How sure: from scores to probabilities that mean what they say.

A nat of a likelihood is not a nat of belief: the real discrepancy is not Gaussian, and of forty
suspects one fits best by chance. With ``x`` the held-out score of a competitor above the refit's
(each in the discrepancy that suits it) and ``R`` the nats that it owes to discrepancies larger than
those of rigs without a gap, beliefs are proportional to the exponentials of

    no effect              −γ log(1 + R₀/ρ)
    effects                β x − γ log(1 + R/ρ) R/(R₀ + ρ) − κ·(effects) − κ′·(further sizes)
    none of these          β x* − κ*                     x* the best competitor's

and belief in no effect is divided between "no gap" and "parameters only" by a logistic function of
what the refit gained. The constants are fitted to development rigs whose truth is known, built by
other code than the models (``calibration.json``, with the command that makes it again).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Constants of the beliefs."""

    #: Error of each equation of a rig without a gap, as a share of what acts there
    usual_shares: Mapping[str, float] = field(default_factory=dict)
    temperature: float  #: β, belief per nat
    rest_weight: float  #: γ and ρ, nats
    rest_scale: float  #: γ and ρ, nats
    #: ``entrance``, ``shape``, ``unnamed``: κ, κ′ and κ*: of two laws that explain the same, the
    #: one with fewer sizes
    entrance: float
    shape: float
    unnamed: float
    #: ``parameters_slope``, ``parameters_centre``: Of the logistic function, in the logarithm of
    #: one plus the refit's gain in nats
    parameters_slope: float
    parameters_centre: float
    command: str = ""  #: That makes the file again

    def usual(self, location: str) -> float:
        """Error of an equation of a rig without a gap."""
        return self.usual_shares.get(location, max(self.usual_shares.values(), default=0.03))


@dataclass(frozen=True, kw_only=True)
class Features:
    """What a diagnosis knows before it believes anything; scores by block add up."""

    gained: float  #: Score of the refit above the model as it was, nats
    behind: float  #: Nats that the refit owes to discrepancies beyond the usual
    names: tuple[tuple[str, ...], ...]  #: Effects of each competitor
    scores: FloatArray  #: (k,) array; held-out score above the refit's, nats
    behinds: FloatArray  #: (k,) array; as ``behind``, of each competitor
    sizes: FloatArray  #: (k,) array; number of sizes that each competitor's effects have

    def as_json(self) -> dict[str, Any]:
        """Plain, for the calibration."""
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(self).items()}


@cache
def calibration() -> Calibration:
    """The package's."""
    text = (files("trms_cli.gap") / "calibration.json").read_text(encoding="utf-8")
    return Calibration(**json.loads(text))


def beliefs(features: Features, constants: Calibration) -> dict[tuple[str, ...], float]:
    """Probability of each competitor, and of ``no_gap``, ``parameters_only``, ``none_of_these``."""
    c = constants

    def rest(behind: float | FloatArray) -> Any:
        return c.rest_weight * np.log1p(np.maximum(behind, 0.0) / c.rest_scale)

    scores = np.asarray(features.scores, dtype=float)
    finite = np.isfinite(scores)
    count = np.array([len(n) for n in features.names])
    logits: dict[tuple[str, ...], float] = {("no_effect",): -float(rest(features.behind))}
    left = np.maximum(np.asarray(features.behinds), 0.0)
    # a cause is not blamed for a hundredth of the gap: no law is exactly that of the rig
    share = np.minimum(left / (max(features.behind, 0.0) + c.rest_scale), 1.0)
    of_effects = c.temperature * scores - rest(left) * share - c.entrance * count
    of_effects = of_effects - c.shape * (np.asarray(features.sizes) - count)
    for name, logit, fine in zip(features.names, of_effects, finite, strict=True):
        if fine:
            logits[name] = float(logit)
    best = float(np.max(scores[finite], initial=0.0))
    logits["none_of_these",] = c.temperature * max(best, 0.0) - c.unnamed
    top = max(logits.values())
    weights = {name: float(np.exp(logit - top)) for name, logit in logits.items()}
    total = sum(weights.values())
    found = {name: weight / total for name, weight in weights.items()}
    nothing = found.pop(("no_effect",))
    moved = np.log1p(max(features.gained, 0.0)) - np.log1p(c.parameters_centre)
    of_parameters = float(1 / (1 + np.exp(-c.parameters_slope * 10 * moved)))
    found["no_gap",] = nothing * (1 - of_parameters)
    found["parameters_only",] = nothing * of_parameters
    return dict(sorted(found.items(), key=lambda item: -item[1]))
