"""Figures of a diagnosis: the race, the missing force, free runs, and the gap by horizon."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from trms_cli.gap.diagnosis import Gap, RaceEntry, Traces
from trms_cli.reporting.diagnosis_words import effect_words, is_suspect, percent
from trms_cli.reporting.style import (
    FAINT,
    GREY,
    INK,
    LABELS,
    MEASURED,
    PALE,
    PALE_SKY,
    PALETTE,
    house_style,
    legend_above,
    new_figure,
    thinned,
)

_WIDTH = 9.2
#: Models of the pictures: colour, width, line.
_RUNS = {
    "raw": ("as it was", GREY, 0.9, "--"),
    "refit": ("refitted", PALETTE["vermilion"], 1.1, "-"),
    "corrected": ("corrected", PALETTE["blue"], 1.2, "-"),
}
#: Competitors that are drawn.
_MOST_BARS = 14
#: s of the part of a force that is enlarged.
_ENLARGED = 15.0
#: Units as they are drawn.
_SHOWN = {"rad": ("mrad", 1e3), "N*m": ("mN m", 1e3), "N": ("mN", 1e3), "rad/s": ("rad/s", 1.0)}


def shown_unit(unit: str) -> tuple[str, float]:
    """A unit in which figures of this rig have few digits, and the factor to it."""
    return _SHOWN.get(unit, (unit.replace("*", " "), 1.0))


def entry_name(effects: Sequence[str]) -> str:
    """A competitor in words."""
    plain = {
        (): "parameters only",
        ("flexible",): "a force without a name",
        ("no_gap",): "the model as it was",
        ("none_of_these",): "none of these",
    }
    if tuple(effects) in plain:
        return plain[tuple(effects)]
    return " + ".join(effect_words(name) for name in effects)


def race_figure(
    race: Sequence[RaceEntry],
    confusable: Collection[Sequence[str]],
    best: Sequence[str] = (),
) -> Figure:
    """Bars of the held-out score of each competitor above the refitted model's.

    Parameters
    ----------
    confusable : collection of sequences of str
        Groups of effects that these recordings do not tell apart; those with the best are marked.
    best : sequence of str
        Effects of the likeliest cause; none: of the best score.
    """
    entries = sorted((e for e in race if np.isfinite(e.score)), key=lambda entry: -entry.score)
    kept = entries[:_MOST_BARS]
    kept += [e for e in entries[_MOST_BARS:] if not is_suspect(e.effects)]
    named = [e for e in kept if is_suspect(e.effects)]
    best = tuple(best) or (named[0].effects if named else ())
    group = {name for g in confusable if set(best) & set(g) for name in g}
    with house_style():
        figure = new_figure(_WIDTH, 0.8 + 0.27 * len(kept))
        panel = figure.subplots()
        tops = [e.score + e.se for e in kept if np.isfinite(e.score) and is_suspect(e.effects)]
        top = max([*tops, *(e.score for e in kept if np.isfinite(e.score)), 1.0])
        highest = max([e.score for e in named if np.isfinite(e.score)] + [1.0])
        low = min(0.0, max(min(e.score for e in kept), -0.25 * top))
        for i, entry in enumerate(kept):
            alike = bool(group & set(entry.effects)) and entry.effects != best
            score = max(entry.score, low)
            panel.barh(i, score, height=0.62, color=_bar_colour(entry, best, alike), zorder=2)
            if is_suspect(entry.effects) and entry.score >= low:
                panel.errorbar(score, i, xerr=entry.se, color=INK, lw=1.0, capsize=2.5, zorder=3)
            # No one closes more of the gap than its score does of the best one's.
            closed = max(0.0, min(entry.explained, entry.score / highest))
            words = percent(closed) + ("   confusable" if alike else "")
            panel.text(1.01, i, words, transform=panel.get_yaxis_transform(), va="center", size=8)
        panel.set_yticks(range(len(kept)), [entry_name(e.effects) for e in kept])
        for tick, entry in zip(panel.get_yticklabels(), kept, strict=True):
            tick.set_fontweight("bold" if entry.effects == best and best else "normal")
            tick.set_fontstyle("normal" if is_suspect(entry.effects) else "italic")
        panel.set_ylim(len(kept) - 0.5, -0.5)
        panel.grid(axis="y", visible=False)
        panel.axvline(0.0, color=GREY, lw=0.8)
        panel.set_xlim(1.05 * low, 1.04 * top)
        panel.set_xlabel("held-out log density above the refitted model [nats], ± standard error")
        panel.text(
            1.01, -0.8, "of the gap", transform=panel.get_yaxis_transform(), va="center", size=8,
            color=GREY,
        )  # fmt: skip
        return figure


def _bar_colour(entry: RaceEntry, best: Sequence[str], alike: bool) -> str:
    if not is_suspect(entry.effects):
        return FAINT
    if entry.effects == best:
        return PALETTE["blue"]
    return PALETTE["sky"] if alike else PALE_SKY


def force_figure(traces: Traces, locations: Sequence[str]) -> Figure | None:
    """The smoothed missing force at some places with its band, and what the cause says it is.

    None where nothing was smoothed. Of the first place a part is enlarged below.
    """
    shown = [name for name in locations if name in traces.force][:3]
    if not shown:
        return None
    with house_style():
        figure = new_figure(_WIDTH, 0.4 + 1.75 * (len(shown) + 1))
        panels = figure.subplots(len(shown) + 1, 1, squeeze=False)[:, 0]
        begin, end = _telling_part(traces, shown[0])
        for name, panel in zip(
            (shown[0], *shown), (panels[1], panels[0], *panels[2:]), strict=True
        ):
            _draw_force(panel, traces, name)
        panels[0].axvspan(begin, end, color=PALE, alpha=0.6, zorder=0)
        panels[1].set_xlim(begin, end)
        panels[1].set_ylabel(panels[1].get_ylabel() + "\nenlarged")
        for panel in (panels[0], *panels[2:]):
            panel.set_xlim(float(traces.force_time[0]), float(traces.force_time[-1]))
        panels[-1].set_xlabel("time [s]")
        legend_above(panels[0])
        figure.align_ylabels()
        return figure


def _draw_force(panel: Axes, traces: Traces, name: str) -> None:
    unit, scale = shown_unit(traces.force_unit.get(name, ""))
    time, force = thinned(traces.force_time, scale * np.asarray(traces.force[name]))
    if f"{name}.sd" in traces.force:
        _, sd = thinned(traces.force_time, scale * np.asarray(traces.force[f"{name}.sd"]))
        panel.fill_between(
            time, force - 2 * sd, force + 2 * sd, color=PALE, lw=0, label="± 2 sd", zorder=1
        )
    panel.plot(time, force, color=INK, lw=0.8, label="missing", zorder=2)
    if name in traces.explained:
        _, said = thinned(traces.force_time, scale * np.asarray(traces.explained[name]))
        colour = PALETTE["blue"]
        panel.plot(time, said, color=colour, lw=1.3, label="what the cause says", zorder=3)
    panel.axhline(0.0, color=GREY, lw=0.5, zorder=1)
    panel.set_ylabel(f"{name.replace('_', ' ')}\n[{unit}]")


def _telling_part(traces: Traces, name: str) -> tuple[float, float]:
    """The stretch in which the force (or what is said of it) has most energy."""
    time = np.asarray(traces.force_time, dtype=float)
    wanted = min(_ENLARGED, float(time[-1] - time[0]))
    values = np.nan_to_num(np.asarray(traces.explained.get(name, traces.force[name]), dtype=float))
    if not np.any(values):
        values = np.nan_to_num(np.asarray(traces.force[name], dtype=float))
    width = max(1, int(np.searchsorted(time - time[0], wanted)))
    if width >= len(time):
        return float(time[0]), float(time[-1])
    energy = np.convolve(values**2, np.ones(width), "valid")
    first = int(np.argmax(energy))
    return float(time[first]), float(time[min(first + width, len(time) - 1)])


def run_figure(traces: Traces) -> Figure | None:
    """A free run over the sealed part: measured, and the models; None without one."""
    if not traces.runs or len(traces.run_time) < 2:
        return None
    with house_style():
        figure = new_figure(_WIDTH, 0.5 + 1.6 * len(traces.runs))
        panels = figure.subplots(len(traces.runs), 1, sharex=True, squeeze=False)[:, 0]
        for panel, (channel, series) in zip(panels, traces.runs.items(), strict=True):
            angle = channel.startswith("alpha")
            unit, scale = ("rad", 1.0) if angle else ("rad/s", 1.0)
            measured = scale * np.asarray(series["measured"], dtype=float)
            time, values = thinned(traces.run_time, measured)
            panel.plot(time, values, color=MEASURED, lw=2.4, label="measured", zorder=1)
            for name, (words, colour, width, line) in _RUNS.items():
                if name in series:
                    time, values = thinned(traces.run_time, series[name])
                    panel.plot(
                        time, scale * values, color=colour, lw=width, ls=line, label=words, zorder=3
                    )
            _stay_near(panel, measured)
            panel.set_ylabel(f"{LABELS.get(channel, channel)}\n[{unit}]")
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(float(traces.run_time[0]), float(traces.run_time[-1]))
        legend_above(panels[0])
        figure.align_ylabels()
        return figure


def _stay_near(panel: Axes, measured: np.ndarray) -> None:
    """The measured range and as much again: a model that runs away shall not flatten the rest."""
    if not np.isfinite(measured).any():
        return
    low, high = float(np.nanmin(measured)), float(np.nanmax(measured))
    reach = 0.6 * (high - low) or 1.0
    bottom, top = panel.get_ylim()
    panel.set_ylim(max(bottom, low - reach), min(top, high + reach))


def gap_figure(gap: Mapping[str, Mapping[str, Gap]], *, corrected: bool = True) -> Figure | None:
    """The gap over the length of a free run, a panel a channel; None without a gap told.

    Parameters
    ----------
    corrected : bool
        Whether the corrected model is another one than the refitted.
    """
    channels = [name for name, rows in gap.items() if rows]
    if not channels:
        return None
    with house_style():
        figure = new_figure(_WIDTH, 2.55 if len(channels) > 1 else 2.8)
        panels = figure.subplots(1, len(channels), sharex=True, squeeze=False)[0]
        for panel, channel in zip(panels, channels, strict=True):
            rows = sorted((float(h), row) for h, row in gap[channel].items())
            horizons = [h for h, _ in rows]
            unit, scale = shown_unit(rows[0][1].unit)
            for name, (words, colour, width, line) in _RUNS.items():
                if name == "corrected" and not corrected:
                    continue
                values = [scale * getattr(row, name) for _, row in rows]
                panel.loglog(
                    horizons, values, color=colour, lw=width + 0.3, ls=line, marker="o", ms=3.5,
                    label=words,
                )  # fmt: skip
            floor = [scale * row.floor for _, row in rows]
            panel.loglog(horizons, floor, color=INK, lw=1.0, ls=":", label="floor")
            panel.set_title(f"{LABELS.get(channel, channel)} [{unit}]")
            panel.set_xticks(horizons, [f"{h:g}" for h in horizons])
            panel.minorticks_off()
            _plain_ticks(panel)
        figure.supxlabel("length of the free run [s]", size=9)
        handles, words = panels[0].get_legend_handles_labels()
        figure.legend(handles, words, loc="outside upper left", ncols=4, fontsize=8, frameon=False)
        return figure


def _plain_ticks(panel: Axes) -> None:
    """A few round numbers within the range: decades alone leave most panels without any."""
    low, high = panel.get_ylim()
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    steps = (1,) if high > 100 * low else (1, 2, 5) if high > 5 * low else (1, 1.5, 2, 3, 4, 5, 7)
    ticks = [m * 10.0**d for d in decades for m in steps if low <= m * 10.0**d <= high]
    panel.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
