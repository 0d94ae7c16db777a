"""Figures of networks: how they learn, how far they run freely, which structure is enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle
from matplotlib.ticker import FixedLocator, NullLocator

from trms_cli.core.wording import SIGNALS
from trms_cli.reporting.style import (
    ALARM,
    GREY,
    INK,
    MEASURED,
    PALE,
    PALETTE,
    house_style,
    legend_above,
    new_figure,
    save_png,
    thin_every,
)

FloatArray = npt.NDArray[np.float64]

_WIDTH, _ROW_HEIGHT = 11.0, 1.9
#: s, where the axis of time begins.
_SHORTEST = 2e-3
_ORDER = ("blue", "vermilion", "green", "purple", "orange", "sky")
_DASHES = ("-", (0, (4, 1.5)), (0, (1, 1.2)))


@dataclass(frozen=True)
class LearningCurve:
    """The loss of one training."""

    label: str
    #: (n,) array; normalised mean squared error after each epoch, from epoch 0 on
    losses: FloatArray
    seconds: FloatArray  #: (n,) array; time until then


@dataclass(frozen=True)
class Spread:
    """One training algorithm over several starts."""

    label: str
    errors: FloatArray  #: (n,) array; one a start; infinite after a divergence
    seconds: FloatArray  #: (n,) array


@dataclass(frozen=True)
class Correlation:
    """One correlation test of residuals."""

    title: str
    #: ``lags``, ``values``, ``band``: (n,) arrays; correlation at each lag and the half width of
    #: its confidence band
    lags: FloatArray
    values: FloatArray
    band: FloatArray
    failed: bool


@dataclass(frozen=True)
class ResponseRow:
    """One network of a page: how it runs freely, what it leaves."""

    label: str
    runs: Mapping[str, FloatArray]  #: By angle, (n,) arrays; not finite after a divergence
    errors: Mapping[str, float]  #: By angle, RMS of the run in mrad; infinite after a divergence
    correlations: Mapping[str, Sequence[Correlation]]  #: By angle: of residuals one step ahead


def draw_learning(curves: Sequence[LearningCurve], path: Path, *, title: str = "") -> None:
    """Root mean square error over epochs and over time, a curve a training."""
    with house_style():
        figure = new_figure(_WIDTH, 4.2)
        panels = figure.subplots(1, 2, sharey=True)
        for i, curve in enumerate(curves):
            style = {
                "color": PALETTE[_ORDER[i % len(_ORDER)]],
                "ls": _DASHES[i // len(_ORDER) % len(_DASHES)],
                "lw": 1.3,
            }
            error = np.sqrt(curve.losses)
            panels[0].plot(np.arange(len(error)), error, label=curve.label, **style)
            panels[1].plot(curve.seconds, error, **style)
        panels[0].set_xscale("symlog", linthresh=10)
        panels[0].set_xlim(left=0)
        panels[0].set_xlabel("epoch")
        panels[1].set_xscale("log")
        panels[1].set_xlim(left=_SHORTEST)
        panels[1].set_xlabel("processor time [s]")
        panels[0].set_yscale("log")
        errors = [np.sqrt(loss) for curve in curves for loss in curve.losses]
        _few_ticks(panels[0].yaxis, errors)
        panels[0].set_ylabel("RMS error of the fitted data,\none step [spread of a step]")
        figure.legend(
            *panels[0].get_legend_handles_labels(), loc="outside right center", frameon=False
        )
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
        save_png(figure, path)


def draw_spread(
    rows: Sequence[Spread], path: Path, *, unit: str, what: str, title: str = ""
) -> None:
    """Error and time of each training, a dot a start, the median as a bar."""
    with house_style():
        figure = new_figure(_WIDTH, 0.9 + 0.3 * len(rows))
        left, right = figure.subplots(1, 2, sharey=True)
        finite = [e for row in rows for e in row.errors if np.isfinite(e)]
        for i, row in enumerate(rows):
            divergences = int(np.count_nonzero(~np.isfinite(row.errors)))
            _dots(left, i, row.errors[np.isfinite(row.errors)], PALETTE["blue"])
            _dots(right, i, row.seconds, PALETTE["vermilion"])
            if divergences:
                words = f"{divergences} of {len(row.errors)} diverged"
                left.annotate(
                    words, (1.0, i), (-4, 0), xycoords=("axes fraction", "data"),
                    textcoords="offset points", ha="right", va="center", fontsize=8, color=ALARM,
                )  # fmt: skip
        left.set_yticks(range(len(rows)), [row.label for row in rows])
        left.invert_yaxis()
        for panel, words in (
            (left, f"{what} [{unit}]"),
            (right, "processor time of a training [s]"),
        ):
            panel.set_xscale("log")
            panel.set_xlabel(words)
            panel.grid(axis="y", visible=False)
        if finite:
            left.set_xlim(0.8 * min(finite), 1.25 * max(finite))
            _few_ticks(left.xaxis, finite)
        right.xaxis.set_minor_locator(NullLocator())
        right.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
        save_png(figure, path)


def draw_free_runs(
    time: FloatArray,
    measured: Mapping[str, FloatArray],
    runs: Mapping[str, Mapping[str, FloatArray]],
    commands: Mapping[str, FloatArray],
    units: Mapping[str, str],
    path: Path,
    *,
    title: str = "",
) -> None:
    """Measured against free runs of several networks, a row an output, the commands below."""
    with house_style():
        rows = len(measured) + 1
        figure = new_figure(_WIDTH, 0.7 + _ROW_HEIGHT * rows)
        panels = figure.subplots(rows, 1, sharex=True)
        for panel, (name, values) in zip(panels, measured.items(), strict=False):
            panel.plot(*thin_every(time, values), color=MEASURED, lw=2.6, label="measured")
            for colour, (label, run) in zip(_ORDER[:1] + _ORDER[1:], runs.items(), strict=False):
                panel.plot(*thin_every(time, run[name]), color=PALETTE[colour], lw=1.0, label=label)
            _stay_near(panel, values)
            panel.set_ylabel(f"{SIGNALS.get(name, name)}\n[{units[name]}]")
        legend_above(panels[0])
        for colour, (name, values) in zip(_ORDER, commands.items(), strict=False):
            panels[-1].plot(
                *thin_every(time, values), color=PALETTE[colour], lw=0.8, drawstyle="steps-post",
                label=SIGNALS.get(name, name),
            )  # fmt: skip
        panels[-1].set_ylabel("command\n[V]")
        if len(commands) > 1:
            legend_above(panels[-1])
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(float(time[0]), float(time[-1]))
        figure.align_ylabels()
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
        save_png(figure, path)


def draw_structure(
    lags: Sequence[int],
    hidden: Sequence[int],
    errors: FloatArray,
    selection: tuple[int, int],
    path: Path,
    *,
    title: str = "",
) -> None:
    """Map of errors over lags and hidden units, with the spread over starts in each cell.

    ``errors``: (n_lags, n_hidden, n_starts) array; infinite after a divergence. ``selection``: lags
    and hidden units of the selected structure.
    """
    with house_style():
        figure = new_figure(1.9 + 1.35 * len(hidden), 1.5 + 0.75 * len(lags))
        panel = figure.subplots()
        median = np.median(errors, axis=2)
        finite_median = np.where(np.isfinite(median), median, np.nan)
        least, most = float(np.nanmin(finite_median)), float(np.nanmax(finite_median))
        norm = LogNorm(least, max(most, 1.01 * least))
        picture = panel.imshow(finite_median, cmap="viridis_r", aspect="auto", norm=norm)
        bright = np.sqrt(least * most)
        for i, j in np.ndindex(median.shape):
            low, high = errors[i, j].min(), errors[i, j].max()
            words = f"{_short(float(median[i, j]))}\n{_short(low)}–{_short(high)}"
            colour = "white" if finite_median[i, j] > bright else INK
            panel.text(j, i, words, ha="center", va="center", fontsize=8, color=colour)
        row, column = list(lags).index(selection[0]), list(hidden).index(selection[1])
        panel.add_patch(_frame(column, row))
        panel.set_xticks(range(len(hidden)), [str(units) for units in hidden])
        panel.set_yticks(range(len(lags)), [str(count) for count in lags])
        panel.set_xlabel("hidden units")
        panel.set_ylabel("lags of outputs and inputs")
        panel.grid(visible=False)
        for side in ("left", "bottom"):
            panel.spines[side].set_visible(False)
        bar = figure.colorbar(picture, ax=panel, shrink=0.9)
        bar.set_label("median")
        _few_ticks(bar.ax.yaxis, [least, most])
        panel.set_title(title, fontsize=10, fontweight="bold", color=INK)
        save_png(figure, path)


def draw_correlations(tests: Sequence[Correlation], path: Path, *, title: str = "") -> None:
    """Correlation tests of residuals with their bands, four in a row."""
    columns = 4
    rows = -(-len(tests) // columns)
    with house_style():
        figure = new_figure(_WIDTH, 0.6 + 1.7 * rows)
        panels = figure.subplots(rows, columns, squeeze=False)
        for panel, test in zip(panels.flat, tests, strict=False):
            _draw_correlation(panel, test)
            panel.set_title(test.title, fontsize=9, color=ALARM if test.failed else INK)
        for panel in list(panels.flat)[len(tests) :]:
            panel.set_visible(False)
        for panel in panels[-1]:
            panel.set_xlabel("lag [samples]")
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
        save_png(figure, path)


def draw_responses(
    time: FloatArray,
    measured: Mapping[str, FloatArray],
    rows: Sequence[ResponseRow],
    path: Path,
    *,
    title: str = "",
) -> None:
    """A row a network: the free run of each angle over the measured one, and its correlations.

    ``title``: said above, with what colours mean.
    """
    tests = {angle: len(rows[0].correlations[angle]) for angle in measured}
    wide = 6.0 / len(measured)
    ratios = [ratio for angle in measured for ratio in (wide, *[1.35] * tests[angle])]
    with house_style():
        figure = new_figure(1.1 * _WIDTH, 1.0 + 0.98 * len(rows))
        panels = figure.subplots(
            len(rows), len(ratios), squeeze=False, gridspec_kw={"width_ratios": ratios}
        )
        for i, row in enumerate(rows):
            column = 0
            for angle, values in measured.items():
                panel = panels[i, column]
                panel.plot(*thin_every(time, values), color=MEASURED, lw=2.0, label="measured")
                panel.plot(
                    *thin_every(time, row.runs[angle]), color=PALETTE["blue"], lw=0.9,
                    label="free run",
                )  # fmt: skip
                _stay_near(panel, values)
                panel.set_xlim(float(time[0]), float(time[-1]))
                panel.annotate(
                    _milliradians(row.errors[angle]), (0.995, 0.97), xycoords="axes fraction",
                    ha="right", va="top", fontsize=7.5, color=INK,
                )  # fmt: skip
                if i == 0:
                    panel.set_title(f"{SIGNALS.get(angle, angle)} [rad]", fontsize=9)
                for test, place in zip(
                    row.correlations[angle], panels[i, column + 1 :], strict=False
                ):
                    _draw_correlation(place, test)
                    if len(test.lags):
                        place.set_xlim(0.0, 1.1 * float(test.lags[-1]))
                    if i == 0:
                        place.set_title(test.title, fontsize=9)
                column += 1 + tests[angle]
            panels[i, 0].set_ylabel(row.label, rotation=0, ha="right", va="center", color=INK)
        for panel in panels.flat:
            panel.tick_params(labelsize=7.5)
        for panel in panels[:-1].flat:
            panel.tick_params(labelbottom=False)
        at_response = np.cumsum([0, *[1 + count for count in tests.values()]])[:-1]
        for column, panel in enumerate(panels[-1]):
            panel.set_xlabel("time [s]" if column in at_response else "lag", fontsize=8.5)
        figure.align_ylabels()
        title = f"{title}. Measured grey, free run blue; tests that fail red"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
        save_png(figure, path)


def _draw_correlation(panel: Axes, test: Correlation) -> None:
    """One test with its band, red where it fails."""
    colour = ALARM if test.failed else PALETTE["blue"]
    panel.fill_between(test.lags, -test.band, test.band, color=PALE, lw=0)
    panel.vlines(test.lags, 0, test.values, color=colour, lw=1.2)
    panel.plot(test.lags, test.values, "o", ms=2.0, color=colour)
    panel.axhline(0, color=GREY, lw=0.6)
    sizes = np.abs(np.concatenate([test.values, test.band]))
    reach = 1.25 * float(np.max(sizes[np.isfinite(sizes)], initial=0.1))
    panel.set_ylim(-reach, reach)


def _dots(panel: Axes, row: int, values: FloatArray, colour: str) -> None:
    if not len(values):
        return
    panel.plot(values, np.full(len(values), row), "o", ms=4.5, mew=0, alpha=0.6, color=colour)
    middle = float(np.median(values))
    panel.plot([middle, middle], [row - 0.32, row + 0.32], color=INK, lw=1.6)


def _few_ticks(axis: Axis, values: Sequence[float]) -> None:
    """Round ticks over a range that may be less than a decade."""
    low, high = min(values), max(values)
    steps = [1.0, 1.5, 2.0, 3.0, 5.0, 7.0] if high / low < 8 else [1.0, 2.0, 5.0]
    steps = steps if high / low < 60 else [1.0]
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(lambda value, _: f"{value:g}")


def _stay_near(panel: Axes, measured: FloatArray) -> None:
    """A run that diverges must not flatten what was measured."""
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    room = 0.35 * (high - low)
    panel.set_ylim(low - room, high + room)


def _short(value: float) -> str:
    if not np.isfinite(value):
        return "∞"
    return f"{value:.2g}" if value < 1000 else ">1000"


def _milliradians(value: float) -> str:
    return f"RMS {value:.3g} mrad" if value < 1000 else "RMS > 1 rad"


def _frame(column: int, row: int) -> Rectangle:
    return Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, ec=ALARM, lw=2.2)
