"""``study=phase_portrait``: how a model, or a closed loop, moves in two or three of its states."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Chart
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import (
    Column,
    Datum,
    Findings,
    Measure,
    Section,
    Table,
    json_data,
    table,
)
from trms_cli.core.wording import listing, symbol
from trms_cli.models.model import by_name
from trms_cli.stability.portraits.charts import PortraitResult, has_field, is_hidden, portrait
from trms_cli.stability.portraits.invariant_sets import (
    RestPoint,
    StickingSet,
    grid,
    halving_time,
    has_impulses,
    period,
    rest_point,
    search,
    separatrices,
    sticking_sets,
)
from trms_cli.stability.portraits.section import StateSection, section_of
from trms_cli.stability.portraits.trajectories import (
    DEFAULT_COUNT,
    LOOP_COUNT,
    NEAR,
    TrajectoryEnd,
    checked_window,
    default_starts,
    default_window,
    ends_of,
    given_starts,
    loop_starts,
    loop_trajectories,
    trajectories,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts, Subject

#: s: of a trajectory of a loop; least and longest of the model alone.
_LOOP_DURATION, _LEAST, _LONGEST = 20.0, 1.0, 150.0
#: Time constants of the slowest mode after which 0.7 % of a swing is left.
_TIME_CONSTANTS = 5.0
#: s for which separatrices are followed.
_SEPARATRIX = 25.0
#: Points of all trajectories together.
_MOST_POINTS = 1e7
#: Widths by which trajectories of a loop widen its window at most, to each side.
_MOST_WIDENED = 2.0
_INVARIANCE_GRID = {2: 11, 3: 5}


@dataclass(frozen=True, kw_only=True)
class PhasePortrait:
    """Trajectories, nullclines, equilibria and separatrices."""

    #: Two or three states, or rates of angles (``rate_v`` is dα_v/dt); None: the first axis' angle
    #: and rate, or the two states of a motor
    states: tuple[str, ...] | None = None
    #: Operating point: controlled angles (rad) or commands (V); empty: rest without command
    at: Mapping[str, float] = field(default_factory=dict)
    #: Limits by coordinate; others are chosen
    window: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: How many, or each by coordinates and other states; None: 28 in a plane, 16 in space, 8 for a
    #: loop
    starts: Annotated[int, Meta(ge=1, le=500)] | tuple[Mapping[str, float], ...] | None = None
    #: The states that are no coordinates: held at the operating point, or where their own rates are
    #: zero; names: these settle, the others are held
    others: Literal["held", "settled"] | tuple[str, ...] = "held"
    #: s of a trajectory; None: five time constants of the slowest mode, 20 s for a loop
    duration: Annotated[float, Meta(gt=0, le=1000)] | None = None
    #: s between two points of a trajectory of the model alone
    step: Annotated[float, Meta(ge=1e-4, le=0.5)] = 0.02
    open_loop_too: bool = False  #: For a loop: trajectories without the controller beside it

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """The portrait.

        Raises ConfigurationError, ModelError for a model that only steps or has a single state, and
        for names and limits that make no window.
        """
        model = subject.require_equations("study=phase_portrait")
        tell("operating point")
        section = section_of(model, self.states, self.at, self.others)
        limits = checked_window(section.coordinates, self.window)
        if subject.loop is None:
            return self._of_model(section, limits, tell)
        return self._of_loop(section, limits, subject.loop, tell)

    def _of_model(
        self, section: StateSection, limits: Mapping[int, tuple[float, float]], tell: Tell
    ) -> Findings:
        """The model alone, its command held."""
        n = len(section.coordinates)
        tell("window and equilibria")
        window = default_window(section, limits)
        rests = search(section, window)
        invariant = section.is_invariant(grid(window, _INVARIANCE_GRID[n]).reshape(-1, n))
        duration = self.duration or _settling(rest_point(section, section.point.x))
        if isinstance(self.starts, tuple):
            starts = given_starts(section, self.starts)
        else:
            starts = default_starts(section, window, self.starts or DEFAULT_COUNT[n])
        if not len(starts):
            raise ConfigurationError(
                "nowhere in the window have the settled states a value",
                where="others",
                remedy="hold them: study.others=held",
            )
        points = len(starts) * duration / self.step
        if points > _MOST_POINTS:
            raise ConfigurationError(
                f"{len(starts)} trajectories of {duration:g} s by steps of {self.step:g} s are "
                f"{points:.2g} points",
                where="step",
                remedy=f"stay below {_MOST_POINTS:.0e}: by a longer step, fewer starts, or a "
                "shorter duration",
            )
        rubs = has_impulses(section.coordinates.model)
        if rubs:
            tell("sticking sets")
        sticking = sticking_sets(section, window, rests)
        tell("trajectories")
        while True:
            paths = trajectories(section, starts, duration, self.step)
            ends = ends_of(section, window, rests, paths, sticking, dry_friction=rubs)
            moving = any(end.what == "moving" for end in ends)
            if self.duration is not None or not moving or 2 * duration > _LONGEST:
                break
            # Away from the operating point a model may be slower than its slowest mode there.
            duration *= 2
        duration = float(paths[0].time[-1])
        tell("separatrices")
        manifolds = [
            path
            for rest in ([] if rubs else rests)
            for path in separatrices(section, invariant, window, rest, _SEPARATRIX)
        ]
        result = PortraitResult(
            section, window, rests, paths, ends, duration, invariant, manifolds, sticking
        )
        parts = [
            Section("The portrait", of_model(result, rubs), [chart(result)]),
            Section("Equilibria in the window", (), [equilibria_table(section, rests)]),
            ends_section(result),
        ]
        data = json_data(_results(result))
        lead, warnings = lead_of_model(result), _warnings(result)
        measures = _measures(result)
        return Findings("Phase portrait", lead, parts, data, warnings, measures)

    def _of_loop(
        self,
        section: StateSection,
        limits: Mapping[int, tuple[float, float]],
        loop: LoopParts,
        tell: Tell,
    ) -> Findings:
        """The loop around the model, its references at the operating point."""
        tell("window")
        window = default_window(section, limits, around=True)
        duration = self.duration or _LOOP_DURATION
        if isinstance(self.starts, tuple):
            starts = given_starts(section, self.starts)
        else:
            starts = loop_starts(section, window, self.starts or LOOP_COUNT)
        paths, runs = loop_trajectories(section, loop, starts, duration, tell)
        name, failures = loop.names["controller"], sum(run.failures for run in runs)
        ended = [run.stop_reason for run in runs if run.stop_reason]
        window = _around(window, np.concatenate([run.c for run in paths]), limits)
        goal = rest_point(section, section.point.x)
        ends = ends_of(section, window, [goal], paths, search_beyond=False)
        beside = trajectories(section, starts, duration, self.step) if self.open_loop_too else ()
        result = PortraitResult(
            section, window, [], paths, ends, duration, beside=beside, loop=name
        )
        at_bound = float(np.mean(np.concatenate([run.saturated for run in paths])))
        parts = [
            Section("The portrait", of_loop(result, loop.names["observer"]), [chart(result)]),
            ends_section(result),
        ]
        results = _results(result) | {
            "controller": name,
            "share_at_bound": at_bound,
            "failed_solves": failures,
            "ended_early": len(ended),
        }
        warnings = _warnings(result)
        if ended:
            warnings.insert(0, f"{len(ended)} runs ended early: {ended[0]}")
        if failures:
            failed = f"{failures} control samples' solves failed; the fall-back acted"
            warnings.insert(0, failed)
        lead = lead_of_loop(result, at_bound)
        title, measures = f"Phase portrait under {name}", _measures(result)
        return Findings(title, lead, parts, json_data(results), warnings, measures)


def _settling(rest: RestPoint) -> float:
    """s until the slowest mode of an equilibrium is over."""
    decaying = [-value.real for value in rest.eigenvalues if value.real < -1e-9]
    if not decaying:
        return _LOOP_DURATION
    return float(np.clip(round(_TIME_CONSTANTS / min(decaying), 1), _LEAST, _LONGEST))


def _around(
    window: FloatArray, visited: FloatArray, limits: Mapping[int, tuple[float, float]]
) -> FloatArray:
    """A window widened to what was visited; what was given stays."""
    rows = visited[np.isfinite(visited).all(axis=1)]
    wide_window = window.copy()
    for place in range(len(window)):
        if place not in limits and len(rows):
            low = min(window[place, 0], rows[:, place].min())
            high = max(window[place, 1], rows[:, place].max())
            # What runs away does not set the scale.
            most = _MOST_WIDENED * (window[place, 1] - window[place, 0])
            margin = 0.04 * (high - low)
            wide_window[place] = (
                max(low - margin, window[place, 0] - most),
                min(high + margin, window[place, 1] + most),
            )
    return wide_window


#: A mode this much faster than the slowest one is told apart in words.
_MUCH_FASTER = 20.0


def short(value: float) -> str:
    """Three digits behind what matters; rounding is zero."""
    return "0" if abs(value) < 5e-7 else f"{value:.4g}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def commands(section: StateSection) -> str:
    """``u_v = 1.413 V``."""
    model = section.coordinates.model
    return ", ".join(
        f"{signal.name} = {short(float(value))}{_unit(signal.unit)}"
        for signal, value in zip(model.inputs, section.point.u, strict=True)
    )


def place(section: StateSection, rest: RestPoint) -> str:
    """``α_v = 1.903 rad``: by the first coordinate that is no rate, the others where not zero."""
    parts = [
        f"{item.label} = {short(float(value))}{_unit(item.unit)}"
        for item, value in zip(section.coordinates.items, rest.c, strict=True)
        if not (item.is_rate or (abs(value) < 1e-6 and item.unit != "rad"))
    ]
    return ", ".join(parts) or "the origin"


def label(section: StateSection, end: TrajectoryEnd) -> str:
    """An end in words."""
    if end.what == "rest":
        assert end.rest is not None
        return f"comes to rest at {place(section, end.rest)}"
    if end.what == "held":
        assert end.sticking_set is not None
        return f"comes to rest where dry friction holds {held_words(section, end.sticking_set)}"
    return {
        "line": "comes to rest on the line of rest points",
        "rest outside": "comes to rest outside the window",
        "stuck": "stands still elsewhere",
        "moving": "still moving at the end",
        "turning": "turns over and keeps turning",
        "gone": "leaves the window",
    }[end.what]


def held_words(section: StateSection, sticking_set: StickingSet) -> str:
    """``α_v, α_v from −0.648 to −0.591 rad``."""
    item = section.coordinates.items[sticking_set.along]
    low, high = (short(value) for value in sticking_set.reach)
    what = "" if sticking_set.what == item.label else f"{sticking_set.what} at "
    return f"{what}{item.label} = {low} to {high} {item.unit}"


def legend(section: StateSection, end: TrajectoryEnd, rests: Sequence[RestPoint]) -> str:
    """An end in the legend: by its kind where that is enough."""
    if end.what == "held":
        return "comes to rest, held by dry friction"
    if end.rest is None or end.what != "rest" or not rests:
        return "comes to rest at the goal" if end.what == "rest" else label(section, end)
    alike = [rest for rest in rests if rest.kind == end.rest.kind]
    if len(alike) == 1:
        return f"comes to rest at the {end.rest.kind}"
    return label(section, end)


def merge_outside(ends: Sequence[TrajectoryEnd]) -> tuple[TrajectoryEnd, ...]:
    """The ends with all rest points outside the window as one."""
    outside = [end for end in ends if end.what == "rest outside"]
    if len(outside) < 2:
        return tuple(ends)
    members = tuple(number for end in outside for number in end.members)
    times = tuple(time for end in outside for time in end.times)
    rest = [end for end in ends if end.what != "rest outside"]
    return (*rest, TrajectoryEnd("rest outside", members, times))


def _measures(result: PortraitResult) -> list[Measure]:
    """Equilibria of the model alone, and how many of the trajectories arrive, how soon."""
    reached = [end for end in result.ends if end.what == "rest"]
    times = [time for end in reached for time in end.times]
    arrived = f"{sum(len(end.members) for end in reached)} of {len(result.trajectories)}"
    if result.loop:  # whose equilibria are not searched
        measures = [Measure("reach the goal", arrived, "", "", "trajectories")]
    else:
        stable = f"{sum(rest.stable for rest in result.rests)} stable"
        measures = [
            Measure("equilibria", len(result.rests), "", "", stable),
            Measure("come to rest", arrived, "", "", "within the window"),
        ]
    if times:
        measures.append(Measure("median time", float(np.median(times)), "s"))
    return measures


def lead_of_model(result: PortraitResult) -> list[str]:
    """The answer of a portrait of the model alone."""
    section = result.section
    lead = [f"At {commands(section)}: {_equilibria(section, result.rests)}."]
    lead.append(_ends(result))
    lead += [_growth(rest) for rest in result.rests if rest.kind == "saddle focus"]
    stable = [rest for rest in result.rests if rest.stable]
    if stable:
        lead.append(_tempo(stable[0]))
    saddles = [rest for rest in result.rests if rest.kind == "saddle"]
    if saddles and any(path.into and not path.surface for path in result.separatrices):
        lead.append(
            "The motions into the saddle (the separatrix) part the starts by where they end."
        )
    lead += _beyond_stops(section, saddles)
    # Those along the angle that is held consist of rest points.
    items = section.coordinates.items
    lines = [
        sticking_set
        for sticking_set in result.sticking
        if sticking_set.what == items[sticking_set.along].label
    ]
    if lines:
        sets = " and ".join(held_words(section, sticking_set) for sticking_set in lines)
        lead.append(
            f"Dry friction holds {sets}: trajectories end anywhere on such a line, not at a point."
        )
    lead += [
        f"Dry friction holds {held_words(section, sticking_set)}: a trajectory that gets there "
        "goes on along that line, if at all."
        for sticking_set in result.sticking
        if sticking_set not in lines
    ]
    return lead


def lead_of_loop(result: PortraitResult, at_bound: float) -> list[str]:
    """The answer of a portrait of a loop; ``at_bound`` is the share of samples at a bound."""
    total = len(result.trajectories)
    reached = [end for end in result.ends if end.what == "rest"]
    count = sum(len(end.members) for end in reached)
    times = [time for end in reached for time in end.times]
    who = "All" if count == total else f"{count} of the"
    if count:
        lead = [
            f"{who} {total} trajectories under {result.loop} reach the goal and stay within "
            f"{100 * NEAR:g} % of the window's width of it, after {np.median(times):.3g} s by the "
            f"median and {max(times):.3g} s at the longest."
        ]
    else:
        lead = [
            f"None of the {total} trajectories under {result.loop} stays within {100 * NEAR:g} % "
            f"of the window's width of the goal in {result.duration:g} s."
        ]
    if 0 < count < total:
        lead.append(_ends(result))
    lead.append(
        f"A command is at its bound in {100 * at_bound:.3g} % of the samples."
        if at_bound
        else "No command reaches its bound."
    )
    return lead


def _equilibria(section: StateSection, rests: Sequence[RestPoint]) -> str:
    if not rests:
        return "no equilibrium was found in the window"
    if any(rest.line for rest in rests):
        return "rest points lie side by side on a line: in its direction nothing pulls"
    alone = all(rest.isolated for rest in rests)
    beside = "" if alone else " (in one direction, not seen here, their neighbours rest too)"
    places = [place(section, rest) for rest in rests]
    if len(set(places)) < len(places):  # they differ in what the portrait does not show
        places = [_angles(section, rest) for rest in rests]
    words = [f"a {rest.kind} at {where}" for rest, where in zip(rests, places, strict=True)]
    joined = listing(words)
    return f"{joined}{beside}" if len(words) < 6 else f"{len(words)} equilibria in the window"


def _angles(section: StateSection, rest: RestPoint) -> str:
    """``α_v = 1.903 rad``: by the controlled states."""
    model = section.coordinates.model
    angles = [(name, model.state_index(name)) for name in model.controlled]
    return ", ".join(
        f"{symbol(name)} = {short(float(rest.x[i]))}{_unit(model.states[i].unit)}"
        for name, i in angles
    )


def _ends(result: PortraitResult) -> str:
    ends, total = merge_outside(result.ends), len(result.trajectories)
    parts = []
    for end in ends:
        count = len(end.members)
        words = label(result.section, end)
        if count > 1:
            words = words.replace("comes", "come").replace("leaves", "leave")
            words = words.replace("turns over and keeps", "turn over and keep")
            words = words.replace("stands", "stand")
        words = words.replace(
            "still moving", "are still moving" if count > 1 else "is still moving"
        )
        when = f" (after {np.median(end.times):.3g} s by the median)" if end.times else ""
        parts.append((count, f"{words}{when}"))
    if len(parts) == 1:
        if parts[0][0] == 1:
            return f"The trajectory {parts[0][1]}."
        return f"All {total} trajectories {parts[0][1]}."
    first, *others = (f"{count} {words}" for count, words in parts)
    return f"Of {total} trajectories of {result.duration:.3g} s {first}; {'; '.join(others)}."


def _tempo(rest: RestPoint) -> str:
    visible_modes = rest.eigenvalues[rest.is_visible] if rest.is_visible.any() else rest.eigenvalues
    moving = [complex(v) for v in visible_modes if v.real < -1e-9]
    if not moving:
        return f"Nothing that the portrait shows decays at the {rest.kind}."
    slow = min(moving, key=lambda v: abs(v.real))
    fast = max(moving, key=lambda v: abs(v.real))
    half = seconds(halving_time(slow))
    if slow.imag:
        words = (
            f"Around the {rest.kind} a swing takes {seconds(period(slow))} s and loses half of "
            f"itself every {half} s"
        )
    else:
        words = f"The slowest motion into the {rest.kind} halves every {half} s"
    if len(rest.x) == 2 and abs(fast.real) > _MUCH_FASTER * abs(slow.real):
        words += (
            f"; the fast one halves in {seconds(1e3 * halving_time(fast))} ms, so that "
            "trajectories first fall along it and then creep along the slow one"
        )
    return words + "."


def _growth(rest: RestPoint) -> str:
    growing = max((complex(v) for v in rest.eigenvalues), key=lambda v: v.real)
    return (
        f"At the {rest.kind} a swing of {seconds(period(growing))} s grows and doubles every "
        f"{seconds(halving_time(growing))} s, while all else decays."
    )


def _beyond_stops(section: StateSection, saddles: Sequence[RestPoint]) -> list[str]:
    model = section.coordinates.model
    for name, stop in model.stops.items():
        index = model.state_index(name)
        beyond = sum(abs(float(rest.x[index])) > stop for rest in saddles)
        if beyond:
            what = f"{beyond} of {len(saddles)} saddles" if len(saddles) > 1 else "The saddle"
            verb = "lie" if beyond > 1 else "lies"
            return [
                f"{what} {verb} beyond the mechanical stop of {symbol(name)} at ±{short(stop)} "
                "rad, which the equations do not have."
            ]
    return []


def seconds(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "∞"


def caption(result: PortraitResult) -> str:
    """A sentence or two under the figure."""
    hidden = [sticking_set for sticking_set in result.sticking if is_hidden(result, sticking_set)]
    sets = " and ".join(held_words(result.section, sticking_set) for sticking_set in hidden)
    end = f" Too short to be seen at its marker: dry friction holds {sets}." if hidden else ""
    return f"{_of_the_plane(result)}{end}"


def _of_the_plane(result: PortraitResult) -> str:
    """What the axes are, and how exact."""
    section = result.section
    coordinates = section.coordinates
    plane = ", ".join(item.label for item in coordinates.items)
    if result.loop:
        faint = "; grey: the model alone" if result.beside else ""
        return f"{plane} under {result.loop}, {result.duration:g} s from each start{faint}."
    head = f"{plane} at {commands(section)}"
    if not coordinates.others:
        return f"{head}. These are all states of the model: the portrait is exact."
    if result.invariant:
        return (
            f"{head}, with {_others(result)}. No motion leaves this section: the portrait is exact."
        )
    return (
        f"{head}. A projection: the trajectories are those of all {coordinates.model.n_x} states, "
        f"begun with {_others(result)}. "
        + (
            "Stream lines and dashed nullclines are those of that section, which the trajectories "
            "leave; they may cross."
            if len(coordinates) == 2
            else "They may cross."
        )
    )


def of_model(result: PortraitResult, rubs: bool) -> list[str]:
    """The text beside the portrait of a model alone."""
    n = len(result.section.coordinates)
    text = [
        f"Trajectories of {result.duration:g} s with the command held, from starts "
        + (
            "on the edge of the window where the field enters it and inside. They are drawn for "
            "a little more than two widths of the window; what is said of their ends is of the "
            "whole. Grey: stream lines. Dashed: nullclines, on which one of the two rates is zero."
            if n == 2
            else "spread in the box, drawn as far as they stay in it."
        )
    ]
    if n == 2 and not result.invariant:
        text.append(
            "The model has more states than the plane shows. The field is drawn with "
            f"{_others(result)}; a trajectory begins there and then leaves that section, as its "
            "other states move. Where it crosses another or runs against the stream lines, the two "
            "differ in the states that are not seen."
        )
        if not has_field(result.section, result.window):
            text.append(
                "In this section a rate is zero everywhere: what moves the coordinates is among "
                "the states that are not seen. So neither stream lines nor nullclines are drawn."
            )
    if result.separatrices:
        text.append(
            "Out of a saddle and into it run the invariant manifolds, integrated from its "
            "eigenvectors forwards and backwards until they leave the window. Those into it "
            + (
                "part the plane: starts on either side of one end in different places or take "
                "different ways."
                if n == 2
                else "fill a surface that parts the space; some of them are drawn."
            )
        )
    saddles = any(rest.kind == "saddle" for rest in result.rests)
    if saddles and not result.separatrices and not rubs:
        text.append(
            "The motions into a saddle of this model fill a surface of more dimensions than the "
            "portrait has: no separatrix is drawn."
        )
    if rubs:
        text.append(
            "Dry friction acts on the trajectories as impulses. It is no part of the stream lines "
            "and the nullclines, and around a saddle it makes a set of rest points out of one: no "
            "separatrices are drawn. A red line is the sticking set: at zero rate the static "
            "moment is within the friction, and what arrives there stays."
        )
    return text


def of_loop(result: PortraitResult, observer: str) -> list[str]:
    """The text beside the portrait of a closed loop."""
    return [
        f"Trajectories of the loop with {result.loop} and {observer}, {result.duration:g} s each, "
        "its references at the goal. Controller and observer begin as they do at a rig, with the "
        "command of the goal in force.",
        "The command follows from what controller and observer remember, and not from the point of "
        "the portrait alone. So there is no field in it: nullclines do not exist and are not "
        "drawn, and trajectories may cross.",
    ]


def _warnings(result: PortraitResult) -> list[str]:
    warnings = []
    coordinates = result.section.coordinates
    if not result.loop and not result.invariant:
        warnings.append(
            f"a projection: {_others(result)} at the start of each trajectory, and moving then"
        )
    if not result.loop and not result.rests:
        warnings.append("no equilibrium was found in the window; the search is no proof of none")
    warnings += _switches(result)
    for name, stop in coordinates.model.stops.items():
        index = coordinates.model.state_index(name)
        visited = max(float(np.nanmax(np.abs(run.x[:, index]))) for run in result.trajectories)
        if visited > stop:
            warnings.append(
                f"trajectories pass the mechanical stop of {symbol(name)} at {short(stop)} rad: "
                "the equations have none"
            )
    return warnings


def _switches(result: PortraitResult) -> list[str]:
    """Where eigenvalues are those of a mean."""
    model = result.section.coordinates.model
    on = [rest for rest in result.rests if rest.switches]
    if not on:
        return []
    states = sorted({state for rest in on for state in rest.switches})
    where = " and ".join(
        f"{symbol(model.state_names[i])} = {short(float(on[0].x[i]))}" for i in states
    )
    return [
        f"at {where} the slopes differ on the two sides: the eigenvalues there, and what is said "
        "of swings and of the kind, are those of the mean of both, as in study=local "
        "(study.side=upper or lower shows each)"
    ]


def _others(result: PortraitResult) -> str:
    """``ω_v held at 196.3 rad/s``: what the section does with the states that are not seen."""
    section = result.section
    model = section.coordinates.model
    words = []
    if section.held_states:
        texts = [
            f"{symbol(model.state_names[i])} = {short(float(section.point.x[i]))}"
            for i in section.held_states
        ]
        words.append(f"{', '.join(texts)} held")
    if section.settled:
        texts = [symbol(model.state_names[i]) for i in section.settled]
        words.append(f"{', '.join(texts)} settled")
    return " and ".join(words)


def equilibria_table(section: StateSection, rests: Sequence[RestPoint]) -> Table:
    """Equilibria with their kinds and slowest modes."""

    def state(i: int) -> Callable[[RestPoint], str]:
        return lambda rest: short(float(rest.x[i]))

    def eigenvalue_text(value: complex) -> str:
        swing = f" ± {short(abs(value.imag))}j" if value.imag else ""
        return f"{short(value.real)}{swing}"

    return table(
        rests,
        [
            Column("equilibrium", lambda rest: Datum(rest.kind, "good" if rest.stable else "bad")),
            *(
                Column(f"{symbol(s.name)} [{s.unit}]", state(i))
                for i, s in enumerate(section.coordinates.model.states)
            ),
            Column(
                "eigenvalues [1/s]",
                lambda rest: ", ".join(eigenvalue_text(v) for v in rest.eigenvalues if v.imag >= 0),
            ),
            Column("tempo", _slowest),
        ],
        "Found in the window by Newton's method from many starts: a search. Tempo: of a stable one "
        "the time in which its slowest mode halves, of an unstable one that in which its fastest "
        "growing mode doubles.",
    )


def _slowest(rest: RestPoint) -> str | None:
    """``doubles in 0.35 s`` where something grows, else the time in which the slowest halves."""
    moving = rest.eigenvalues[np.abs(rest.eigenvalues) > rest.no_rate].real
    if not moving.size or abs(moving.max()) <= rest.no_rate:
        return None
    what = "doubles" if moving.max() > 0 else "halves"
    return f"{what} in {seconds(halving_time(moving.max()))} s"


def chart(result: PortraitResult) -> Chart:
    """The figure with its caption and legend."""
    ends = merge_outside(result.ends)
    labels = [legend(result.section, end, result.rests) for end in ends]
    return portrait(result, caption(result), ends, labels)


def ends_section(result: PortraitResult) -> Section:
    """Where trajectories end, how many, how soon."""
    section, total = result.section, len(result.trajectories)
    ends = result.ends if result.loop else merge_outside(result.ends)

    def words(end: TrajectoryEnd) -> str:
        at = end.what == "rest outside" and end.rest is not None
        return label(section, end) + (f", at {place(section, end.rest)}" if at else "")  # type: ignore[arg-type]

    end_table = table(
        ends,
        [
            Column("the trajectory", words),
            Column("starts", lambda end: len(end.members)),
            Column("share [%]", lambda end: round(100 * len(end.members) / total, 1)),
            Column(
                "median time [s]",
                lambda end: seconds(float(np.median(end.times))) if end.times else None,
            ),
            Column("longest [s]", lambda end: seconds(max(end.times)) if end.times else None),
        ],
        f"Times until a trajectory stays within {100 * NEAR:g} % of the window's width of its end.",
    )
    return Section("Where the trajectories end", (), [end_table])


def _results(result: PortraitResult) -> dict[str, Any]:
    section, items = result.section, result.section.coordinates.items
    model, total = section.coordinates.model, len(result.trajectories)

    def placed(c: FloatArray) -> dict[str, float]:
        return dict(zip(section.coordinates.names, c, strict=True))

    return {
        "coordinates": [{"name": item.name, "unit": item.unit} for item in items],
        "window": placed(result.window),
        "operating_point": {
            "x": by_name(model.states, section.point.x),
            "u": by_name(model.inputs, section.point.u),
        },
        "held": [model.state_names[i] for i in section.held_states],
        "settled": [model.state_names[i] for i in section.settled],
        "section_is_invariant": None if result.loop else result.invariant,
        "equilibria": [
            {
                "x": by_name(model.states, rest.x),
                "coordinates": placed(rest.c),
                "kind": rest.kind,
                "isolated": rest.isolated,
                "on_a_line": rest.line,
                "in_section": rest.in_section,
                "switches": [model.state_names[i] for i in rest.switches],
                "eigenvalues": rest.eigenvalues,
            }
            for rest in result.rests
        ],
        "trajectories": {
            "count": total,
            "duration": result.duration,
            "near": NEAR,
            "starts": [placed(trajectory.c[0]) for trajectory in result.trajectories],
            "ends": [
                {
                    "what": end.what,
                    "at": None if end.rest is None else by_name(model.states, end.rest.x),
                    "held_in": None if end.sticking_set is None else end.sticking_set.reach,
                    "starts": end.members,
                    "share": len(end.members) / total,
                    "median_time": np.median(end.times) if end.times else None,
                    "longest_time": max(end.times, default=None),
                }
                for end in result.ends
            ],
        },
        "sticking": [
            {
                "what": sticking.what,
                "along": items[sticking.along].name,
                "from": sticking.reach[0],
                "to": sticking.reach[1],
            }
            for sticking in result.sticking
        ],
        "separatrices": len(result.separatrices),
    }
