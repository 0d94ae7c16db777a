"""What a sweep says, as Markdown for its page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.page_tables import number
from trms_cli.sweeps.findings import baseline_of, choices_of, front_of
from trms_cli.sweeps.space import short_keys

_MOST_NAMED = 4
_LEVEL = 0.05


def table_of(document: Mapping[str, Any]) -> str:
    """The tables of a sweep.

    ``document``: ``trms.sweep-status/1``.
    """
    counts = document["counts"]
    lines = [f"{counts['done']} runs done, {counts['failed'] + counts['lost']} failed or lost.", ""]
    summary = document["summary"]
    rows = _search(summary) if summary["kind"] == "optimisation" else _draws(summary)
    # Which controller: in a study of one choice its value is enough.
    rows = [line.replace("| controller=", "| ") for line in rows]
    return "\n".join([*lines, *rows])


def _draws(summary: Mapping[str, Any]) -> list[str]:
    lines = [
        "| figure | | median | 5 % | 95 % | worst | best on |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, about in summary["figures"].items():
        for group in summary["groups"]:
            entry = group["figures"][name]
            cells = [number(entry[key]) for key in ("median", "q05", "q95", "max")]
            cells.append(f"{100 * entry['best_share']:.0f} %")
            lines.append(
                f"| {name} [{about['unit']}] | {choices_of(group)} | {' | '.join(cells)} |"
            )
    lines += ["", "| failed | draws | failures | share | 95 % |", "|---|---|---|---|---|"]
    for group in summary["groups"]:
        entry = group["failures"]
        interval = f"{100 * entry['low']:.1f}–{100 * entry['high']:.1f} %"
        share = f"{100 * entry['share']:.1f} %"
        lines.append(
            f"| {choices_of(group)} | {entry['draws']} | {entry['count']} | {share} | {interval} |"
        )
    lines += ["", "| rank correlation with | | strongest first |", "|---|---|---|"]
    short = short_keys(summary["varied"])
    for name in summary["figures"]:
        for group in summary["groups"]:
            correlations = [
                f"`{short[e['key']]}` {e['rho']:+.2f}"
                for e in group["sensitivity"]
                if e["figure"] == name and e["p"] < _LEVEL
            ]
            lines.append(
                f"| {name} | {choices_of(group)} | {', '.join(correlations[:_MOST_NAMED]) or '–'} |"
            )
    return lines


def _search(summary: Mapping[str, Any]) -> list[str]:
    names = [objective["name"] for objective in summary["objectives"]]
    front, before = front_of(summary), baseline_of(summary)
    keys = short_keys(list(front[0]["values"]))
    head = ["trial", *(f"{name} | again" for name in names), *(f"`{k}`" for k in keys.values())]
    width = 1 + 2 * len(names) + len(keys)
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * width]
    rows = [each for each in front if before is None or each["trial"] != before["trial"]]
    for each in [*rows, *([before] if before else [])]:
        cells = ["as it was" if each is before else str(each["trial"])]
        for name in names:
            again = each.get("confirmed", {}).get("figures", {}).get(name)
            cells += [_cell(each["figures"].get(name)), _cell(again)]
        cells += [_cell(each["values"].get(key)) for key in keys]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _cell(value: float | None) -> str:
    return "–" if value is None else number(float(value), 4)
