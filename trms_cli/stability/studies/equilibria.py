"""``study=equilibria``: where the rig can rest, all of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.findings import Findings
from trms_cli.core.plugins import nearest
from trms_cli.core.wording import symbol
from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.findings import EquilibriaResult, findings_of
from trms_cli.stability.equilibria.rest_system import rest_system
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
        named, missing = self._named(model)
        stable_map = None
        if self.map and model.n_u == 2 and len(surveys) == 2:
            tell("the map over both inputs")
            stable_map = equilibrium_map(model, surveys[0], surveys[1].setting.over)
        result = EquilibriaResult(model, surveys, named, stable_map, missing)
        findings = findings_of(result, subject.left_out_of_equations())
        held_outside = [
            f"over {symbol(one.setting.over)} the beam is held at {symbol(name)} = {value:g} rad, "
            f"outside the box: another angle by study.at.{name}=…"
            for one in surveys
            for name, value in one.setting.held.items()
            if name in self.box and not self.box[name][0] <= value <= self.box[name][1]
        ]
        return replace(findings, warnings=[*findings.warnings, *held_outside])

    def _named(self, model: Model) -> tuple[list[NamedPoint], list[str]]:
        """The named points; rest and hover only within the box, and why one is missing."""
        points, missing = named_points(model, self.special)
        kept = []
        for point in points:
            outside = ", ".join(
                f"{symbol(name)} = {point.value(model, name):.4g}"
                for name, (low, high) in self.box.items()
                if not low <= point.value(model, name) <= high
            )
            if not outside or point.name in self.special:
                kept.append(point)
                continue
            missing.append(f"{point.name} lies outside the box ({outside}) and is left out")
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
