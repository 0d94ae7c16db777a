"""``study=equilibria``: where the rig can rest, all of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.chart import Chart
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.findings import Findings, Section, Table
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.charts import curves_chart, map_chart, shown_signals, symbol
from trms_cli.stability.equilibria.data import named_data, survey_data
from trms_cli.stability.equilibria.named_points import NamedPoint, named_points
from trms_cli.stability.equilibria.rest_system import rest_system
from trms_cli.stability.equilibria.survey import (
    Setting,
    Survey,
    equilibrium_map,
    setting_of,
    survey,
    usual_bounds,
)
from trms_cli.stability.equilibria.telling import (
    band_words,
    landmark_table,
    landmark_words,
    named_table,
    named_words,
    point_table,
    proof_words,
    quantity_table,
    switch_words,
    undecided_words,
)
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

_TOLD = ("fold", "kink", "oscillation", "exchange", "crossing")


@dataclass(frozen=True, kw_only=True)
class Equilibria:
    """All equilibria of a model in a box of inputs and states."""

    #: Inputs: a curve over each. None: all that act on the rest.
    over: tuple[str, ...] | None = None
    #: Range by input, in its unit; what is not named reaches to its limits
    range: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: The other inputs: commands, or angles (rad) that an input holds. Empty: no tail command over
    #: the main rotor's, the beam held level over the tail rotor's.
    at: Mapping[str, float] = field(default_factory=dict)
    #: Bounds by state; what is not named as of
    #: :func:`trms_cli.stability.equilibria.survey.bounds_of`
    box: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: Inputs of each range at which the number of equilibria is proved
    proof_points: Annotated[int, Meta(ge=2, le=201)] = 21
    proof_range: bool = True  #: Whether it is proved for every input between them too
    #: More points by name, by angles or commands
    special: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    map: bool = True  #: Whether the angles over both inputs are drawn

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Find, prove and follow them.

        Raises TrmsError for a model that only steps, a controller, or names and ranges that do not
        fit.
        """
        subject.require_no_loop(
            "study=equilibria",
            "leave it out; where a loop comes to rest: study=phase_portrait controller=…",
        )
        model = subject.require_equations(
            "study=equilibria",
            "where a network settles under a held command is seen by `trms run` with a step",
            command_path=True,
        )
        settings = [self._setting(model, name) for name in self._inputs(model)]
        surveys = [
            survey(
                model,
                setting,
                self.box,
                np.linspace(*setting.bounds, self.proof_points),
                self.proof_range,
                tell,
            )
            for setting in settings
        ]
        tell("rest and hover")
        named, missing = self._named(model)
        return Findings(
            title="Equilibria",
            lead=_lead(model, surveys, named),
            sections=[
                *(_section(model, one, named) for one in surveys),
                *self._map(model, surveys, tell),
                _special_section(model, surveys, named),
            ],
            results={
                "surveys": [survey_data(model, one) for one in surveys],
                "named": [named_data(model, point) for point in named],
            },
            warnings=[*_warnings(subject, surveys, missing), *self._held_outside(surveys)],
        )

    def _held_outside(self, surveys: list[Survey]) -> list[str]:
        """Surveys that hold an angle outside the box, where nothing else was asked for."""
        return [
            f"over {symbol(one.setting.over)} the beam is held at {symbol(name)} = {value:g} rad, "
            f"outside the box: another angle by study.at.{name}=…"
            for one in surveys
            for name, value in one.setting.held.items()
            if name in self.box and not self.box[name][0] <= value <= self.box[name][1]
        ]

    def _named(self, model: Model) -> tuple[list[NamedPoint], list[str]]:
        """The named points; rest and hover only within the box, and why one is missing."""
        found, missing = named_points(model, self.special)
        kept = []
        for point in found:
            out = [
                name
                for name, (low, high) in self.box.items()
                if not low <= point.x[model.state_index(name)] <= high
            ]
            if not out or point.name in self.special:
                kept.append(point)
                continue
            where = ", ".join(
                f"{symbol(name)} = {point.x[model.state_index(name)]:.4g}" for name in out
            )
            missing.append(f"{point.name} lies outside the box ({where}) and is left out")
        return kept, missing

    def _inputs(self, model: Model) -> tuple[str, ...]:
        known = names(model.inputs)
        for key, given in (("over", self.over or ()), ("range", self.range), ("at", self.at)):
            allowed = (*known, *model.controlled) if key == "at" else known
            kind = "neither an input nor a controlled angle" if key == "at" else "no input"
            for name in given:
                if name not in allowed:
                    raise ConfigurationError(
                        f"{name!r} is {kind} of model {model.name!r}",
                        where=f"study.{key}",
                        remedy=nearest(name, allowed),
                    )
        if self.over is not None:
            if not self.over:
                raise ConfigurationError(
                    "nothing is varied", where="study.over", remedy=f"one of {', '.join(known)}"
                )
            return tuple(self.over)
        idle = rest_system(model, known[:1]).idle
        chosen = tuple(
            name
            for name in known
            if name not in idle and (name in self.range or math.isfinite(model.input_limits[name]))
        )
        if not chosen:
            raise ModelError(
                f"the inputs that rest of model {model.name!r} depends on have no limits",
                where="study.range",
                remedy=f"give a range, as study.range.{known[-1]}=[0,200]",
            )
        return chosen

    def _setting(self, model: Model, over: str) -> Setting:
        limit = model.input_limits[over]
        low, high = self.range.get(over, (-limit, limit))
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ConfigurationError(
                f"{over} has no limits",
                where=f"study.range.{over}",
                remedy=f"give its range, as study.range.{over}=[0,200]",
            )
        if not low < high:
            raise ConfigurationError(
                f"[{low:g}, {high:g}] is no range",
                where=f"study.range.{over}",
                remedy="give the lower value first",
            )
        self._require_reached(model)
        return setting_of(model, over, (float(low), float(high)), self.at)

    def _require_reached(self, model: Model) -> None:
        """Angles that are held lie in the box and within the stops."""
        for name, value in self.at.items():
            if name not in model.controlled:
                continue
            low, high = self.box.get(name) or usual_bounds(model, name)
            stop = model.stops.get(name, math.inf)
            low, high = max(low, -stop), min(high, stop)
            if not low <= value <= high:
                raise ConfigurationError(
                    f"{name} = {value:g} rad lies outside the box or beyond a stop",
                    where=f"study.at.{name}",
                    remedy=f"hold it between {low:.4g} and {high:.4g} rad",
                )

    def _map(self, model: Model, surveys: list[Survey], tell: Tell) -> list[Section]:
        if not self.map or model.n_u != 2 or len(surveys) != 2:
            return []
        first, second = (one.setting.over for one in surveys)
        tell("the map over both inputs")
        found = equilibrium_map(model, surveys[0], second)
        if found is None:
            return []
        chart = map_chart(model, found, first, second)
        text = "Each point is the stable equilibrium that a step of the command leads to from its "
        text += "neighbour; it is searched for, not proved to be the only one."
        return [Section("Over both inputs", [text], [chart])] if chart.panels else []


