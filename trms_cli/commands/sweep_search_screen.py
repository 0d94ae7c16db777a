"""The tables of a search: the best trials beside the configuration as it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.padding import Padding
from rich.table import Table

from trms_cli.commands.compare_screen import console, number
from trms_cli.sweeps.short_keys import short_keys

_MOST_ROWS = 12


def chosen_trial(summary: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The best trial; of a front the one nearest to what would be best in everything.

    Nearness is measured in spans of the front.
    """
    best = front_of(summary)
    if not best:
        return None
    losses = np.array([_losses(summary, each) for each in best])
    span = np.ptp(losses, axis=0)
    scaled = (losses - losses.min(axis=0)) / np.where(span > 0, span, 1.0)
    return best[int(np.linalg.norm(scaled, axis=1).argmin())]


def front_of(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The best trials, along the first objective."""
    by_number = {each["trial"]: each for each in summary["trials"]}
    return [by_number[number] for number in summary["pareto"]]


def baseline_of(summary: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The trial of the configuration as it was, if it was tried."""
    if summary.get("baseline") is None:
        return None
    return next((t for t in summary["trials"] if t["trial"] == summary["baseline"]), None)


def say_search(summary: Mapping[str, Any]) -> None:
    """Print what a search found."""
    out = console()
    trials = summary["trials"]
    failed = sum("problem" in each for each in trials)
    beyond = sum(not each["allowed"] for each in trials) - failed
    parts = [f"{len(trials)} trials by {summary['method']}"]
    if summary["conditions"] > 1:
        what = f"{summary['over_conditions']} of {summary['conditions']} conditions each"
        parts.append(what)
    parts += [f"{failed} failed"] * bool(failed) + [f"{beyond} beyond a limit"] * bool(beyond)
    print(f"search     {', '.join(parts)}")
    best, before = front_of(summary), baseline_of(summary)
    if not best:
        print("           no trial ran to its end within the limits")
        return
    rows = _few(best, chosen_trial(summary))
    out.print(Padding(_table(summary, rows, before), (1, 0, 0, 0)))
    if any("confirmed" in each for each in best):
        print("* under fresh conditions: an estimate, while the score of the best was chosen")
    if len(rows) < len(best):
        print(f"  {len(best)} trials are on the front; --json has all")
    for line in _gains(summary, best, before):
        print(line)


def _table(
    summary: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    before: Mapping[str, Any] | None,
) -> Table:
    objectives = summary["objectives"]
    keys = list(rows[0]["values"])
    names = short_keys(keys)
    confirmed = any("confirmed" in each for each in rows)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    table.add_column("trial", justify="right", no_wrap=True)
    for objective in objectives:
        sign = "↑" if objective["direction"] == "maximise" else "↓"
        table.add_column(
            f"{_broken(objective['name'])}\n{objective['unit']} {sign}", justify="right"
        )
        if confirmed:
            table.add_column("again*", justify="right", style="dim")
    for key in keys:
        table.add_column(_broken(names[key]), justify="right", style="cyan", no_wrap=True)
    shown = [each for each in rows if before is None or each["trial"] != before["trial"]]
    for each in shown:
        table.add_row(str(each["trial"]), *_cells(summary, each, keys, confirmed))
    if before is not None:
        table.add_row("before", *_cells(summary, before, keys, confirmed), style="bold")
    return table


def _cells(
    summary: Mapping[str, Any], trial: Mapping[str, Any], keys: Sequence[str], confirmed: bool
) -> list[str]:
    cells = []
    for objective in summary["objectives"]:
        name = objective["name"]
        cells.append(_cell(trial["figures"].get(name)))
        if confirmed:
            cells.append(_cell(trial.get("confirmed", {}).get("figures", {}).get(name)))
    return cells + [_cell(trial["values"].get(key)) for key in keys]


def _cell(value: float | None) -> str:
    return "–" if value is None else number(float(value), 4)


def _gains(
    summary: Mapping[str, Any],
    best: Sequence[Mapping[str, Any]],
    before: Mapping[str, Any] | None,
) -> list[str]:
    """By how much the best are better than what was, also where they were run again."""
    lines = []
    if before is None:
        return []
    if not before["figures"]:
        return [f"  the configuration as it was failed: {before.get('problem', '')}"]
    for objective in summary["objectives"]:
        name = objective["name"]
        pick = max if objective["direction"] == "maximise" else min
        first = pick(best, key=lambda each: each["figures"][name])
        words = _change(first["figures"].get(name), before["figures"].get(name))
        again = _change(
            first.get("confirmed", {}).get("figures", {}).get(name),
            before.get("confirmed", {}).get("figures", {}).get(name),
        )
        fresh = f", {again} under fresh conditions" if again else ""
        lines.append(f"  {name}: trial {first['trial']} {words}{fresh} against as it was")
    dominating = [each["trial"] for each in best if _dominates(summary, each, before)]
    if len(summary["objectives"]) > 1:
        told = ", ".join(map(str, dominating[:_MOST_ROWS]))
        lines.append(
            f"  better in everything: trials {told}"
            if dominating
            else "  none is better than as it was in everything"
        )
    return lines


def _change(value: float | None, before: float | None) -> str:
    if value is None or not before:
        return ""
    return f"{100 * (value / before - 1):+.1f} %"


def _dominates(
    summary: Mapping[str, Any], trial: Mapping[str, Any], other: Mapping[str, Any]
) -> bool:
    mine, its = _losses(summary, trial), _losses(summary, other)
    return bool(np.all(np.array(mine) < np.array(its)))


def _losses(summary: Mapping[str, Any], trial: Mapping[str, Any]) -> list[float]:
    return [
        trial["figures"][o["name"]] * (-1.0 if o["direction"] == "maximise" else 1.0)
        for o in summary["objectives"]
    ]


def _few(
    best: Sequence[Mapping[str, Any]], chosen: Mapping[str, Any] | None
) -> list[Mapping[str, Any]]:
    """At most a screenful, evenly along the front, with the one that is to be told of."""
    if len(best) <= _MOST_ROWS:
        return list(best)
    at = set(np.linspace(0, len(best) - 1, _MOST_ROWS).round().astype(int).tolist())
    return [each for i, each in enumerate(best) if i in at or each is chosen]


def _broken(name: str) -> str:
    """A name over several lines, where a table has many columns."""
    return name.replace(".", "\n").replace("_weights", "\nweights").replace("_variation", "\nvar.")
