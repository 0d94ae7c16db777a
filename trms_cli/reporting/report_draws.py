"""Sections of drawn runs on the page of a sweep: how often they fail, and what figures hang on."""

from __future__ import annotations

from trms_cli.core.findings import Cell
from trms_cli.reporting.page import Page
from trms_cli.reporting.reported_sweep import Draws, FailureShare

_MOST_CORRELATIONS = 30
#: Of p values that are adjusted for their number.
_LEVEL = 0.05


def add_failure_shares(page: Page, draws: Draws) -> None:
    """The table of failures, with the interval of each share."""
    if not draws.failures:
        return
    page.section(
        "Failures among the draws",
        f"Counted is a draw whose run ended in an error{_beyond(draws)}. The interval of 95 % is "
        "that of Clopper and Pearson for independent draws.",
    )
    rows: list[list[Cell]] = [
        [each.who, each.draws, each.count, _percent(each.share), _interval(each)]
        for each in draws.failures
    ]
    page.table(["who", "draws", "failures", "share", "95 % interval"], rows)


def add_correlations(page: Page, draws: Draws) -> None:
    """The strongest rank correlations of drawn values with figures."""
    if not draws.correlations:
        return
    told = [each for each in draws.correlations if each.p is not None and each.p < _LEVEL]
    shown = (told or draws.correlations[:5])[:_MOST_CORRELATIONS]
    count = f"{len(told)} of {len(draws.correlations)}"
    words = (
        f"Spearman's rank correlation of each drawn value with each figure, the strongest first: "
        f"{count} are more than chance explains (p < {_LEVEL:g}, adjusted for their number by "
        "Benjamini and Hochberg)"
    )
    if not told:
        words += "; the strongest are here, and may be chance"
    elif len(told) > len(shown):
        words += f"; the first {len(shown)} are here"
    page.section("Sensitivities", words + ".")
    rows: list[list[Cell]] = [
        [each.figure, each.who, each.key, f"{each.rho:+.2f}", each.p] for each in shown
    ]
    page.table(["figure", "who", "drawn value", "correlation", "adjusted p"], rows, heads=3)


def failures_sentence(draws: Draws) -> str:
    """How often draws failed, for the head of the page; "" where none did, or nobody counted."""
    failed = [each for each in draws.failures if each.count]
    if not failed:
        return ""
    told = ", ".join(
        f"{each.who} **{each.count} of {each.draws}** ({_percent(each.share)}, 95 % interval "
        f"{_interval(each)})"
        for each in failed[:6]
    )
    more = f", and {len(failed) - 6} more" if len(failed) > 6 else ""
    return f"Draws that failed{_beyond(draws)}: {told}{more}."


def _beyond(draws: Draws) -> str:
    limits = ", ".join(f"{name} ≤ {bound:g}" for name, bound in draws.limits.items())
    return f", or that did not hold a limit ({limits})" if limits else ""


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"


def _interval(told: FailureShare) -> str:
    if told.low is None or told.high is None:
        return "–"
    return f"{100 * told.low:.1f}\u2060–\u2060{100 * told.high:.1f} %"
