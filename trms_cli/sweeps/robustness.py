"""What many runs with drawn parameters say: failures, quantiles, and which parameter matters.

Everything is told by group: one combination of the choices (``controller=pid``), over all draws,
each the mean over the values of ``seed``. All groups have seen the same draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trms_cli.sweeps.figures import MERIT, canonical_all, canonical_limits, figure_of, unit_of
from trms_cli.sweeps.space import RunResult, Space, SweepPoint

#: Of the intervals of shares and of what is called a correlation.
CONFIDENCE = 0.95
_QUANTILES = {"q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}
_PERCENTILES = np.linspace(0, 1, 101)
#: Fewer runs say nothing of a correlation.
_FEWEST = 8
#: A choice that repeats a run and distinguishes nothing.
_REPEATS = "seed"


@dataclass(frozen=True)
class Robustness:
    """What is to be told."""

    #: Names of figures, as ``trms runs`` has them; those that the runs do not have are left out
    figures: tuple[str, ...] = ()
    #: Largest allowed value of some figures: a run beyond one is a failure
    limits: Mapping[str, float] = field(default_factory=dict)

    def checked(self) -> Robustness:
        """The same with the names that scores have.

        Raises ConfigurationError for a figure that runs do not have.
        """
        return Robustness(
            canonical_all(self.figures, "sampler.figures"),
            canonical_limits(self.limits, "sampler.limits"),
        )

    def told(
        self, space: Space, points: Sequence[SweepPoint], results: Mapping[int, RunResult]
    ) -> dict[str, Any]:
        """Statistics of each group, JSON data.

        ``points``: those that have results; interrupted ones are left out.
        """
        ended = [p for p in points if results[p.number].state != "interrupted"]
        names = [n for n in self.figures if any(_has(results[p.number], n) for p in ended)]
        if not names and any(_has(results[p.number], MERIT) for p in ended):
            names = [MERIT]
        shown = [c.key for c in space.choices if c.key != _REPEATS and len(c.values) > 1]
        groups: dict[tuple[str, ...], list[SweepPoint]] = {}
        for point in ended:
            groups.setdefault(tuple(str(point.values[key]) for key in shown), []).append(point)
        told = [
            {"choices": dict(zip(shown, values, strict=True))}
            | self._of_group(space, members, results, names)
            for values, members in groups.items()
        ]
        if len(told) > 1:
            for name in names:
                shares = _best_shares(space, list(groups.values()), results, name)
                for group, share in zip(told, shares, strict=True):
                    if name in group["figures"]:
                        group["figures"][name]["best_share"] = share
        return {
            "kind": "robustness",
            "confidence": CONFIDENCE,
            "varied": [varied.key for varied in space.continuous],
            "figures": {name: {"unit": unit_of(name)} for name in names},
            "limits": dict(self.limits),
            "groups": told,
        }

    def _of_group(
        self,
        space: Space,
        points: Sequence[SweepPoint],
        results: Mapping[int, RunResult],
        names: Sequence[str],
    ) -> dict[str, Any]:
        lost = sum(results[p.number].state == "lost" for p in points)
        draws: dict[tuple[Any, ...], list[RunResult]] = {}
        for point in points:
            if results[point.number].state != "lost":
                drawn = tuple(point.values[varied.key] for varied in space.continuous)
                draws.setdefault(drawn, []).append(results[point.number])
        # Runs of one draw are not independent: what is counted are draws.
        failed = {drawn for drawn, own in draws.items() if any(r.state != "done" for r in own)}
        beyond = {
            name: {
                drawn
                for drawn, own in draws.items()
                if drawn not in failed and any(_beyond(figure_of(r, name), bound) for r in own)
            }
            for name, bound in self.limits.items()
        }
        count = len(failed.union(*beyond.values()))
        failures: dict[str, Any] = {
            "draws": len(draws),
            "count": count,
            "failed_runs": len(failed),
            "beyond": {name: len(members) for name, members in beyond.items()},
        }
        figures = {name: _of_draws(draws, name) for name in names}
        return {
            "runs": sum(map(len, draws.values())),
            "lost": lost,
            "failures": failures | _share(count, len(draws)),
            "figures": {
                name: _distribution(np.array(list(found.values())))
                for name, found in figures.items()
                if found
            },
            "sensitivity": _sensitivity(space, figures),
        }


def _of_draws(
    draws: Mapping[tuple[Any, ...], Sequence[RunResult]], name: str
) -> dict[tuple[Any, ...], float]:
    """A figure of each draw, the mean over its runs; without those of which none has it."""
    found = {}
    for drawn, own in draws.items():
        values = [value for r in own if (value := figure_of(r, name)) is not None]
        if values:
            found[drawn] = float(np.mean(values))
    return found


def _has(result: RunResult, name: str) -> bool:
    return figure_of(result, name) is not None


def _beyond(figure: float | None, bound: float) -> bool:
    """What has no figure to be judged by (a step that never settled) does not hold the limit."""
    return figure is None or figure > bound


def _share(count: int, runs: int) -> dict[str, float | None]:
    """A share with its Clopper-Pearson interval, which holds at least its confidence."""
    from scipy.stats import binomtest

    if not runs:
        return {"share": None, "low": None, "high": None}
    interval = binomtest(count, runs).proportion_ci(CONFIDENCE, method="exact")
    return {"share": count / runs, "low": float(interval.low), "high": float(interval.high)}


def _distribution(values: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, Any]:
    return {
        "draws": int(values.size),
        "mean": float(values.mean()),
        "sd": float(values.std(ddof=1)) if values.size > 1 else None,
        "min": float(values.min()),
        **{name: float(np.quantile(values, share)) for name, share in _QUANTILES.items()},
        "max": float(values.max()),
        "percentiles": [float(q) for q in np.quantile(values, _PERCENTILES)],
    }


def _sensitivity(
    space: Space, figures: Mapping[str, Mapping[tuple[Any, ...], float]]
) -> list[dict[str, Any]]:
    """Spearman's rank correlation of each drawn value with each figure, strongest first.

    ``p`` is adjusted for their number (Benjamini and Hochberg): of those called correlated by
    p < 0.05 at most one in twenty is expected not to be.
    """
    from scipy.stats import false_discovery_control, spearmanr

    found: list[dict[str, Any]] = []
    for name, told in figures.items():
        if len(told) < _FEWEST or np.ptp(list(told.values())) == 0:
            continue
        drawn = np.array(list(told), dtype=float)
        for column, varied in enumerate(space.continuous):
            if np.ptp(drawn[:, column]) > 0:
                rho, p = spearmanr(drawn[:, column], list(told.values()))
                found.append({"key": varied.key, "figure": name, "rho": float(rho), "p": float(p)})
    if found:
        adjusted = false_discovery_control([each["p"] for each in found])
        for each, p in zip(found, adjusted, strict=True):
            each["p"] = float(p)
    return sorted(found, key=lambda each: -abs(each["rho"]))


def _best_shares(
    space: Space,
    groups: Sequence[Sequence[SweepPoint]],
    results: Mapping[int, RunResult],
    name: str,
) -> list[float | None]:
    """Share of the samples on which each group has the smallest figure; failures lose."""
    keys = [varied.key for varied in space.continuous] + [_REPEATS]
    tables = [
        {tuple(p.values.get(key) for key in keys): figure_of(results[p.number], name) for p in each}
        for each in groups
    ]
    shared = set(tables[0]).intersection(*tables[1:])
    wins = [0] * len(groups)
    contested = 0
    for sample in shared:
        row = [table[sample] for table in tables]
        present = [value for value in row if value is not None]
        if present:
            contested += 1
            wins[row.index(min(present))] += 1
    return [win / contested if contested else None for win in wins]
