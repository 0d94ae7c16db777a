"""``study=root_locus``: eigenvalues over an input or a parameter, where they cross, and why."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from trms_cli.core.findings import Findings
from trms_cli.models.model import Model
from trms_cli.stability.local.asked import line_of
from trms_cli.stability.local.crossings import Crossing, crossings
from trms_cli.stability.local.linear import Side
from trms_cli.stability.local.locus_told import (
    held_words,
    locus_section,
    results_of,
    still_words,
    why_section,
)
from trms_cli.stability.local.map import stability_map
from trms_cli.stability.local.map_told import boundary_along, map_section
from trms_cli.stability.local.sweep import Path, Sweep, swept, usual_line
from trms_cli.stability.local.told import amount_words, crossing_name
from trms_cli.stability.local.tracks import Track, tracks_of
from trms_cli.stability.local.why import Reason, course_of, moves, reason, reason_words
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

#: What a model of the TRMS is asked when nothing is said: the thesis's value of k_g is 16 times
#: the maker's.
_USUAL_PARAMETER, _USUAL_RANGE, _USUAL_AT = "k_g", (0.0123, 0.2), {"alpha_v": 0.4}
#: 1/s: a growth rate that changes by less over the whole range does not move.
_STILL = 1e-6
#: rad: from below rest to short of the fold.
_USUAL_AGAINST, _USUAL_AGAINST_RANGE = "alpha_v", (-0.6, 0.9)


@dataclass(frozen=True, kw_only=True)
class RootLocus:
    """Eigenvalues over one number, with their crossings explained."""

    #: What is held: angles (rad) or commands (V). It is solved anew for each value.
    at: Mapping[str, float] = field(default_factory=dict)
    #: An input, a controlled state, or a parameter (an effect's size: ``effect.size``). None:
    #: ``k_g`` where the model has it, at 0.4 rad; else the first angle, or the command of a motor
    #: alone. Where ``at`` names commands: the first of them.
    over: str | None = None
    range: tuple[float, float] | None = None  #: In the unit of ``over``; None: what is usual for it
    points: Annotated[int, Meta(ge=2, le=2000)] = 81  #: Steps over the range
    side: Side = "mean"  #: Whose slopes are taken where a coefficient depends on a direction
    #: A second number, for the map of stability; None: ``alpha_v`` with ``k_g``, else no map
    against: str | None = None
    #: In the unit of ``against``; None: what is usual for it
    against_range: tuple[float, float] | None = None
    #: Values of ``over`` on the map; of ``against`` it has twice as many
    map_points: Annotated[int, Meta(ge=3, le=400)] = 21

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Follow the eigenvalues.

        Raises TrmsError where there is no such operating point, parameter or range, or with a
        controller.
        """
        subject.require_no_loop("study=root_locus", "leave it out; for loops: study=margins")
        model = subject.model
        at, over, span, against = self._asked(model)
        path = Path(model, at, over, self.side)
        low, high = path.range(span)
        tell(f"over {over}")
        sweep = swept(path, low, high, self.points)
        tracks = tracks_of(model, sweep)
        found = crossings(path, sweep)
        sides = _sides(path, sweep, (low, high), self.points, tell)
        tell("why")
        reasons = [reason(path, c.place, c.track, crossing_name(model, tracks, c)) for c in found]
        nearest = None if found else _nearest(path, sweep, tracks)
        if nearest is not None:
            reasons = [nearest]
        sections = [locus_section(path, sweep, tracks, found)]
        sections.append(why_section(path, sweep, found, reasons, tracks))
        mapped, at_ends = None, []
        if against is not None:
            line = Path(model, at, against, self.side)
            span_2 = line.range(self._against_range(), "study.against_range")
            size = (self.map_points, 2 * self.map_points + 1)
            mapped = stability_map(path, against, (low, high), span_2, size, tell)
            ends = (float(sweep.values[0]), float(sweep.values[-1]))
            at_ends = boundary_along(path, against, ends, span_2, tell)
            sections.append(map_section(path, against, mapped, at_ends))
        return Findings(
            "Root locus",
            _lead(path, sweep, tracks, found, reasons, sides, against, at_ends),
            sections,
            results_of(path, sweep, tracks, found, reasons, sides, against, mapped, at_ends),
            tuple(_warnings(path, sweep, sides)),
        )

    def _against_range(self) -> tuple[float, float] | None:
        usual = self.over is None and self.against in (None, _USUAL_AGAINST)
        return _USUAL_AGAINST_RANGE if usual and self.against_range is None else self.against_range

    def _asked(
        self, model: Model
    ) -> tuple[dict[str, float], str, tuple[float, float] | None, str | None]:
        at = dict(self.at)
        over = line_of(model, at, self.over, "")
        if over:
            return at, over, self.range, self.against
        both = {"pitch", "yaw"} <= set(model.axes)
        if _USUAL_PARAMETER in model.parameters and both:
            return (
                at or dict(_USUAL_AT),
                _USUAL_PARAMETER,
                self.range or _USUAL_RANGE,
                self.against or _USUAL_AGAINST,
            )
        return at, usual_line(model), self.range, self.against


