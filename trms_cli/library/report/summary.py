"""What a sweep that drew or searched says of itself in its ``sweep.json``, as a report takes it.

The file may be of another version, of another program, or a stranger's: whatever is not as
expected is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar

import msgspec

if TYPE_CHECKING:
    from trms_cli.reporting.sweep_report import Draws, Objective, SweepRun

_T = TypeVar("_T")
_MOST, _MOST_TRIALS = 10_000, 100_000


def drawn_keys(plan: Mapping[str, Any]) -> list[str]:
    """Keys whose values were drawn, the most strongly correlated ones first; none of a search."""
    if search_of(plan):
        return []
    keys = [
        str(each["key"])
        for each in _mappings(_part(plan, "space").get("continuous"))
        if isinstance(each.get("key"), str)
    ]
    strength = dict.fromkeys(keys, 0.0)
    for _, group in _groups(plan):
        for each in _mappings(group.get("sensitivity")):
            key, rho = each.get("key"), each.get("rho")
            if isinstance(key, str) and key in strength and _is_number(rho):
                strength[key] = max(strength[key], abs(rho))
    return sorted(strength, key=lambda key: -strength[key])


def draws_of(plan: Mapping[str, Any], names: Mapping[str, str]) -> Draws | None:
    """Failures and correlations over draws; None of a sweep that drew nothing.

    `plan`: ``sweep.json``. `names`: what the drawn keys are called on the page.
    """
    from trms_cli.reporting.sweep_report import Correlation, Draws, FailureShare

    if not names:
        return None
    failures, correlations = [], []
    for who, group in _groups(plan):
        failures += _converted([group.get("failures")], FailureShare, who=who)
        correlations += [
            replace(each, key=names[each.key], figure=bench_name(each.figure))
            for each in _converted(group.get("sensitivity"), Correlation, who=who)
            if each.key in names and math.isfinite(each.rho)
        ]
    return Draws(
        keys=list(names.values()),
        limits=_numbers(_part(_robustness(plan), "limits")),
        failures=failures,
        correlations=sorted(correlations, key=lambda each: -abs(each.rho)),
    )


def short_names(draw_keys: Sequence[str], others: Sequence[str]) -> dict[str, str]:
    """What drawn keys are called on a page: short, and not as another key is."""
    from trms_cli.sweeps.space import short_keys

    return {
        key: key if short in others else short for key, short in short_keys(list(draw_keys)).items()
    }


def search_of(plan: Mapping[str, Any]) -> Mapping[str, Any]:
    """The part of a sweep's document that has objectives; empty for a sweep that seeks nothing."""
    inner = [plan, *(value for value in plan.values() if isinstance(value, Mapping))]
    searches = [each for each in inner if isinstance(each.get("objectives"), list)]
    # The settings of the search name its objectives too, before anything was found.
    return next((each for each in searches if "pareto" in each), searches[0] if searches else {})


def objectives_of(words: Mapping[str, Any]) -> list[Objective]:
    """What is sought: names, or mappings with a name and a direction."""
    from trms_cli.reporting.sweep_report import Objective

    objectives = []
    for each in words.get("objectives", ()):
        entry: Mapping[str, Any] = each if isinstance(each, Mapping) else {"name": each}
        name = next((entry[k] for k in ("name", "figure") if isinstance(entry.get(k), str)), "")
        if name:
            objectives.append(
                Objective(bench_name(name), str(entry.get("direction", "")).startswith("max"))
            )
    return objectives


def pareto_of(words: Mapping[str, Any]) -> list[int]:
    """Numbers of the best trials."""
    numbers = words.get("pareto")
    return [n for n in numbers if isinstance(n, int)] if isinstance(numbers, list) else []


def trials_of(words: Mapping[str, Any]) -> list[SweepRun]:
    """What was tried, with the figures over all conditions of a trial."""
    from trms_cli.reporting.sweep_report import SweepRun

    trials = []
    for each in _mappings(words.get("trials"), _MOST_TRIALS):
        if not isinstance(each.get("trial"), int):
            continue
        problem = str(each.get("problem") or "")
        ended = "completed" if each.get("allowed", True) else "beyond a limit"
        values = _part(each, "values").items()
        plain = (str, int, float, type(None))
        trials.append(
            SweepRun(
                name=str(each["trial"]),
                number=each["trial"],
                outcome="failed" if problem else ended,
                values={str(k): v if isinstance(v, plain) else str(v) for k, v in values},
                figures=_numbers(_part(each, "figures")),
                problem=problem,
            )
        )
    return trials


def history_of(words: Mapping[str, Any]) -> list[float | None]:
    """After each trial the best so far."""
    history = words.get("history")
    if not isinstance(history, list):
        return []
    return [float(value) if _is_number(value) else None for value in history[:_MOST_TRIALS]]


def bench_name(name: str) -> str:
    """A figure as it is called at the bench: ``rmse_yaw`` for ``rmse_alpha_h``."""
    from trms_cli.runs.columns import ALIASES

    return next(
        (alias for alias, figure in ALIASES.items() if figure == name and "." not in alias), name
    )


def _robustness(plan: Mapping[str, Any]) -> Mapping[str, Any]:
    summary = _part(plan, "summary")
    return summary if summary.get("kind") == "robustness" else {}


def _groups(plan: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Who was drawn for, in words, and what came of it."""
    for group in _mappings(_robustness(plan).get("groups")):
        labels = [
            str(value) if "." not in str(key) and str(key) != "seed" else f"{key}={value}"
            for key, value in _part(group, "choices").items()
        ]
        yield " + ".join(labels) or "all", group


def _converted(value: Any, kind: type[_T], **more: Any) -> list[_T]:
    """Those of a list that are as a dataclass wants them."""
    records = []
    for each in _mappings(value):
        with suppress(msgspec.ValidationError):
            records.append(msgspec.convert({**each, **more}, kind))
    return records


def _numbers(figures: Mapping[str, Any]) -> dict[str, float]:
    """Figures by their names at the bench."""
    return {bench_name(str(k)): float(v) for k, v in figures.items() if _is_number(v)}


def _part(owner: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    part = owner.get(key)
    return part if isinstance(part, Mapping) else {}


def _mappings(value: Any, most: int = _MOST) -> list[Mapping[str, Any]]:
    if not isinstance(value, list):
        return []
    return [each for each in value[:most] if isinstance(each, Mapping)]


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
