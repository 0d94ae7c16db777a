"""A run as it goes on, as a page: what it is now, and the last seconds of its signals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core import wording
from trms_cli.core.chart import Axis, Chart, Curve, Line, Panel, signal_colour
from trms_cli.core.findings import Cell, Findings, Measure, NextCommand, Section, Table
from trms_cli.core.invocation import program
from trms_cli.reporting.run_panels import axis_range, label_of, symbol_label

if TYPE_CHECKING:
    from trms_cli.runs.follower import AxisMoment, Moment, RunFollower

SPAN = 30.0  #: s of the run that its curves show
_MOST_EVENTS = 12


def live_page(follower: RunFollower, name: str) -> Findings:
    """What a page tells of a run that is being written; `name`: of the run."""
    now = follower.latest
    moment = follower.at(now, SPAN, _MOST_EVENTS)
    window = Axis("time", "s", (max(0.0, now - SPAN), max(now, SPAN)), linked="time")
    panels = [_axis_panel(axis, window) for axis in moment.axes if len(axis.time)]
    commands = _command_panel(follower, moment, window)
    panels += [commands] if commands is not None else []
    sections = []
    if panels:
        words = f"The last {SPAN:g} s. What you enlarge stays as the run goes on."
        sections.append(Section("Now", [words], [Chart("now", panels, columns=1)]))
    if moment.events:
        rows: list[list[Cell]] = [
            [event.time, event.kind, event.source, event.message] for event in moment.events
        ]
        table = Table(["time [s]", "what", "where", "in words"], rows[::-1], heads=0)
        sections.append(Section("Latest events", blocks=[table]))
    watch = NextCommand(f"{program()} watch {follower.path}", "The same in a terminal:")
    sections.append(Section("More", blocks=[watch], folded=True))
    title, measures = f"{_who(follower.choices)}: {name}", _measures(follower, moment)
    return Findings(title, _lead(follower, moment), sections, measures=measures)


def _who(choices: dict[str, Any]) -> str:
    controller, reference = choices.get("controller"), choices.get("ref")
    return f"{controller} on {reference}" if controller and reference else "A run"


def _lead(follower: RunFollower, moment: Moment) -> list[str]:
    if follower.state == "unfinished":
        first = "This run has no end in its log, and the system does not tell who writes it."
    else:
        first = "**Live**: this run is going on."
    errors = [
        f"{label_of(axis.name)} misses its reference by "
        f"{wording.quantity(abs(axis.error), axis.unit)}"
        for axis in moment.axes
        if math.isfinite(axis.error)
    ]
    saturated = [symbol_label(each.name) for each in moment.inputs if each.saturated]
    sentences = [first]
    if errors:
        sentences.append(f"Now {wording.listing(errors)}.")
    if saturated:
        sentences.append(f"At its limit: {wording.listing(saturated)}.")
    if moment.solver is not None and moment.solver.mode not in ("", "normal"):
        why = f" ({moment.solver.reasons})" if moment.solver.reasons else ""
        sentences.append(f"The supervisor: **{moment.solver.mode}**{why}.")
    return sentences


def _measures(follower: RunFollower, moment: Moment) -> list[Measure]:
    whole = follower.total
    measures = [
        Measure("time", round(moment.time, 2), "s", note=f"of {whole:g} s" if whole else "")
    ]
    if math.isfinite(moment.speed):
        measures.append(Measure("speed", moment.speed, "× real time"))
    measures += [
        Measure(f"RMSE {label_of(axis.name)}", axis.rmse, axis.unit, note="since the beginning")
        for axis in moment.axes
        if math.isfinite(axis.rmse)
    ]
    solver = moment.solver
    if solver is not None and math.isfinite(solver.p99_ms):
        deadline = f"of {solver.deadline_ms:.3g} ms" if math.isfinite(solver.deadline_ms) else ""
        measures.append(Measure("step, 99 %", solver.p99_ms, "ms", note=deadline))
    if solver is not None:
        missed = solver.misses
        measures.append(Measure("deadlines missed", missed, "", "bad" if missed else "good"))
    return measures


def _axis_panel(axis: AxisMoment, window: Axis) -> Panel:
    marks = [Curve(axis.time, axis.outputs, "rig")]
    if np.isfinite(axis.references).any():
        marks.append(
            Curve(axis.time, axis.references, "reference", "ink", "dashed", 1.2, is_step=True)
        )
    limits = axis_range([axis.outputs, axis.references])
    return Panel(window, Axis(label_of(axis.name), axis.unit, limits), marks, label_of(axis.name))


def _command_panel(follower: RunFollower, moment: Moment, window: Axis) -> Panel | None:
    time, columns = follower.recent("/command", moment.time, SPAN)
    inputs = [each for each in moment.inputs if each.name in columns]
    if not inputs or not len(time):
        return None
    marks: list[Any] = [
        Curve(
            time,
            columns[each.name],
            symbol_label(each.name),
            signal_colour(each.name, number),
            width=1.0,
            is_step=True,
        )
        for number, each in enumerate(inputs)
    ]
    bounds = {bound for each in inputs for bound in (each.lower, each.upper)}
    marks += [Line(y=bound, colour="alarm") for bound in sorted(bounds) if math.isfinite(bound)]
    near = [[bound] for bound in bounds if math.isfinite(bound)]
    limits = axis_range([*(columns[each.name] for each in inputs), *near])
    caption = "As applied to the rig, after limits. Dotted: limits."
    axis = Axis("command", inputs[0].unit, limits)
    return Panel(window, axis, marks, "commands", caption=caption)
