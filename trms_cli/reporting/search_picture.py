"""Pictures of a search: the Pareto front in pairs of objectives, or the best so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trms_cli.reporting.style import (
    ALARM,
    FAINT,
    GREY,
    INK,
    PALETTE,
    PAPER,
    house_style,
    legend_above,
    new_figure,
    save_png,
)
from trms_cli.scoring.figures import column_title

#: Pairs of objectives that are drawn: of three all, of more the first.
_MOST_PANELS = 3
_TRIED: dict[str, Any] = {"marker": "o", "ms": 3.6, "mew": 0, "color": FAINT}
_BEYOND: dict[str, Any] = {"marker": "x", "ms": 4.5, "color": ALARM}
#: Share of the width beside the front and the baseline in which tried ones are shown.
_ROOM = 0.6
#: Share of the height above the highest and below the lowest of a search.
_MARGIN = 0.05


def draw_pareto(summary: Mapping[str, Any], path: Path) -> bool:
    """The trials in the plane of each two objectives, the front and the baseline marked.

    Parameters
    ----------
    summary : dict
        What a search said, of two objectives or more.
    path : Path
        Of the PNG.

    Returns
    -------
    bool
        False, and nothing is drawn, where no trial was allowed.
    """
    if not summary["pareto"]:
        return False
    pairs = list(combinations(summary["objectives"], 2))[:_MOST_PANELS]
    with house_style():
        figure = new_figure(6.2 if len(pairs) == 1 else 4.4 * len(pairs), 4.4)
        panels = np.atleast_1d(figure.subplots(1, len(pairs)))
        for panel, pair in zip(panels, pairs, strict=True):
            _front(panel, summary, pair)
        volumes = [v for v in summary["history"] if v is not None]
        words = [f"{len(summary['pareto'])} on the front"]
        if _is_plane(summary, volumes):
            words.append(f"hypervolume {volumes[-1]:.3f} of 1.21")
        names = [[each["name"] for each in pair] for pair in pairs]
        outside = {
            trial["trial"]
            for panel, (x, y) in zip(panels, names, strict=True)
            for trial in _ran(summary)
            if not _is_inside(panel, trial["figures"][x], trial["figures"][y])
        }
        _title(figure, summary, words, len(outside))
        legend_above(panels[0], 5)
        save_png(figure, path)
    return True


def _title(figure: Figure, summary: Mapping[str, Any], words: Sequence[str], outside: int) -> None:
    """How many trials there are, and how many of them are not to be seen."""
    trials = summary["trials"]
    unseen = [f"{outside} outside the frame"] * bool(outside)
    failed = len(trials) - len(_ran(summary))
    unseen += [f"{failed} failed"] * bool(failed)
    first = ", ".join([f"{len(trials)} trials by {summary['method']}", *words])
    figure.suptitle(
        "\n".join([first, *([f"not shown: {', '.join(unseen)}"] if unseen else [])]),
        x=0.01,
        ha="left",
        fontsize=10,
        fontweight="bold",
        color=INK,
    )


def _ran(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [trial for trial in summary["trials"] if trial["figures"]]


def _is_inside(panel: Axes, x: float, y: float) -> bool:
    (left, right), (low, high) = panel.get_xlim(), panel.get_ylim()
    return left <= x <= right and low <= y <= high


def _is_plane(summary: Mapping[str, Any], volumes: Sequence[float]) -> bool:
    return len(summary["objectives"]) == 2 and bool(volumes)


def _front(panel: Axes, summary: Mapping[str, Any], pair: Sequence[Mapping[str, Any]]) -> None:
    x, y = (each["name"] for each in pair)
    ran = _ran(summary)
    on_front = set(summary["pareto"])
    baseline = summary.get("baseline")
    for trials, look in (
        ([t for t in ran if not t["allowed"]], _BEYOND),
        ([t for t in ran if t["allowed"]], _TRIED),
    ):
        if trials:
            label = "tried" if trials[0]["allowed"] else "beyond a limit"
            panel.plot(
                [t["figures"][x] for t in trials],
                [t["figures"][y] for t in trials],
                ls="none",
                label=label,
                **look,
            )
    front = sorted((t for t in ran if t["trial"] in on_front), key=lambda t: t["figures"][x])
    xs, ys = ([t["figures"][name] for t in front] for name in (x, y))
    plane = len(summary["objectives"]) == 2
    panel.plot(
        xs, ys, "o", ms=5.5, color=PALETTE["blue"], ls="-" if plane else "none", lw=1.0,
        drawstyle="steps-post", label="front",
    )  # fmt: skip
    again = [t for t in front if t.get("confirmed", {}).get("figures")]
    _again(panel, again, x, y)
    before = [t for t in ran if t["trial"] == baseline]
    if before:
        panel.plot(
            before[0]["figures"][x], before[0]["figures"][y], "D", ms=7, color=PALETTE["vermilion"],
            ls="none", label="as it was",
        )  # fmt: skip
        if _confirmed(before[0], x) and _confirmed(before[0], y):
            then, now = before[0]["figures"], before[0]["confirmed"]["figures"]
            panel.plot([then[x], now[x]], [then[y], now[y]], color=GREY, lw=0.6, zorder=1.5)
            panel.plot(now[x], now[y], "D", ms=6, mfc=PAPER, mec=PALETTE["vermilion"], ls="none")
    _stay_near(panel, front + before, x, y)
    panel.set_xlabel(column_title(x, pair[0]["unit"]))
    panel.set_ylabel(column_title(y, pair[1]["unit"]))


def _again(panel: Axes, trials: Sequence[Mapping[str, Any]], x: str, y: str) -> None:
    """Where the front lands under fresh conditions, each joined to where it was."""
    for i, each in enumerate(trials):
        then, now = each["figures"], each["confirmed"]["figures"]
        panel.plot([then[x], now[x]], [then[y], now[y]], color=GREY, lw=0.6, zorder=1.5)
        panel.plot(
            now[x], now[y], "o", ms=5, mfc=PAPER, mec=PALETTE["green"], ls="none",
            label="front, fresh conditions" if i == 0 else None,
        )  # fmt: skip


def _stay_near(panel: Axes, marked: Sequence[Mapping[str, Any]], x: str, y: str) -> None:
    """A trial that is bad beyond measure must not flatten the front."""
    for name, limits in ((x, panel.set_xlim), (y, panel.set_ylim)):
        values = [t["figures"][name] for t in marked]
        values += [t["confirmed"]["figures"][name] for t in marked if _confirmed(t, name)]
        low, high = min(values), max(values)
        span = (high - low) or abs(high) or 1.0
        shown = panel.dataLim.intervalx if name == x else panel.dataLim.intervaly
        limits(
            max(low - 0.08 * span, shown[0] - 0.04 * span),
            min(high + _ROOM * span, shown[1] + 0.04 * span),
        )


def _confirmed(trial: Mapping[str, Any], name: str) -> bool:
    return name in trial.get("confirmed", {}).get("figures", {})


def draw_search(summary: Mapping[str, Any], path: Path) -> bool:
    """The objective of each trial, and the best so far.

    Returns
    -------
    bool
        False, and nothing is drawn, where no trial was allowed.
    """
    if not summary["pareto"]:
        return False
    objective = summary["objectives"][0]
    name = objective["name"]
    trials = summary["trials"]
    with house_style():
        figure = new_figure(6.6, 3.6)
        panel = figure.subplots()
        for allowed, label, look in (
            (True, "tried", _TRIED),
            (False, "beyond a limit", _BEYOND),
        ):
            found = [t for t in trials if t["figures"] and t["allowed"] is allowed]
            if found:
                panel.plot(
                    [t["trial"] for t in found],
                    [t["figures"][name] for t in found],
                    ls="none",
                    label=label,
                    **look,
                )
        best = [(t["trial"], b) for t, b in zip(trials, summary["history"], strict=True)]
        panel.step(
            [n for n, b in best if b is not None],
            [b for _, b in best if b is not None],
            where="post",
            color=PALETTE["blue"],
            label="best so far",
        )
        before = next((t for t in trials if t["trial"] == summary.get("baseline")), None)
        if before is not None and before["figures"]:
            panel.axhline(before["figures"][name], color=PALETTE["vermilion"], ls="--", lw=1.0)
            panel.plot(
                0, before["figures"][name], "D", ms=7, color=PALETTE["vermilion"], ls="none",
                label="as it was",
            )  # fmt: skip
        values = np.array([t["figures"][name] for t in _ran(summary)])
        _without_outliers(panel, values, objective["direction"] == "maximise")
        shown = sum(_is_inside(panel, t["trial"], t["figures"][name]) for t in _ran(summary))
        _title(figure, summary, (), len(values) - shown)
        panel.set_xlabel("trial")
        panel.set_ylabel(column_title(name, objective["unit"]))
        legend_above(panel, 4)
        save_png(figure, path)
    return True


def _without_outliers(panel: Axes, values: np.ndarray, maximised: bool) -> None:
    """Trials that are bad beyond measure are cut off, so that the others can be told apart."""
    low, high = float(values.min()), float(values.max())
    middle = float(np.median(values))
    if maximised:
        low = max(low, middle - 3 * (high - middle))
    else:
        high = min(high, middle + 3 * (middle - low))
    if high > low:
        room = _MARGIN * (high - low)
        panel.set_ylim(low - room, high + room)
