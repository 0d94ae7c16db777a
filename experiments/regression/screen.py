"""The tables of a regression, at most 80 columns wide, and their JSON twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from experiments.regression.comparison import BaselineFile, Comparison
from trms_cli.scoring.baseline import BaselineRow

_STYLES = {"worse": "bold red", "failed": "bold red", "new": "yellow", "better": "green"}
_WIDTH = 80


def console() -> Console:
    """As wide as the terminal but no wider than 80; plain where colours are not wanted."""
    usual = Console()
    return usual if usual.width <= _WIDTH else Console(width=_WIDTH)


def print_runs(comparisons: Sequence[Comparison], recorded: BaselineFile) -> None:
    """One line a run: its tracking error then and now."""
    table = _table("run", "pitch", "was", "yaw", "was", "")
    for comparison in comparisons:
        outcome = comparison.outcome
        cells = []
        for channel in ("alpha_v", "alpha_h"):
            then = recorded.runs.get(outcome.case.name, {}).get("score", {})
            cells += [_rmse(outcome.score, channel), _rmse(then, channel)]
        style = _STYLES.get(comparison.verdict, "")
        table.add_row(outcome.case.name, *cells, f"[{style}]{comparison.verdict}" if style else "")
    out = console()
    out.print(table)
    out.print("  RMSE of pitch and yaw in rad, now and in the baseline\n", style="dim")


def print_changes(comparisons: Sequence[Comparison]) -> None:
    """Every figure that moved by more than its tolerance, and every run that failed."""
    out = console()
    table = _table("what changed", "", "baseline", "now", "tolerance", "")
    for comparison in comparisons:
        changed = [row for row in comparison.rows if row.verdict != "same"]
        if changed:
            table.add_row(comparison.outcome.case.name, style="bold")
        for row in changed:
            style = _STYLES.get("worse" if row.regressed else row.verdict, "")
            table.add_row(f"  {_figure(row)}", *_cells(row), row.verdict, style=style)
    if table.row_count:
        out.print(table)
    for comparison in comparisons:
        name, problem = comparison.outcome.case.name, comparison.outcome.problem
        if comparison.verdict == "failed":
            out.print(f"  {name} failed: {problem}\n", style="bold red", highlight=False)


def print_verdict(
    comparisons: Sequence[Comparison], recorded: BaselineFile, seconds: float
) -> None:
    """The last lines."""
    out = console()
    count = {kind: sum(c.verdict == kind for c in comparisons) for kind in (*_STYLES, "same")}
    bad = any(comparison.bad for comparison in comparisons)
    words = [f"{count[kind]} {kind}" for kind in (*_STYLES, "same") if count[kind]]
    verdict = "WORSE than the baseline" if bad else "not worse than the baseline"
    style = "bold red" if bad else "bold green"
    out.print(f"{verdict}: {', '.join(words)}; {seconds:.0f} s", style=style, highlight=False)
    out.print(
        f"the baseline: {recorded.reason} ({recorded.date}, {recorded.git or 'no revision'})",
        highlight=False,
    )
    if bad or count["better"]:
        out.print(
            'if that is meant: make regression-update REASON="why"', style="dim", highlight=False
        )


def document(comparisons: Sequence[Comparison], recorded: BaselineFile) -> dict[str, Any]:
    """``trms.regression/1``: the same figures as printed, and those that stayed."""
    return {
        "schema": "trms.regression/1",
        "worse": any(comparison.bad for comparison in comparisons),
        "baseline": {"reason": recorded.reason, "date": recorded.date, "git": recorded.git},
        "runs": [
            {
                "name": comparison.outcome.case.name,
                "overrides": list(comparison.outcome.case.overrides),
                "verdict": comparison.verdict,
                "problem": comparison.outcome.problem,
                "wall_time_s": comparison.outcome.seconds,
                "figures": [asdict(row) for row in comparison.rows],
            }
            for comparison in comparisons
        ],
    }


def _rmse(score: Any, channel: str) -> str:
    value = (score or {}).get("channels", {}).get(channel, {}).get("rmse")
    return _number(value)


def _figure(row: BaselineRow) -> str:
    """``channels.alpha_v.rmse`` as ``alpha_v rmse``."""
    key = row.key.removeprefix("channels.").removeprefix("solver.")
    key = key.replace("constraint_violations.", "limits.").replace("estimate.rmse.", "estimate ")
    return key.removesuffix("_percent").removesuffix("_s").replace(".", " ")


def _cells(row: BaselineRow) -> tuple[str, str, str, str]:
    return row.unit, _number(row.baseline), _number(row.now), f"±{_number(row.tolerance)}"


def _number(value: float | int | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _table(title: str, *columns: str) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(title, header_style="bold cyan", overflow="fold")
    for column in columns:
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    return table
