"""Beliefs held against truths that nothing was fitted to: folds, losses, reliability by stratum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.cases import Case
from experiments.gap.blind.statistics import (
    Estimate,
    Reliability,
    bootstrapped,
    calibration_error,
    reliability,
    share,
)

IntArray = npt.NDArray[np.int64]
CaseFeatures = TypeVar("CaseFeatures")
Constants = TypeVar("Constants")
Causes = tuple[str, ...]
Belief = Mapping[Causes, float]

#: Belief that is always left for what was not thought of.
LEAST = 1e-3
#: What is said with this probability and more should be right nearly always.
VERY_SURE = 0.9
#: s. Bounds of the classes of durations.
DURATIONS = ((20, 60), (60, 150), (150, 600))
_DRAWS = 500


@dataclass(frozen=True)
class Judged:
    """How far beliefs can be believed."""

    count: int
    log_loss: Estimate  #: nats a case
    calibration_error: Estimate  #: Of the likeliest cause
    right: Estimate  #: Share of likeliest causes that are right
    very_sure: Estimate  #: Share right of those that are told with :data:`VERY_SURE` and more
    reliability: Reliability


def folds_of(cases: Sequence[Case], number: int, seed: int = 0) -> IntArray:
    """Fold of each case, (n,): kinds spread evenly, twins and what is dealt with them together."""
    random = np.random.default_rng(seed)
    fold = np.empty(len(cases), dtype=int)
    groups: dict[str, dict[tuple[int, int], list[int]]] = {}
    for i, case in enumerate(cases):
        key = (0, i) if not case.twin else (case.twin, case.excitation)
        groups.setdefault(case.kind, {}).setdefault(key, []).append(i)
    offset = 0
    for kind in sorted(groups):
        members = list(groups[kind].values())
        for place, at in enumerate(random.permutation(len(members))):
            fold[members[at]] = (place + offset) % number
        offset += len(members)
    return fold


def cross_validated(
    features: Sequence[CaseFeatures],
    rights: Sequence[frozenset[Causes]],
    folds: IntArray,
    fit: Callable[[Sequence[tuple[CaseFeatures, frozenset[Causes]]]], Constants],
    believe: Callable[[CaseFeatures, Constants], Belief],
) -> list[Belief]:
    """Belief of each case by constants that were fitted to the other folds.

    Parameters
    ----------
    features : sequence
        What is known of each case before anything is believed.
    rights : sequence of frozenset
        Causes that are right, of each case.
    folds : (n,) array
        As of :func:`folds_of`.
    fit : callable
        Constants from pairs of what is known and what is right.
    believe : callable
        Probabilities of causes from what is known and constants.
    """
    beliefs: list[Belief] = [{}] * len(features)
    for fold in np.unique(folds):
        inside = [(features[i], rights[i]) for i in np.flatnonzero(folds != fold).tolist()]
        constants = fit(inside)
        for i in np.flatnonzero(folds == fold).tolist():
            beliefs[i] = believe(features[i], constants)
    return beliefs


def judged(beliefs: Sequence[Belief], rights: Sequence[frozenset[Causes]]) -> Judged:
    """Log loss, calibration and reliability of beliefs."""
    first = [max(belief.items(), key=lambda item: item[1]) for belief in beliefs]
    probabilities = np.array([p for _, p in first])
    hit = np.array([name in right for (name, _), right in zip(first, rights, strict=True)])
    of_truth = np.array(
        [
            sum(belief.get(name, 0.0) for name in right)
            for belief, right in zip(beliefs, rights, strict=True)
        ]
    )
    losses = -np.log(LEAST + (1 - LEAST) * of_truth)
    n = len(beliefs)
    return Judged(
        count=n,
        log_loss=bootstrapped(lambda some: float(losses[some].mean()), n, _DRAWS, 0),
        calibration_error=bootstrapped(
            lambda some: calibration_error(probabilities[some], hit[some]), n, _DRAWS, 0
        ),
        right=share(hit.tolist()),
        very_sure=share(hit[probabilities >= VERY_SURE].tolist()),
        reliability=reliability(probabilities.tolist(), hit.tolist()),
    )


def strata_of(cases: Sequence[Case]) -> dict[str, IntArray]:
    """Cases of each stratum by its name: all, durations, loops, channels, kinds."""
    tests: dict[str, Callable[[Case], bool]] = {"all": lambda case: True}
    for low, high in DURATIONS:
        tests[f"{low} to {high} s"] = _lasts(low, high)
    tests |= {
        "open loop": lambda case: case.drive != "closed_loop",
        "closed loop": lambda case: case.drive == "closed_loop",
        "four channels": lambda case: case.channels == "four",
        "two channels": lambda case: case.channels == "angles",
    }
    for kind in sorted({case.kind for case in cases}):
        tests[kind] = _is(kind)
    strata = {
        name: np.flatnonzero([test(case) for case in cases]).astype(int)
        for name, test in tests.items()
    }
    return {name: members for name, members in strata.items() if len(members)}


def _lasts(low: float, high: float) -> Callable[[Case], bool]:
    return lambda case: low <= case.duration < high or case.duration == high == DURATIONS[-1][1]


def _is(kind: str) -> Callable[[Case], bool]:
    return lambda case: case.kind == kind


def tables(
    cases: Sequence[Case],
    rights: Sequence[frozenset[Causes]],
    compared: Mapping[str, Sequence[Belief]],
) -> str:
    """Markdown: beliefs side by side by stratum, then the reliability of each.

    ``compared``: beliefs of every case, by what they are called.
    """
    lines = [
        "| stratum | cases | belief | log loss | calibration error | right | "
        f"right of p ≥ {VERY_SURE} |",
        "|---|---|---|---|---|---|---|",
    ]
    strata = strata_of(cases)
    for name, members in strata.items():
        for called, beliefs in compared.items():
            scores = judged(
                [beliefs[i] for i in members.tolist()], [rights[i] for i in members.tolist()]
            )
            figures = (scores.log_loss, scores.calibration_error, scores.right, scores.very_sure)
            cells = [name, str(scores.count), called, *map(_figure, figures)]
            lines.append(f"| {' | '.join(cells)} |")
    for called, beliefs in compared.items():
        lines += ["", f"Reliability, {called}:", "", "| told | mean | right | cases |"]
        lines.append("|---|---|---|---|")
        for row in judged(beliefs, rights).reliability.bins:
            lines.append(_bin(row))
    return "\n".join(lines) + "\n"


def sure_and_wrong(
    names: Sequence[str],
    cases: Sequence[Case],
    rights: Sequence[frozenset[Causes]],
    beliefs: Sequence[Belief],
) -> str:
    """Markdown: answers of :data:`VERY_SURE` and more that are not right, a line each."""
    lines = ["| rig | kind | has | likeliest | p |", "|---|---|---|---|---|"]
    for name, case, right, belief in zip(names, cases, rights, beliefs, strict=True):
        cause, probability = max(belief.items(), key=lambda item: item[1])
        if probability >= VERY_SURE and cause not in right:
            has = " + ".join(case.effects) or "–"
            cells = (name, case.kind, has, " + ".join(cause), f"{probability:.2f}")
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _figure(e: Estimate) -> str:
    if e.value is None:
        return "–"
    if e.low is None or e.high is None:
        return f"{e.value:.3f} ({e.count})"
    return f"{e.value:.3f} [{e.low:.3f}, {e.high:.3f}]"


def _bin(row: Mapping[str, Any]) -> str:
    low, high = row["right_ci95"]
    cells = (
        f"{row['low']:.1f} to {row['high']:.1f}",
        f"{row['predicted']:.3f}",
        f"{row['right']:.3f} [{low:.3f}, {high:.3f}]",
        str(row["count"]),
    )
    return f"| {' | '.join(cells)} |"
