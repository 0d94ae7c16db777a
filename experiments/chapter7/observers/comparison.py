"""Paired comparison: how much larger an observer's error is than another's on the same record."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from experiments.chapter7.observers.records import STATES, Outcome

Verdict = Literal["better", "worse", "even"]


@dataclass(frozen=True)
class Ratio:
    """Geometric mean of the ratio of two errors over records."""

    #: ``mean``, ``low``, ``high``: And its 95 % interval: Student's, of the logarithms
    mean: float
    low: float
    high: float

    @property
    def verdict(self) -> Verdict:
        """Whether the first is better (smaller) for certain."""
        if self.high < 1.0:
            return "better"
        return "worse" if self.low > 1.0 else "even"


@dataclass(frozen=True)
class Cell:
    """All records of a condition."""

    condition: str
    channels: str
    torques: str
    records: int
    rmse: dict[str, dict[str, float]]  #: Median over the records, by observer and state
    ratios: dict[str, dict[str, Ratio]]  #: To the reference observer's, by observer and state
    microseconds: dict[str, float]  #: Median of a step's time, by observer


def ratio_of(errors: Sequence[float], others: Sequence[float]) -> Ratio:
    """How much larger errors are than others of the same records."""
    from scipy.stats import t

    logs = np.log(np.asarray(errors) / np.asarray(others))
    mean, n = float(np.mean(logs)), logs.size
    if n < 2:
        return Ratio(float(np.exp(mean)), 0.0, float("inf"))
    half = float(t.ppf(0.975, n - 1) * np.std(logs, ddof=1) / np.sqrt(n))
    return Ratio(*(float(np.exp(value)) for value in (mean, mean - half, mean + half)))


def cells_of(outcomes: Iterable[Outcome], observers: Sequence[str], against: str) -> list[Cell]:
    """The outcomes by condition, channels and torques, in the order of their coming."""
    groups: dict[tuple[str, str, str], list[Outcome]] = {}
    for outcome in outcomes:
        for channels, torques in outcome.errors:
            groups.setdefault((outcome.job.condition, channels, torques), []).append(outcome)
    cells = []
    for (condition, channels, torques), members in groups.items():
        key = (channels, torques)
        errors = {
            observer: {state: [o.errors[key][observer][state] for o in members] for state in STATES}
            for observer in observers
        }
        cells.append(
            Cell(
                condition,
                channels,
                torques,
                len(members),
                {
                    observer: {state: float(np.median(v)) for state, v in of.items()}
                    for observer, of in errors.items()
                },
                {
                    observer: {
                        state: ratio_of(values, errors[against][state])
                        for state, values in of.items()
                    }
                    for observer, of in errors.items()
                    if observer != against
                },
                {
                    observer: float(np.median([o.microseconds[key][observer] for o in members]))
                    for observer in observers
                },
            )
        )
    return cells


def tally(cells: Iterable[Cell], observer: str) -> dict[Verdict, list[tuple[Cell, str]]]:
    """Where an observer is better than the reference, worse, or even: by cell and state."""
    cells_by_verdict: dict[Verdict, list[tuple[Cell, str]]] = {
        "better": [],
        "worse": [],
        "even": [],
    }
    for cell in cells:
        for state, ratio in cell.ratios[observer].items():
            cells_by_verdict[ratio.verdict].append((cell, state))
    return cells_by_verdict
