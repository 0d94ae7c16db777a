"""``study=equilibria``: where the rig can rest, all of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.findings import Findings, Section, json_data
from trms_cli.core.plugins import require_known
from trms_cli.core.wording import symbol
from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.charts import map_chart
from trms_cli.stability.equilibria.rest_system import rest_system
from trms_cli.stability.equilibria.result import EquilibriaResult, named_data, survey_data
from trms_cli.stability.equilibria.sections import special_section, survey_section
from trms_cli.stability.equilibria.summary import lead_sentences, measures_of, warning_sentences
from trms_cli.stability.equilibria.survey import (
    NamedPoint,
    SurveySetting,
    equilibrium_map,
    named_points,
    setting_of,
    survey,
    usual_bounds,
)
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject


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
        surveys = []
        for setting in settings:
            inputs = np.linspace(*setting.bounds, self.proof_points)
            surveys.append(survey(model, setting, self.box, inputs, self.proof_range, tell))
        tell("rest and hover")
        named, missing = self._named_points(model)
        stable_map = None
        if self.map and model.n_u == 2 and len(surveys) == 2:
            tell("the map over both inputs")
            stable_map = equilibrium_map(model, surveys[0], surveys[1].setting.over)
        result = EquilibriaResult(model, surveys, named)
        held_outside = [
            f"over {symbol(one.setting.over)} the beam is held at {symbol(name)} = {value:g} rad, "
            f"outside the box: another angle by study.at.{name}=…"
            for one in surveys
            for name, value in one.setting.held_angles.items()
            if name in self.box and not self.box[name][0] <= value <= self.box[name][1]
        ]
        warnings = warning_sentences(result, subject.left_out_of_equations())
        data = {
            "surveys": [survey_data(one) for one in surveys],
            "named": [named_data(model, point) for point in named],
        }
        sections = [survey_section(one, named) for one in surveys]
        chart = None if stable_map is None else map_chart(result, stable_map)
        if chart is not None and chart.panels:
            text = (
                "Each point is the stable equilibrium that a step of the command leads to from its "
                "neighbour; it is searched for, not proved to be the only one."
            )
            sections.append(Section("Over both inputs", [text], [chart]))
        sections.append(special_section(result))
        notes = [*missing, *warnings, *held_outside]
        lead, measures = lead_sentences(result), measures_of(result)
        return Findings("Equilibria", lead, sections, json_data(data), notes, measures)

    def _named_points(self, model: Model) -> tuple[list[NamedPoint], list[str]]:
        """The named points; rest and hover only within the box, and why one is missing."""
        points, missing = named_points(model, self.special)
        selection = []
        for point in points:
            outside = ", ".join(
                f"{symbol(name)} = {point.value(model, name):.4g}"
                for name, (low, high) in self.box.items()
                if not low <= point.value(model, name) <= high
            )
            if not outside or point.name in self.special:
                selection.append(point)
                continue
            missing.append(f"{point.name} lies outside the box ({outside}) and is left out")
        return selection, missing

    def _inputs(self, model: Model) -> tuple[str, ...]:
        input_names = names(model.inputs)
        for key, requested_names in (
            ("over", self.over or ()),
            ("range", self.range),
            ("at", self.at),
        ):
            allowed = (*input_names, *model.controlled) if key == "at" else input_names
            kind = "neither an input nor a controlled angle" if key == "at" else "no input"
            for name in requested_names:
                unknown = f"{name!r} is {kind} of model {model.name!r}"
                require_known(name, allowed, unknown, f"study.{key}")
        if self.over is not None:
            if not self.over:
                raise ConfigurationError(
                    "nothing is varied",
                    where="study.over",
                    remedy=f"one of {', '.join(input_names)}",
                )
            return tuple(self.over)
        try:
            idle = rest_system(model, input_names[:1]).idle
        except ModelError as error:
            if model.bench_sizes:
                raise
            raise ModelError(
                f"{model.name} does not rest at each command: where it rests, the command follows "
                "from it, and a position that nothing pulls back may have any value",
                where="study.over",
                remedy=f"look along a position: study=local study.over={model.controlled[0]}",
            ) from error
        selection = tuple(
            name
            for name in input_names
            if name not in idle and (name in self.range or math.isfinite(model.input_limits[name]))
        )
        if not selection:
            raise ModelError(
                f"the inputs that rest of model {model.name!r} depends on have no limits",
                where="study.range",
                remedy=f"give a range, as study.range.{input_names[-1]}=[0,200]",
            )
        return selection

    def _setting(self, model: Model, over: str) -> SurveySetting:
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
        for name in (name for name in self.at if name in model.controlled):
            least, most = self.box.get(name) or usual_bounds(model, name)
            stop = model.stops.get(name, math.inf)
            least, most = max(least, -stop), min(most, stop)
            if not least <= self.at[name] <= most:
                raise ConfigurationError(
                    f"{name} = {self.at[name]:g} rad lies outside the box or beyond a stop",
                    where=f"study.at.{name}",
                    remedy=f"hold it between {least:.4g} and {most:.4g} rad",
                )
        return setting_of(model, over, (float(low), float(high)), self.at)
