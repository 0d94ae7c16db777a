"""Pictures of drawn runs: how each figure spreads, and which drawn value it goes with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from trms_cli.reporting.style import (
    ALARM,
    GREY,
    PALE,
    curve_look,
    house_style,
    new_figure,
    save_png,
)
from trms_cli.scoring.figures import column_title
from trms_cli.sweeps.space import short_keys

_SHARES = np.linspace(0, 1, 101)
#: So many drawn values are shown for each figure.
_MOST_BARS = 12
_LEVEL = 0.05


def words_of(group: Mapping[str, Any]) -> str:
    """``pid``, or ``controller=pid ref=sine`` where several things were chosen."""
    chosen = group["choices"]
    if len(chosen) == 1:
        return str(next(iter(chosen.values())))
    keys = short_keys(list(chosen))
    return " ".join(f"{keys[key]}={value}" for key, value in chosen.items()) or "all draws"


def draw_robustness(summary: Mapping[str, Any], path: Path) -> bool:
    """Share of the draws up to each value of a figure: a steep curve far left is robust.

    Returns
    -------
    bool
        False, and nothing is drawn, where no run has a figure.
    """
    names = [n for n in summary["figures"] if any(n in g["figures"] for g in summary["groups"])]
    if not names:
        return False
    with house_style():
        figure = new_figure(min(3.4 * len(names) + 0.8, 11.0), 3.7)
        panels = np.atleast_1d(figure.subplots(1, len(names), sharey=True))
        for panel, name in zip(panels, names, strict=True):
            _spread(panel, summary, name)
        panels[0].set_ylabel("share of the draws [%]")
        lines = [Line2D([], [], **curve_look(i)) for i in range(len(summary["groups"]))]
        figure.legend(
            lines,
            [words_of(group) for group in summary["groups"]],
            loc="outside upper left",
            ncols=4,
            handlelength=2.4,
        )
        save_png(figure, path)
    return True


def _spread(panel: Axes, summary: Mapping[str, Any], name: str) -> None:
    for i, group in enumerate(summary["groups"]):
        told = group["figures"].get(name)
        if told is None:
            continue
        # Draws without the figure failed: the curve ends below 100 %.
        share = told["draws"] / max(group["failures"]["draws"], 1)
        panel.plot(told["percentiles"], 100 * share * _SHARES, **curve_look(i))
        panel.plot(told["median"], 50 * share, "o", ms=4.5, color=curve_look(i)["color"])
    limit = summary["limits"].get(name)
    if limit is not None:
        panel.axvline(limit, color=ALARM, lw=1.0)
        panel.annotate(
            "limit", (limit, 3), color=ALARM, fontsize=8, ha="right", xytext=(-3, 0),
            textcoords="offset points",
        )  # fmt: skip
    panel.set_ylim(0, 101)
    panel.set_xlabel(column_title(name, summary["figures"][name]["unit"]))


def draw_sensitivity(summary: Mapping[str, Any], path: Path) -> bool:
    """Rank correlations of drawn values with each figure, strongest first.

    Those that chance explains are pale.

    Returns
    -------
    bool
        False, and nothing is drawn, where there are too few draws for a correlation.
    """
    groups = summary["groups"]
    names = [
        n for n in summary["figures"]
        if any(each["figure"] == n for g in groups for each in g["sensitivity"])
    ]  # fmt: skip
    if not names:
        return False
    short = short_keys(summary["varied"])
    shown = {name: _strongest(groups, name) for name in names}
    rows = max(len(keys) for keys in shown.values())
    with house_style():
        height = 1.1 + rows * (0.1 + 0.13 * len(groups))
        figure = new_figure(min(3.4 * len(names) + 0.8, 11.0), height)
        panels = np.atleast_1d(figure.subplots(1, len(names), sharex=True))
        for panel, name in zip(panels, names, strict=True):
            _bars(panel, groups, name, shown[name])
            panel.set_yticks(range(len(shown[name])), [short[key] for key in shown[name]])
            panel.set_ylim(rows - 0.5, -0.5)
            panel.set_title(column_title(name))
            panel.set_xlabel("rank correlation")
        squares = [
            Line2D([], [], ls="none", marker="s", ms=7, color=curve_look(i)["color"])
            for i in range(len(groups))
        ] + [Line2D([], [], ls="none", marker="s", ms=7, color=PALE)]
        words = [*(words_of(group) for group in groups), "not told from chance"]
        figure.legend(squares, words, loc="outside upper left", ncols=5, handletextpad=0.3)
        save_png(figure, path)
    return True


def _strongest(groups: Sequence[Mapping[str, Any]], name: str) -> list[str]:
    most: dict[str, float] = {}
    for group in groups:
        for each in group["sensitivity"]:
            if each["figure"] == name:
                most[each["key"]] = max(most.get(each["key"], 0.0), abs(each["rho"]))
    return sorted(most, key=lambda key: -most[key])[:_MOST_BARS]


def _bars(panel: Axes, groups: Sequence[Mapping[str, Any]], name: str, keys: Sequence[str]) -> None:
    thick = 0.8 / len(groups)
    for i, group in enumerate(groups):
        found = {e["key"]: e for e in group["sensitivity"] if e["figure"] == name}
        for row, key in enumerate(keys):
            told = found.get(key)
            if told is not None:
                sure = told["p"] < _LEVEL
                place = row + (i - (len(groups) - 1) / 2) * thick
                colour = curve_look(i)["color"] if sure else PALE
                panel.barh(place, told["rho"], height=0.92 * thick, color=colour, lw=0)
    panel.axvline(0, color=GREY, lw=0.7)
    panel.set_xlim(-1, 1)
    panel.grid(visible=False, axis="y")
