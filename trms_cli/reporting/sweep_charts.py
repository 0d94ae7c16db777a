"""Charts of what a sampler had to say: the front of a search, or how draws spread."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from trms_cli.core.chart import (
    CURVES,
    Axis,
    Bars,
    Chart,
    Curve,
    Line,
    Mark,
    Panel,
    Points,
    curve_look,
)
from trms_cli.scoring.figures import column_title
from trms_cli.sweeps.findings import baseline_of, choices_of, front_of
from trms_cli.sweeps.space import short_keys

Trial = Mapping[str, Any]
#: A figure of a trial.
Pick = Callable[[Trial], float]
#: Pairs of objectives that are drawn: of three all, of more the first.
_MOST_PANELS = 3
#: Share of the width beside the front and the baseline in which tried ones are shown.
_ROOM = 0.6
#: Share of the height above the highest and below the lowest of a search.
_MARGIN = 0.05
#: So many drawn values are shown for each figure.
_MOST_BARS = 12
_LEVEL = 0.05
#: Widest that a picture gets, inches.
_WIDEST = 11.0


def summary_charts(summary: Mapping[str, Any]) -> list[Chart]:
    """Charts of a sweep's summary; none of a sampler that says nothing, or where nothing worked."""
    match summary.get("kind"):
        case "optimisation" if len(summary["trials"]) > 1 and summary["pareto"]:
            return [_front(summary) if len(summary["objectives"]) > 1 else _search(summary)]
        case "robustness":
            return [*_robustness(summary), *_sensitivity(summary)]
    return []


def _front(summary: Mapping[str, Any]) -> Chart:
    """The trials in the plane of each two objectives, the front and the baseline marked."""
    pairs = list(combinations(summary["objectives"], 2))[:_MOST_PANELS]
    panels = [_plane(summary, *pair) for pair in pairs]
    volumes = [v for v in summary["history"] if v is not None]
    words = [f"{len(summary['pareto'])} on the front"]
    if len(summary["objectives"]) == 2 and volumes:
        words.append(f"hypervolume {volumes[-1]:.3f} of 1.21")
    outside = {
        trial["trial"]
        for panel, (one, other) in zip(panels, pairs, strict=True)
        for trial in _ran(summary)
        if not _is_inside(panel, trial["figures"][one["name"]], trial["figures"][other["name"]])
    }
    panels[0] = _titled(panels[0], summary, words, len(outside))
    width = 6.2 if len(pairs) == 1 else 4.4
    return Chart("pareto", panels, columns=len(pairs), width=width, height=4.4)


def _plane(summary: Mapping[str, Any], one: Mapping[str, Any], other: Mapping[str, Any]) -> Panel:
    x, y = _figure(one["name"]), _figure(other["name"])
    front, before = sorted(front_of(summary), key=x), baseline_of(summary)
    first = [before] if before is not None and before["figures"] else []
    plane = len(summary["objectives"]) == 2
    marks = [
        *_trial_marks(summary, x, y),
        _points(front, x, y, "front", "dot", "blue", 5.5, step_shape="hv" if plane else ""),
        *_again(front, one["name"], other["name"], "front, fresh conditions", "unstable", "green"),
    ]
    if first:
        marks.append(_points(first, x, y, "as it was", "diamond", "vermilion", 7.0))
        marks += _again(first, one["name"], other["name"], "", "saddle", "vermilion")
    across, up = (
        Axis(column_title(each["name"], each["unit"]), limits=_near(summary, front + first, each))
        for each in (one, other)
    )
    return Panel(across, up, marks)


