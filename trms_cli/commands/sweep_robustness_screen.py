"""The tables of drawn runs: how figures spread, how often runs fail, which parameter matters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.padding import Padding
from rich.table import Table

from trms_cli.commands.compare_screen import console, number
from trms_cli.sweeps.short_keys import short_keys

#: So many parameters are named for each figure.
_MOST_NAMED = 5
#: Of p values that are adjusted for their number.
_LEVEL = 0.05


def say_robustness(summary: Mapping[str, Any]) -> None:
    """Print what drawn runs say."""
    out = console()
    groups = summary["groups"]
    if not groups:
        return
    varied = summary["varied"]
    named = ", ".join(short_keys(varied)[key] for key in varied[:3])
    more = f", … ({len(varied)})" if len(varied) > 3 else ""
    print(f"drawn      {named}{more}")
    out.print(Padding(_distributions(summary), (1, 0, 0, 2)))
    out.print(Padding(_failures(summary), (1, 0, 0, 2)))
    limits = ", ".join(f"{name} ≤ {bound:g}" for name, bound in summary["limits"].items())
    if limits:
        out.print(Padding(f"limits: {limits}", (0, 0, 0, 2)), highlight=False)
    table = _sensitivities(summary)
    if table.row_count:
        out.print(Padding(table, (1, 0, 1, 2)))
    else:
        print("\n  no figure is correlated with a drawn value, as far as these runs can tell\n")


def words_of(group: Mapping[str, Any]) -> str:
    """``controller=pid``; "all" where nothing was chosen."""
    keys = short_keys(list(group["choices"]))
    return " ".join(f"{keys[key]}={value}" for key, value in group["choices"].items()) or "all"


def _distributions(summary: Mapping[str, Any]) -> Table:
    table = _table("figure", "", "median", "5 %", "95 %", "worst")
    several = len(summary["groups"]) > 1
    if several:
        table.add_column("best on", justify="right")
    for name, about in summary["figures"].items():
        unit = f" {about['unit']}" if about["unit"] else ""
        for i, group in enumerate(summary["groups"]):
            told = group["figures"].get(name)
            if told is None:
                continue
            cells = [number(told[key]) for key in ("median", "q05", "q95", "max")]
            if several:
                share = told.get("best_share")
                cells.append("–" if share is None else f"{100 * share:.0f} %")
            table.add_row(name + unit if i == 0 else "", words_of(group), *cells)
    return table


def _failures(summary: Mapping[str, Any]) -> Table:
    what = "failed, or beyond a limit" if summary["limits"] else "failed"
    table = _table(what, "", "draws", "failures", "share", "95 %")
    for group in summary["groups"]:
        told = group["failures"]
        share = told["share"]
        table.add_row(
            "",
            words_of(group),
            str(told["draws"]),
            str(told["count"]),
            "–" if share is None else f"{100 * share:.1f} %",
            "–" if share is None else f"{100 * told['low']:.1f}–{100 * told['high']:.1f} %",
        )
        if group["lost"]:
            table.add_row("", f"  and {group['lost']} lost with their workers", "", "", "", "")
    return table


def _sensitivities(summary: Mapping[str, Any]) -> Table:
    short = short_keys(summary["varied"])
    table = _table("rank correlation with", "", "strongest first")
    table.columns[2].justify = "left"
    for name in summary["figures"]:
        title = name
        for group in summary["groups"]:
            told = [
                f"{short[each['key']]} {each['rho']:+.2f}"
                for each in group["sensitivity"]
                if each["figure"] == name and each["p"] < _LEVEL
            ]
            if told:
                more = f" and {len(told) - _MOST_NAMED} more" if len(told) > _MOST_NAMED else ""
                words = ", ".join(told[:_MOST_NAMED]) + more
                table.add_row(title, words_of(group), words)
                title = ""
    return table


def _table(first: str, second: str, *columns: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    table.add_column(first, style="cyan")
    table.add_column(second)
    for column in columns:
        table.add_column(column, justify="right")
    return table
