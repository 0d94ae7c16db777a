"""What a search for the best weights says of itself in its ``sweep.json``, as a report takes it.

The file may be of another version, of another program, or a stranger's: whatever is not as
expected is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trms_cli.reporting.reported_sweep import Objective, SweepRun, Value

_MOST_TRIALS = 100_000


def search_of(plan: Mapping[str, Any]) -> Mapping[str, Any]:
    """The part of a sweep's document that has objectives; empty for a sweep that seeks nothing."""
    inner = [plan, *(value for value in plan.values() if isinstance(value, Mapping))]
    asked = [each for each in inner if isinstance(each.get("objectives"), list)]
    # The settings of the search name its objectives too, before anything was found.
    return next((each for each in asked if "pareto" in each), asked[0] if asked else {})


def objectives_of(words: Mapping[str, Any]) -> list[Objective]:
    """What is sought: names, or mappings with a name and a direction."""
    from trms_cli.reporting.reported_sweep import Objective

    found = []
    for each in words.get("objectives", ()):
        told: Mapping[str, Any] = each if isinstance(each, Mapping) else {"name": each}
        name = next((told[k] for k in ("name", "figure") if isinstance(told.get(k), str)), "")
        if name:
            found.append(
                Objective(bench_name(name), str(told.get("direction", "")).startswith("max"))
            )
    return found


def pareto_of(words: Mapping[str, Any]) -> list[int]:
    """Numbers of the best trials."""
    given = words.get("pareto")
    return [n for n in given if isinstance(n, int)] if isinstance(given, list) else []


def trials_of(words: Mapping[str, Any]) -> list[SweepRun]:
    """What was tried, with the figures over all conditions of a trial."""
    from trms_cli.reporting.reported_sweep import SweepRun

    given = words.get("trials")
    found = []
    for each in given[:_MOST_TRIALS] if isinstance(given, list) else ():
        if not isinstance(each, Mapping) or not isinstance(each.get("trial"), int):
            continue
        problem = str(each.get("problem") or "")
        found.append(
            SweepRun(
                name=str(each["trial"]),
                number=each["trial"],
                outcome="failed"
                if problem
                else "completed"
                if each.get("allowed", True)
                else "beyond a limit",
                values={str(k): _value(v) for k, v in _mapping(each, "values").items()},
                figures={
                    bench_name(str(k)): float(v)
                    for k, v in _mapping(each, "figures").items()
                    if _is_number(v)
                },
                problem=problem,
            )
        )
    return found


def history_of(words: Mapping[str, Any]) -> list[float | None]:
    """After each trial the best so far."""
    given = words.get("history")
    if not isinstance(given, list):
        return []
    return [float(value) if _is_number(value) else None for value in given[:_MOST_TRIALS]]


def bench_name(name: str) -> str:
    """A figure as it is called at the bench: ``rmse_yaw`` for ``rmse_alpha_h``."""
    from trms_cli.runs.columns import ALIASES

    return next(
        (told for told, meant in ALIASES.items() if meant == name and "." not in told), name
    )


def _mapping(owner: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = owner.get(key)
    return found if isinstance(found, Mapping) else {}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _value(value: Any) -> Value:
    return value if isinstance(value, (str, int, float)) or value is None else str(value)
