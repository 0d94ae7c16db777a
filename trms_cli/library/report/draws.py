"""What a sweep over drawn values says of itself in its ``sweep.json``, as a report takes it.

The file may be of another version, of another program, or a stranger's: whatever is not as
expected is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from trms_cli.library.report.search import bench_name, search_of

if TYPE_CHECKING:
    from trms_cli.reporting.reported_sweep import Draws

_MOST = 10_000


def drawn_keys(plan: Mapping[str, Any]) -> list[str]:
    """Keys whose values were drawn, the most strongly correlated ones first; none of a search."""
    if search_of(plan):
        return []
    space = plan.get("space")
    given = space.get("continuous") if isinstance(space, Mapping) else None
    keys = [str(each["key"]) for each in _mappings(given) if isinstance(each.get("key"), str)]
    strength = dict.fromkeys(keys, 0.0)
    for group in _mappings(_summary(plan).get("groups")):
        for each in _mappings(group.get("sensitivity")):
            key, rho = each.get("key"), _number(each.get("rho"))
            if isinstance(key, str) and key in strength and rho is not None:
                strength[key] = max(strength[key], abs(rho))
    return sorted(strength, key=lambda key: -strength[key])


def draws_of(plan: Mapping[str, Any], names: Mapping[str, str]) -> Draws | None:
    """Failures and correlations over draws; None of a sweep that drew nothing.

    Parameters
    ----------
    plan : dict
        ``sweep.json``.
    names : dict of str to str
        What the drawn keys are called on the page.
    """
    from trms_cli.reporting.reported_sweep import Correlation, Draws, FailureShare

    if not names:
        return None
    summary = _summary(plan)
    limits = summary.get("limits")
    failures, correlations = [], []
    for group in _mappings(summary.get("groups")):
        who = _words(group.get("choices"))
        told = group.get("failures")
        if isinstance(told, Mapping) and isinstance(told.get("draws"), int):
            failures.append(
                FailureShare(
                    who=who,
                    draws=told["draws"],
                    count=int(told["count"]) if _is_number(told.get("count")) else 0,
                    share=_number(told.get("share")),
                    low=_number(told.get("low")),
                    high=_number(told.get("high")),
                )
            )
        for each in _mappings(group.get("sensitivity")):
            if (
                isinstance(each.get("key"), str)
                and each["key"] in names
                and _is_number(each.get("rho"))
            ):
                correlations.append(
                    Correlation(
                        who=who,
                        key=names[each["key"]],
                        figure=bench_name(str(each.get("figure"))),
                        rho=float(each["rho"]),
                        p=_number(each.get("p")),
                    )
                )
    return Draws(
        keys=list(names.values()),
        limits={bench_name(str(k)): float(v) for k, v in limits.items() if _is_number(v)}
        if isinstance(limits, Mapping)
        else {},
        failures=failures,
        correlations=sorted(correlations, key=lambda each: -abs(each.rho)),
    )


def short_names(drawn: Sequence[str], others: Sequence[str]) -> dict[str, str]:
    """What drawn keys are called on a page: short, and not as another key is."""
    from trms_cli.sweeps.space import short_keys

    return {
        key: key if short in others else short for key, short in short_keys(list(drawn)).items()
    }


def _summary(plan: Mapping[str, Any]) -> Mapping[str, Any]:
    found = plan.get("summary")
    return found if isinstance(found, Mapping) and found.get("kind") == "robustness" else {}


def _words(choices: Any) -> str:
    if not isinstance(choices, Mapping) or not choices:
        return "all"
    told = [
        str(value) if "." not in str(key) and str(key) != "seed" else f"{key}={value}"
        for key, value in choices.items()
    ]
    return " + ".join(told)


def _mappings(given: Any) -> list[Mapping[str, Any]]:
    if not isinstance(given, list):
        return []
    return [each for each in given[:_MOST] if isinstance(each, Mapping)]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _number(value: Any) -> float | None:
    return float(value) if _is_number(value) else None