def _lead(model: Model, surveys: list[Survey], named: list[NamedPoint]) -> list[str]:
    lead = [named_words(model, point) + "." for point in named]
    for one in surveys:
        told = [landmark_words(one, mark) for mark in one.landmarks if mark.kind in _TOLD]
        lead += [_sentence(words) for words in dict.fromkeys(told)]
        lead.append(proof_words(one))
    bands = [f"{point.name}: {band_words(model, band)}" for point in named for band in point.bands]
    return [*lead, *(_sentence(words) for words in bands)]


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:] + "."


def _section(model: Model, one: Survey, named: list[NamedPoint]) -> Section:
    over = symbol(one.setting.over)
    text = [
        "The box: "
        + ", ".join(
            f"{symbol(signal.name)} "
            + (
                f"{low:.4g} to {high:.4g} {signal.unit}"
                if math.isfinite(low) and math.isfinite(high)
                else "without bounds"
            )
            for signal, low, high in zip(
                one.system.unknowns, one.box.lower.tolist(), one.box.upper.tolist(), strict=True
            )
        )
        + "; all other states follow from these. An angle beyond its stop is reached by no rig.",
        *(_sentence(words) for words in _structure(one)),
        *(
            f"A curve runs from {a} to {b}."
            for a, b in dict.fromkeys(c.curve.ends for c in one.curves)
        ),
    ]
    blocks: list[Table | Chart] = []
    shown = shown_signals(model, one)
    if one.curves and shown:
        blocks.append(curves_chart(model, one, named))
    blocks.append(point_table(model, one, shown))
    return Section(f"Over {over}", text, blocks)


def _structure(one: Survey) -> list[str]:
    words = []
    if one.system.free:
        words.append(
            f"{', '.join(symbol(name) for name in one.system.free)} is determined by nothing: "
            "any value rests; zero is taken"
        )
    if one.system.released and not one.setting.held:
        words.append(
            f"rest asks for one value of {', '.join(symbol(n) for n in one.system.released)} at "
            f"each {symbol(one.setting.over)}: it is solved for"
        )
    return words


def _special_section(model: Model, surveys: list[Survey], named: list[NamedPoint]) -> Section:
    blocks: list[Table | Chart] = []
    if named:
        blocks.append(named_table(model, named))
    blocks += [
        table for table in (landmark_table(model, surveys), quantity_table(model, named)) if table
    ]
    return Section("Special points", (), blocks)


def _warnings(subject: Subject, surveys: list[Survey], missing: list[str]) -> list[str]:
    words = list(missing)
    for one in surveys:
        over = symbol(one.setting.over)
        differ = [check.input for check in one.checks if not check.agree]
        if differ:
            words.append(
                f"over {over} the curves and the proof DISAGREE at "
                f"{', '.join(f'{value:.4g}' for value in differ)}: neither is to be trusted there"
            )
        if one.late:
            words.append(
                f"over {over} {one.late} curves were found by the proof and not by the search"
            )
        if any(check.proof.open_ended for check in one.checks):
            words.append(f"over {over} equilibria with a state beyond 1e6 are not excluded")
        on_switch = switch_words(one, Linear(one.system.model))
        if on_switch:
            words.append(on_switch)
        words += undecided_words(one)
        ends = [end for curve in one.curves for end in curve.curve.ends if end.startswith("where")]
        words += [f"a curve over {over} ends {end}" for end in ends]
    left_out = [name for name in subject.left_out_of_equations() if "friction" in name]
    rotor = [name for name in left_out if "rotor" in name]
    if rotor:
        words.append(
            f"{', '.join(rotor)} acts as impulses and is no part of these equilibria: a turning "
            "rotor rests at a lower speed with it"
        )
    return words