def _search(summary: Mapping[str, Any]) -> Chart:
    """The objective of each trial, and the best so far."""
    (objective,) = summary["objectives"]
    number, value = (lambda trial: float(trial["trial"])), _figure(objective["name"])
    trials, before = summary["trials"], baseline_of(summary)
    so_far = [math.nan if best is None else best for best in summary["history"]]
    marks: list[Mark] = [
        *_trial_marks(summary, number, value),
        Curve([number(trial) for trial in trials], so_far, "best so far", is_step=True),
    ]
    if before is not None and before["figures"]:
        marks.append(Line(y=value(before), colour="vermilion", style="dashed"))
        marks.append(_points([before], number, value, "as it was", "diamond", "vermilion", 7.0))
    values = np.array([value(trial) for trial in _ran(summary)])
    limits = _without_outliers(values, objective["direction"] == "maximise")
    axis = Axis(column_title(objective["name"], objective["unit"]), limits=limits)
    panel = Panel(Axis("trial"), axis, marks)
    visible_count = sum(_is_inside(panel, number(trial), value(trial)) for trial in _ran(summary))
    return Chart(
        "search", [_titled(panel, summary, (), len(values) - visible_count)], width=6.6, height=3.6
    )


def _figure(name: str) -> Pick:
    return lambda trial: float(trial["figures"][name])


def _ran(summary: Mapping[str, Any]) -> list[Trial]:
    return [trial for trial in summary["trials"] if trial["figures"]]


def _trial_marks(summary: Mapping[str, Any], x: Pick, y: Pick) -> list[Mark]:
    ran = _ran(summary)
    beyond = [trial for trial in ran if not trial["allowed"]]
    within = [trial for trial in ran if trial["allowed"]]
    marks = [_points(beyond, x, y, "beyond a limit", "cross", "alarm", 4.5)] if beyond else []
    return [*marks, _points(within, x, y, "tried", "dot", "measured", 3.6)]


def _points(
    trials: Sequence[Trial],
    x: Pick,
    y: Pick,
    label: str,
    marker: Any,
    colour: Any,
    size: float,
    **how: Any,
) -> Mark:
    names = [f"trial {trial['trial']}" for trial in trials]
    places = [x(trial) for trial in trials], [y(trial) for trial in trials]
    return Points(*places, label, marker, colour, size=size, tooltips=names, **how)


def _again(
    trials: Sequence[Trial], one: str, other: str, label: str, marker: Any, colour: Any
) -> list[Mark]:
    """Where trials land under fresh conditions, each joined to where it was."""
    confirmed = [t for t in trials if _confirmed(t, one) and _confirmed(t, other)]
    marks: list[Mark] = []
    for trial in confirmed:
        ends = [trial["figures"], trial["confirmed"]["figures"]]
        path = [end[one] for end in ends], [end[other] for end in ends]
        marks.append(Curve(*path, colour="grey", width=0.6))
    fresh = [{**trial, "figures": trial["confirmed"]["figures"]} for trial in confirmed]
    landed = _points(fresh, _figure(one), _figure(other), label, marker, colour, 5.0)
    return [*marks, landed] if fresh else []


def _confirmed(trial: Trial, name: str) -> bool:
    return name in trial.get("confirmed", {}).get("figures", {})


def _near(
    summary: Mapping[str, Any], marked: Sequence[Trial], objective: Mapping[str, Any]
) -> tuple[float, float]:
    """A trial that is bad beyond measure must not flatten the front."""
    name = objective["name"]
    again = [t["confirmed"]["figures"][name] for t in marked if _confirmed(t, name)]
    values = [trial["figures"][name] for trial in marked] + again
    everyone = [trial["figures"][name] for trial in _ran(summary)] + again
    low, high = min(values), max(values)
    span = (high - low) or abs(high) or 1.0
    return (
        max(low - 0.08 * span, min(everyone) - 0.04 * span),
        min(high + _ROOM * span, max(everyone) + 0.04 * span),
    )


def _without_outliers(values: np.ndarray, maximised: bool) -> tuple[float, float] | None:
    """Trials that are bad beyond measure are cut off, so that the others can be told apart."""
    low, high = float(values.min()), float(values.max())
    middle = float(np.median(values))
    if maximised:
        low = max(low, middle - 3 * (high - middle))
    else:
        high = min(high, middle + 3 * (middle - low))
    room = _MARGIN * (high - low)
    return (low - room, high + room) if high > low else None


def _is_inside(panel: Panel, x: float, y: float) -> bool:
    for axis, value in ((panel.x, x), (panel.y, y)):
        low, high = axis.limits or (None, None)
        if (low is not None and value < low) or (high is not None and value > high):
            return False
    return True