def _sides(
    path: Path, sweep: Sweep, span: tuple[float, float], points: int, tell: Tell
) -> dict[str, list[float]]:
    """Crossings with the slopes of either side, where the points lie on a switch."""
    middle = sweep.places[len(sweep.places) // 2]
    if not path.linear.switches(middle.point.x, middle.point.u, middle.held.p):
        return {}
    found: dict[str, list[float]] = {}
    others: tuple[Side, ...] = ("upper", "lower", "mean")
    for side in others:
        if side == path.side:
            continue
        tell(f"with the slopes of the {side} side")
        other = Path(path.model, path.at, path.over, side)
        run = swept(other, *span, points)
        found[side] = [c.value for c in crossings(other, run) if not c.jumps]
    return found


def _nearest(path: Path, sweep: Sweep, tracks: tuple[Track, ...]) -> Reason | None:
    """The reason for the mode that comes closest to the axis from the left, where it does."""
    best = None
    for track in tracks:
        if track.fast:
            continue
        growth = track.rates.real.max(axis=1)
        varies = float(np.ptp(track.rates.real, axis=0).max()) > _STILL
        k = int(np.argmax(growth))
        if varies and (best is None or growth[k] > best[0]):
            member = track.members[
                int(np.argmax(track.rates[k].real + 1e-12 * track.rates[k].imag))
            ]
            best = (float(growth[k]), k, member, track.name)
    if best is None:
        return None
    found = reason(path, sweep.places[best[1]], best[2], best[3])
    if moves(found.sensitivity):
        return found
    return replace(found, course=course_of(path, sweep, best[1], best[2]))


def _lead(
    path: Path,
    sweep: Sweep,
    tracks: tuple[Track, ...],
    found: tuple[Crossing, ...],
    reasons: list[Reason],
    sides: Mapping[str, list[float]],
    against: str | None,
    at_ends: list[dict[str, Any]],
) -> list[str]:
    unit = f" {path.unit}" if path.unit else ""
    span = f"{path.over} from {sweep.values[0]:.4g} to {sweep.values[-1]:.4g}{unit}"
    words = held_words(path)
    held = words[0].upper() + words[1:]
    told = []
    for c in found:
        name = crossing_name(path.model, tracks, c)
        jump = " by a jump, at a switch" if c.jumps else ""
        pace = f", {c.frequency:.3g} rad/s ({c.frequency / (2 * math.pi):.3g} Hz)"
        told.append(
            f"{held} the {name} crosses the imaginary axis{jump} at "
            f"{path.over} = {c.value:.5g}{unit}{pace if c.frequency else ', at zero frequency'}: "
            f"unstable {'above' if c.unstable_above else 'below'}."
        )
    if not found:
        told.append(f"{held}, {span}: no mode crosses the imaginary axis.")
    for side, values in sides.items():
        if values:
            listed = ", ".join(f"{v:.4g}" for v in values)
            told.append(f"With the slopes of the {side} side of the switch: {listed}{unit}.")
    if reasons:
        told += reason_words(path, reasons[0])
    else:
        told.append(still_words(path))
    for end in at_ends:
        over = amount_words(path.model, path.over, end["over"], 4)
        if not end["crossings"]:
            low, high = end["against_range"]
            told.append(
                f"With {over} no mode crosses for {against} from {low:g} to "
                f"{_bare(path.model, str(against), high)}."
            )
        parts = [
            f"the {c['mode']} is unstable {'above' if c['unstable_above'] else 'below'} "
            f"{amount_words(path.model, str(against), c['value'], 4)}"
            for c in end["crossings"]
        ]
        if parts:
            told.append(f"With {over} {'; '.join(parts)}.")
    return told


def _bare(model: Model, name: str, value: float) -> str:
    """``0.9 rad``."""
    return amount_words(model, name, value).removeprefix(f"{name} = ")


def _warnings(path: Path, sweep: Sweep, sides: Mapping[str, list[float]]) -> list[str]:
    told = []
    if sides:
        told.append(
            "The operating points lie on a switch, where a coefficient depends on a direction: "
            f"the slopes are those of the {path.side}"
            + (" of both sides" if path.side == "mean" else " side")
            + " (study.side)."
        )
    if len(sweep.places) < 2:
        told.append(
            f"There is but one operating point along {path.over}: {sweep.high or sweep.low}."
        )
    return told
