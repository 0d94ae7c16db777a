"""Who is best, by how much, and how sure: errors of several models on the same rigs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.gap.page import mean_and_interval


@dataclass(frozen=True)
class Ratio:
    """Errors over others of the same rigs: geometric mean, 95 % interval by Student's t."""

    value: float
    low: float  #: NaN for one rig
    high: float


@dataclass(frozen=True)
class Standing:
    """How a model stands among others."""

    name: str
    mean: float  #: Of its errors, geometric, over the rigs on which it did not break off
    rigs: int  #: On which it was tried
    failures: int  #: Of them those on which it broke off; such a model comes last
    against_first: Ratio  #: Its errors over those of the best that was tried on all rigs
    is_first: bool = False  #: Whether it is that one


def paired_ratio(ones: Sequence[float], others: Sequence[float]) -> Ratio:
    """The errors of one model over those of another, rig by rig; both finite somewhere.

    Rigs on which either is not finite are left out.
    """
    pairs = np.array([ones, others], dtype=float)
    logs = np.diff(np.log(pairs[::-1, np.isfinite(pairs).all(axis=0)]), axis=0)[0]
    if not logs.size:
        return Ratio(float("nan"), float("nan"), float("nan"))
    mean, half = mean_and_interval(logs.tolist())
    low, high = np.exp([mean - half, mean + half])
    return Ratio(float(np.exp(mean)), float(low), float(high))


def rank(errors: Mapping[str, Sequence[float]]) -> list[Standing]:
    """Models from the best to the worst.

    Those that were tried on all rigs are ranked rig by rig; what was tried on some takes its place
    by its ratio to the best of these, on the rigs that both were tried on.

    ``errors``: by model, one of each rig in the same order; infinite where it broke off, NaN where
    it was not tried.
    """
    tried = {name: int(np.sum(~np.isnan(values))) for name, values in errors.items()}
    failures = {name: int(np.sum(np.isinf(values))) for name, values in errors.items()}
    everywhere = [name for name in errors if tried[name] == max(tried.values())]
    first = min(everywhere, key=lambda name: (failures[name], _geometric(errors[name])))
    ratios = {name: paired_ratio(errors[name], errors[first]) for name in errors}

    def place(name: str) -> tuple[int, float]:
        value = ratios[name].value
        return failures[name], value if np.isfinite(value) else float("inf")

    return [
        Standing(n, _geometric(errors[n]), tried[n], failures[n], ratios[n], n == first)
        for n in sorted(errors, key=place)
    ]


def choose(
    standings: Sequence[Standing], effort: Mapping[str, float], level: float
) -> tuple[str, list[str]]:
    """The model to take, and those that are as good as the best.

    As good is what never broke off and errs by at most ``level`` (a share) more than the best in
    the mean; of these the one of least ``effort`` is taken.
    """
    least = min(s.failures for s in standings)
    best = min(s.against_first.value for s in standings if s.failures == least)
    equals = [
        s.name
        for s in standings
        if s.failures == least and s.against_first.value <= (1.0 + level) * best
    ]
    return min(equals, key=lambda name: effort[name]), equals


def _geometric(values: Sequence[float]) -> float:
    present = np.array([v for v in values if np.isfinite(v)])
    return float(np.exp(np.mean(np.log(present)))) if present.size else float("inf")