def _titled(panel: Panel, summary: Mapping[str, Any], words: Sequence[str], outside: int) -> Panel:
    """How many trials there are, and how many of them are not to be seen."""
    trials = summary["trials"]
    failed = len(trials) - len(_ran(summary))
    unseen = [f"{outside} outside the frame"] * bool(outside) + [f"{failed} failed"] * bool(failed)
    lines = [", ".join([f"{len(trials)} trials by {summary['method']}", *words])]
    lines += [f"not shown: {', '.join(unseen)}"] if unseen else []
    return replace(panel, title="\n".join(lines))


def _robustness(summary: Mapping[str, Any]) -> list[Chart]:
    """Share of the draws up to each value of a figure: a steep curve far left is robust."""
    groups, shares = summary["groups"], np.linspace(0, 100, 101)
    names = [name for name in summary["figures"] if any(name in g["figures"] for g in groups)]
    panels: list[Panel] = []
    for name in names:
        marks: list[Mark] = []
        for i, group in enumerate(groups):
            if (statistics := group["figures"].get(name)) is not None:
                # Draws without the figure failed: the curve ends below 100 %.
                share, look = (
                    statistics["draws"] / max(group["failures"]["draws"], 1),
                    curve_look(i),
                )
                curve = Curve(statistics["percentiles"], share * shares, _words(group), **look)
                marks += [
                    curve,
                    Points([statistics["median"]], [50 * share], colour=look["colour"]),
                ]
        if (limit := summary["limits"].get(name)) is not None:
            marks.append(Line(x=limit, label="limit", colour="alarm", style="solid"))
        axis = Axis(column_title(name, summary["figures"][name]["unit"]))
        panels.append(
            Panel(
                axis,
                Axis("" if panels else "share of the draws", "" if panels else "%", (0.0, 101.0)),
                marks,
            )
        )
    return _side_by_side("robustness", panels, 3.7)


def _sensitivity(summary: Mapping[str, Any]) -> list[Chart]:
    """Rank correlations of drawn values with each figure, strongest first; by chance pale."""
    groups, short = summary["groups"], short_keys(summary["varied"])
    looks = [CURVES[i % len(CURVES)] for i in range(len(groups))]
    legend = [
        Points([], [], _words(group), "square", look)
        for group, look in zip(groups, looks, strict=True)
    ]
    legend.append(Points([], [], "not distinguishable from chance", "square", "pale"))
    panels, most = [], 0
    for name in summary["figures"]:
        correlations = [
            {e["key"]: e for e in g["sensitivity"] if e["figure"] == name} for g in groups
        ]
        strength: dict[str, float] = {}
        for each in (each for own in correlations for each in own.values()):
            strength[each["key"]] = max(strength.get(each["key"], 0.0), abs(each["rho"]))
        keys = sorted(strength, key=lambda key: -strength[key])[:_MOST_BARS]
        if not keys:
            continue
        rows = [(key, i, own.get(key)) for key in keys for i, own in enumerate(correlations)]
        bars = Bars(
            [short[key] if i == 0 else "" for key, i, _ in rows],
            [math.nan if each is None else each["rho"] for _, _, each in rows],
            [looks[i] if each and each["p"] < _LEVEL else "pale" for _, i, each in rows],
        )
        most = max(most, len(rows))
        panels.append(
            Panel(
                Axis("rank correlation", limits=(-1.0, 1.0)),
                Axis(""),
                [bars, *legend],
                column_title(name),
            )
        )
    return _side_by_side("sensitivity", panels, 1.4 + 0.17 * most)


def _side_by_side(name: str, panels: Sequence[Panel], height: float) -> list[Chart]:
    count = len(panels)
    if not count:
        return []
    width = min(3.4 * count + 0.8, _WIDEST) / count
    return [Chart(name, panels, columns=count, width=width, height=height)]


def _words(group: Mapping[str, Any]) -> str:
    """``pid``, or ``controller=pid ref=sine`` where several things were chosen."""
    options = list(group["choices"].values())
    if len(options) == 1:
        return str(options[0])
    return choices_of(group) if options else "all draws"
