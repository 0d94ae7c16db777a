"""The other panels of a plot: phase planes, predictions, comparisons."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from trms_cli.reporting.plot_logs import Plotted, rate_of
from trms_cli.reporting.plot_panels import Absent, LogPanel
from trms_cli.reporting.style import GREY, INK, LABELS, PALETTE, curve_look, thinned_to_extremes

#: Predictions drawn at most: more run into each other.
_MOST_FANS = 60
#: Letters in a line of a log's name beside its bar.
_NAME_LETTERS = 22


def phase(logs: Sequence[Plotted]) -> list[LogPanel]:
    """Each axis's rate over its angle."""
    names = [n for n in ("alpha_v", "alpha_h") if any(log.truth(n) is not None for log in logs)]
    if not names:
        raise Absent("no log has an angle: a motor or a propeller alone has none")

    def panel(name: str) -> LogPanel:
        def draw(axes: Axes) -> None:
            for i, log in enumerate(logs):
                signal = log.truth(name)
                if signal is not None and signal.source == "measured":
                    signal = log.signal("/estimate", name, "estimate") or signal
                if signal is None:
                    continue
                rate, look = rate_of(signal), curve_look(i)
                label = log.name if len(logs) > 1 else signal.source
                axes.plot(signal.values, rate, label=label, **look)
                axes.plot(signal.values[:1], rate[:1], "o", color=look["color"], markersize=3)
            axes.set_xlabel(f"{LABELS.get(name, name)} [rad]")
            axes.set_ylabel(f"{LABELS.get(name, name)} rate [rad/s]")

        return LogPanel(draw, 1.9, over_time=False, half=len(names) > 1)

    return [panel(name) for name in names]


def prediction(logs: Sequence[Plotted]) -> list[LogPanel]:
    """What the controller foretold, again and again, over what came."""
    panels = []
    for i, log in enumerate(logs):
        for name in ("alpha_v", "alpha_h"):
            if name in log.names("/prediction") and log.within("/prediction").any():
                panels.append(_fan(log, name, i, len(logs) == 1))
    if not panels:
        raise Absent(
            "no log has a prediction: only controllers that plan ahead tell any (newton_mpc, nmpc, "
            "linear_mpc, robust_mpc), and none with sim.prediction_every=0"
        )
    return panels


def _fan(log: Plotted, name: str, place: int, alone: bool) -> LogPanel:
    def draw(axes: Axes) -> None:
        table, inside = log.log.tables["/prediction"], log.within("/prediction")
        starts, ahead = table.time[inside], table.columns["time"][inside]
        foretold = table.columns[name][inside]
        every = max(1, len(starts) // _MOST_FANS)
        fans = [
            np.column_stack([start + later, values])
            for start, later, values in zip(
                starts[::every], ahead[::every], foretold[::every], strict=True
            )
            if len(later) == len(values)
        ]
        axes.add_collection(
            LineCollection(fans, colors=PALETTE["orange"], linewidths=0.6, zorder=5,
                           label="predicted")
        )  # fmt: skip
        done, asked = log.truth(name), log.signal("/reference", name)
        if asked is not None:
            time, values = thinned_to_extremes(asked.time, asked.values)
            axes.plot(time, values, color=INK, linestyle=(0, (4, 2)),
                      drawstyle="steps-post", label="reference", zorder=3)  # fmt: skip
        if done is not None:
            time, values = thinned_to_extremes(done.time, done.values)
            axes.plot(time, values, label=done.source, zorder=4, **curve_look(0))
        axes.autoscale_view()
        axes.set_ylabel(f"{LABELS.get(name, name)} [rad]")
        if not alone:
            axes.set_title(log.name)

    return LogPanel(draw)


def comparison(logs: Sequence[Plotted]) -> list[LogPanel]:
    """Scores beside each other, one bar a log."""
    if len(logs) < 2:
        raise Absent("one log compares with nothing: give two or more")
    scored = [log for log in logs if log.log.score]
    if not scored:
        raise Absent("no log has a score: the runs did not end, or are recordings")
    figures = [
        *((f"RMSE of {LABELS.get(n, n)} [rad]", ("channels", n, "rmse"))
          for n in _keys(scored, "channels")),
        *((f"effort, {LABELS.get(n, n)} [V² s]", ("inputs", n, "effort"))
          for n in _keys(scored, "inputs")),
        ("step time, median [ms]", ("solver", "time_ms", "median")),
    ]  # fmt: skip
    told = [
        (words, values)
        for words, keys in figures
        if np.isfinite(values := [_number(log, keys) for log in logs]).any()
    ]
    if not told:
        raise Absent("the scores of these logs have no figure in common")
    height = 0.35 + 0.17 * len(logs)
    return [
        _bars(logs, words, values, height, i % 2 == 0) for i, (words, values) in enumerate(told)
    ]


def _bars(
    logs: Sequence[Plotted], words: str, values: Sequence[float], height: float, named: bool
) -> LogPanel:
    def draw(axes: Axes) -> None:
        for i, (_, value) in enumerate(zip(logs, values, strict=True)):
            look = curve_look(i)
            axes.barh(i, value if np.isfinite(value) else 0.0, height=0.62, color=look["color"],
                      zorder=2)  # fmt: skip
            text = f" {value:.3g}" if np.isfinite(value) else " –"
            axes.text(value if np.isfinite(value) else 0.0, i, text, va="center", color=INK)
        axes.set_ylim(len(logs) - 0.5, -0.5)
        known = [value for value in values if np.isfinite(value)]
        axes.set_xlim(0.0, 1.28 * max(known) if max(known) > 0 else 1.0)
        axes.set_yticks(range(len(logs)))
        names = [textwrap.fill(log.name, _NAME_LETTERS) for log in logs] if named else []
        axes.set_yticklabels(names if named else [""] * len(logs))
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_color(GREY)
        axes.set_xlabel(words)

    lines = max(len(textwrap.wrap(log.name, _NAME_LETTERS)) for log in logs)
    return LogPanel(draw, height * (1 + 0.5 * (lines - 1)), over_time=False, half=True)


def _keys(logs: Sequence[Plotted], part: str) -> list[str]:
    return list(dict.fromkeys(key for log in logs for key in log.log.score.get(part, {})))


def _number(log: Plotted, keys: Sequence[str]) -> float:
    """A figure of a log's score; NaN if there is none."""
    value: Any = log.log.score
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, (int, float)) else float("nan")
