"""``study=root_locus``: eigenvalues over an input or a parameter, where they cross, and why."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from scipy.optimize import brentq

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Axis, Chart, Contour, Line, Mark, Panel, Points, Region
from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import (
    Block,
    Column,
    Datum,
    Findings,
    Measure,
    Section,
    json_data,
    round_significant,
    table,
)
from trms_cli.core.wording import with_unit
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.local import sensitivity
from trms_cli.stability.local.linear import STILL, Side, rate_of
from trms_cli.stability.local.sweep import (
    Locus,
    OperatingPath,
    amount_words,
    crossings,
    line_of,
    locus_of,
    sweep_eigenvalues,
    unit_of,
    usual_line,
)
from trms_cli.stability.local.tables import crossing_data, locus_data, locus_section
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

#: Boundary points are located to this share of a cell.
_EXACT = 1e-10


@dataclass(frozen=True)
class StabilityMap:
    """The largest growth rate over two numbers."""

    against: str  #: The second number
    over_values: FloatArray  #: (n,) array
    against_values: FloatArray  #: (m,) array
    #: (m, n) array; largest Re λ of what is not at rest on the imaginary axis throughout, 1/s; NaN
    #: where there is no operating point within the rig's limits
    largest_growth_1_s: FloatArray
    #: (k, 2) array; points (over, against) where it is zero, each located along ``over``
    boundary: FloatArray
    #: Crossings along the second number, at some values of the first
    along_against: Sequence[dict[str, Any]] = ()


def stability_map(
    path: OperatingPath,
    against: str,
    over_range: tuple[float, float],
    against_range: tuple[float, float],
    size: tuple[int, int],
    tell: Tell,
) -> StabilityMap:
    """Evaluate a grid of some size, row by row along the operating points of the path."""
    over = np.linspace(*over_range, size[0])
    levels = np.linspace(*against_range, size[1])
    growth = np.full((len(levels), len(over)), np.nan)
    boundary: list[tuple[float, float]] = []
    begin: OperatingPoint | None = None
    condition = None
    for i, level in enumerate(levels):
        if i % 8 == 0:
            tell(f"map, {100 * i // len(levels)} %")
        row = path.with_value(against, float(level))
        following = row.condition(float(over[0]))
        if begin is None:
            begin = _anywhere(row, float(over[0]))
        elif condition is not None:
            begin = row.balance.advance(condition, following, begin) or _anywhere(
                row, float(over[0])
            )
        condition = following
        if begin is not None:
            growth[i], zeros = _row(row, over, begin)
            boundary += [(zero, float(level)) for zero in zeros]
    return StabilityMap(against, over, levels, growth, np.array(boundary).reshape(-1, 2))


def _anywhere(path: OperatingPath, value: float) -> OperatingPoint | None:
    try:
        return path.first(value, value).point
    except TrmsError:
        return None


def _row(
    path: OperatingPath, over: FloatArray, begin: OperatingPoint
) -> tuple[FloatArray, list[float]]:
    """One row of the map, and where it is zero."""
    row, zeros = np.full(len(over), np.nan), []
    point: OperatingPoint | None = begin
    last = path.condition(float(over[0]))
    for k, value in enumerate(over):
        condition = path.condition(float(value))
        before = point
        point = path.balance.advance(last, condition, before) if before is not None else None
        if point is None:
            break
        if path.balance.within_limits(point):
            row[k] = _growth(path, float(value), point)
        if k and row[k - 1] * row[k] < 0 and before is not None:
            here, start = last, before

            def rate(v: float, here=here, start=start) -> float:  # type: ignore[no-untyped-def]
                at = path.balance.advance(here, path.condition(v), start)
                return np.nan if at is None else _growth(path, v, at)

            with contextlib.suppress(ValueError, RuntimeError):
                cell = float(over[k] - over[k - 1])
                root = brentq(rate, over[k - 1], value, xtol=_EXACT * abs(cell))
                if abs(rate(root)) < 1e-6:
                    zeros.append(float(root))
        last = condition
    return row, zeros


def _growth(path: OperatingPath, value: float, point: OperatingPoint) -> float:
    a = path.linear.a(point.x, point.u, path.side, path.condition(value).p)
    rates = [rate_of(v, path.model.sample_time) for v in np.linalg.eigvals(a)]
    moving = [rate.real for rate in rates if abs(rate) > STILL and np.isfinite(rate.real)]
    return max(moving, default=0.0)


#: 1/s: growth rates whose lines are drawn.
_LEVELS = (-0.1, -0.04, -0.02, 0.02, 0.1, 0.3)


def boundary_along(
    path: OperatingPath,
    against: str,
    span: tuple[float, float],
    span_2: tuple[float, float],
    tell: Tell,
) -> list[dict[str, Any]]:
    """Where stability ends along the second number, at both ends and the model's own value."""
    own = [path.began] if span[0] < path.began < span[1] else []
    boundaries = []
    for value in (span[0], *own, span[1]):
        tell(f"along {against} at {amount_words(path.model, path.over, value, 4)}")
        line = OperatingPath(path.model, path.at, against, path.side).with_value(path.over, value)
        try:
            run = sweep_eigenvalues(line, *span_2, 41)
        except TrmsError:
            continue  # no operating point there: the map has a hole
        locus = locus_of(line, run)
        boundaries.append(
            {
                "over": float(value),
                "against_range": [float(run.values[0]), float(run.values[-1])],
                "crossings": crossing_data(locus),
            }
        )
    return boundaries


def map_section(path: OperatingPath, mapped: StabilityMap) -> Section:
    """The map, and where stability ends along the second number."""
    against, growth = mapped.against, mapped.largest_growth_1_s
    grid = mapped.over_values, mapped.against_values
    nowhere, finite = ~np.isfinite(growth), growth[np.isfinite(growth)]
    unit_2 = unit_of(path.model, against)
    marks: list[Mark] = []
    if (growth > 0).any():
        marks.append(Region(*grid, growth > 0, "unstable", "alarm", 0.14))
    if nowhere.any():
        marks.append(Region(*grid, nowhere, "no operating point within the limits", "grey", 0.3))
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 0.0)
    if low < 0 < high:
        marks.append(Contour(*grid, growth, [0.0], "boundary", "alarm", width=2.2))
    levels = [level for level in _LEVELS if low < level < high]
    if len(levels) < 2 and low < high:
        # None of the usual ones lies within: some that do.
        levels = [float(f"{v:.2g}") for v in np.linspace(low, high, 7)[1:-1]]
    if levels:
        levels, label = sorted(set(levels)), "largest Re λ [1/s]"
        marks.append(Contour(*grid, growth, levels, label, "grey", "dotted", 1.0, True))
    if len(mapped.boundary):
        located = mapped.boundary[:, 0], mapped.boundary[:, 1]
        marks.append(Points(*located, "located", "dot", "alarm", size=3.0))
    inside, rows = ((float(ends[0]), float(ends[-1])) for ends in grid)
    rim = 0.01 * (inside[1] - inside[0])
    if inside[0] + rim < path.began < inside[1] - rim:  # on the frame it could not be told from it
        own = f"the model's {path.over}"
        marks.append(Line(x=path.began, label=own, colour="ink", style="dashed"))
    conditions = {name: v for name, v in path.at.items() if name not in (path.over, against)}
    where = "".join(f", {amount_words(path.model, name, v)}" for name, v in conditions.items() if v)
    caption = f"Largest growth rate over {path.over} and {against}{where}."
    panel = Panel(Axis(path.over, path.unit, inside), Axis(against, unit_2, rows), marks)
    chart = Chart("root_locus_map", [panel], caption, 1, 7.2, 5.0)
    ends = table(
        (c | {"over": end["over"]} for end in mapped.along_against for c in end["crossings"]),
        [
            Column(path.head, lambda c: round_significant(c["over"], 5)),
            Column("mode", "mode"),
            Column(with_unit(against, unit_2), lambda c: round_significant(c["value"], 5)),
            Column("ω [rad/s]", lambda c: round_significant(c["frequency_rad_s"])),
            Column("unstable", lambda c: "above" if c["unstable_above"] else "below"),
        ],
        f"Where stability ends along {against}.",
    )
    text = [
        f"The largest growth rate of what is not at rest on the imaginary axis, over {path.over} "
        f"and {against}; the boundary is located along {path.over} in each row of the grid."
    ]
    return Section(f"{path.over} against {against}", text, [chart, *([ends] if ends.rows else [])])


#: What a model of the TRMS is asked when nothing is said: the thesis's value of k_g is 16 times
#: the maker's.
_USUAL_PARAMETER, _USUAL_RANGE, _USUAL_AT = "k_g", (0.0123, 0.2), {"alpha_v": 0.4}
#: 1/s: a growth rate that changes by less over the whole range does not move.
_STILL = 1e-6
_KINDS = {True: "Hopf", False: "at zero"}
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
        at, over, span, against = self._request(model)
        path = OperatingPath(model, at, over, self.side)
        low, high = path.range(span)
        tell(f"over {over}")
        locus = locus_of(path, sweep_eigenvalues(path, low, high, self.points))
        sides = _sides(locus, (low, high), self.points, tell)
        tell("why")
        reasons = [
            sensitivity.mode_sensitivity(path, c.place, c.track, locus.name(c))
            for c in locus.crossings
        ] or _nearest(locus)
        sections = [_locus_section(locus), _why_section(locus, reasons)]
        mapped = None
        if against is not None:
            usual = self.over is None and self.against in (None, _USUAL_AGAINST)
            requested_range = self.against_range or (_USUAL_AGAINST_RANGE if usual else None)
            line = OperatingPath(model, at, against, self.side)
            span_2 = line.range(requested_range, "study.against_range")
            size = (self.map_points, 2 * self.map_points + 1)
            mapped = stability_map(path, against, (low, high), span_2, size, tell)
            ends = (float(locus.sweep.values[0]), float(locus.sweep.values[-1]))
            along = boundary_along(path, against, ends, span_2, tell)
            mapped = replace(mapped, along_against=along)
            sections.append(map_section(path, mapped))
        results = {
            "held": {name: v for name, v in path.at.items() if name != path.over},
            "locus": locus_data(locus),
            "crossings": crossing_data(locus),
            "crossings_by_side": sides,
            "why": [sensitivity.sensitivity_data(path, reason) for reason in reasons],
        } | ({} if mapped is None else {"map": mapped})
        lead, measures = _lead(locus, reasons, sides, mapped), _measures(locus)
        data, warnings = json_data(results), _warnings(locus, sides)
        return Findings("Root locus", lead, sections, data, warnings, measures)

    def _request(
        self, model: Model
    ) -> tuple[dict[str, float], str, tuple[float, float] | None, str | None]:
        at = dict(self.at)
        over = line_of(model, at, self.over, "")
        if over:
            return at, over, self.range, self.against
        if _USUAL_PARAMETER in model.parameters and {"pitch", "yaw"} <= set(model.axes):
            at, span = at or dict(_USUAL_AT), self.range or _USUAL_RANGE
            return at, _USUAL_PARAMETER, span, self.against or _USUAL_AGAINST
        return at, usual_line(model), self.range, self.against


def _sides(
    locus: Locus, span: tuple[float, float], points: int, tell: Tell
) -> dict[str, list[float]]:
    """Crossings with the slopes of either side, where the points lie on a switch."""
    path = locus.path
    middle = locus.sweep.places[len(locus.sweep.places) // 2]
    if not path.linear.switches(middle.point.x, middle.point.u, middle.condition.p):
        return {}
    values: dict[str, list[float]] = {}
    every: tuple[Side, ...] = ("upper", "lower", "mean")
    for side in (side for side in every if side != path.side):
        tell(f"with the slopes of the {side} side")
        other = OperatingPath(path.model, path.at, path.over, side)
        crossed = crossings(other, sweep_eigenvalues(other, *span, points))
        values[side] = [c.value for c in crossed if not c.jumps]
    return values


def _nearest(locus: Locus) -> list[sensitivity.ModeSensitivity]:
    """The reason for the mode that comes closest to the axis from the left, where one does."""
    varying = [t for t in locus.slow if float(np.ptp(t.rates.real, axis=0).max()) > _STILL]
    if not varying:
        return []
    track = max(varying, key=lambda track: float(track.rates.real.max()))
    k = int(np.argmax(track.rates.real.max(axis=1)))
    member = track.members[int(np.argmax(track.rates[k].real + 1e-12 * track.rates[k].imag))]
    nearest = sensitivity.mode_sensitivity(locus.path, locus.sweep.places[k], member, track.name)
    if sensitivity.moves(nearest.sensitivity):
        return [nearest]
    return [replace(nearest, course=sensitivity.growth_trend(locus.path, locus.sweep, k, member))]


def _locus_section(locus: Locus) -> Section:
    """The crossings, the table over the range and the figures."""
    path = locus.path
    crossed = table(
        locus.crossings,
        [
            Column("mode", locus.name),
            Column(path.head, lambda c: round_significant(c.value, 6)),
            Column("ω [rad/s]", lambda c: round_significant(c.frequency)),
            Column("f [Hz]", lambda c: round_significant(c.frequency / (2 * math.pi))),
            Column("kind", lambda c: "jump at a switch" if c.jumps else _KINDS[c.frequency > 0]),
            Column("unstable", lambda c: Datum(c.side, "bad")),
        ],
        "Crossings of the imaginary axis.",
    )
    return locus_section(
        f"Eigenvalues over {path.over}",
        f"The operating point is solved anew for each {path.over}; crossings are located by "
        "Brent's method on the real part of the tracked eigenvalue.",
        locus,
        ("root_locus", "root_locus_range"),
        path.began,
        f", {_held_words(path)}",
        first=[crossed] if crossed.rows else (),
        digits=4,
    )


def _why_section(locus: Locus, reasons: list[sensitivity.ModeSensitivity]) -> Section:
    """The shares of dλ/dp at each crossing."""
    path = locus.path
    text = [
        "dλ/dp = wᵀ (dA/dp) v / (wᵀv), entry by entry of A: each entry is a physical equation "
        "(row) by what it depends on (column). dA/dp is exact and follows the operating point.",
        "A loop is a cycle of the signal flow graph of sI − A through the entry with the largest "
        "share, taken at s = λ: the strongest is told.",
    ]
    blocks: list[Block] = []
    for reason in reasons:
        text += sensitivity.sensitivity_words(path, reason)
        if sensitivity.moves(reason.sensitivity):
            blocks.append(sensitivity.share_table(path, reason))
    if not reasons:
        text.append(_still_words(path))
    if reasons and len(locus.sweep.places) > 2:
        mode = reasons[0].mode
        own = (track.members[0] for track in locus.tracks if track.name == mode)
        member = locus.crossings[0].track if locus.crossings else next(own)
        chart = sensitivity.share_chart("root_locus_why", path, locus.sweep, member, mode)
        blocks += [] if chart is None else [chart]
    return Section("Why", text, blocks)


def _measures(locus: Locus) -> list[Measure]:
    """Where modes cross the imaginary axis, the first three of them."""
    path = locus.path
    measures = [Measure("crossings", len(locus.crossings), "", "", f"over {path.over}")]
    for c in locus.crossings[:3]:
        measures.append(Measure(path.over, c.value, path.unit, "", f"unstable {c.side}"))
    return measures


def _lead(
    locus: Locus,
    reasons: list[sensitivity.ModeSensitivity],
    sides: Mapping[str, list[float]],
    mapped: StabilityMap | None,
) -> list[str]:
    path, values = locus.path, locus.sweep.values
    unit = f" {path.unit}" if path.unit else ""
    words = _held_words(path)
    opening = words[0].upper() + words[1:]
    sentences = []
    for c in locus.crossings:
        jump = " by a jump, at a switch" if c.jumps else ""
        pace = f", {c.frequency:.3g} rad/s ({c.frequency / (2 * math.pi):.3g} Hz)"
        sentences.append(
            f"{opening} the {locus.name(c)} crosses the imaginary axis{jump} at "
            f"{path.over} = {c.value:.5g}{unit}{pace if c.frequency else ', at zero frequency'}: "
            f"unstable {c.side}."
        )
    if not locus.crossings:
        span = f"{path.over} from {values[0]:.4g} to {values[-1]:.4g}{unit}"
        sentences.append(f"{opening}, {span}: no mode crosses the imaginary axis.")
    for side, crossed in sides.items():
        if crossed:
            listed = ", ".join(f"{v:.4g}" for v in crossed)
            sentences.append(f"With the slopes of the {side} side of the switch: {listed}{unit}.")
    sentences += (
        sensitivity.sensitivity_words(path, reasons[0]) if reasons else [_still_words(path)]
    )
    if mapped is None:
        return sentences
    against = mapped.against
    for end in mapped.along_against:
        over = amount_words(path.model, path.over, end["over"], 4)
        if not end["crossings"]:
            low, high = end["against_range"]
            top = amount_words(path.model, against, high).removeprefix(f"{against} = ")
            sentences.append(f"With {over} no mode crosses for {against} from {low:g} to {top}.")
            continue
        parts = [
            f"the {c['mode']} is unstable {'above' if c['unstable_above'] else 'below'} "
            f"{amount_words(path.model, against, c['value'], 4)}"
            for c in end["crossings"]
        ]
        sentences.append(f"With {over} {'; '.join(parts)}.")
    return sentences


def _held_words(path: OperatingPath) -> str:
    """``at alpha_v = 0.4 rad``: what is held besides what is varied."""
    model = path.model
    at, nothing = path.at, "at rest without command"
    if path.kind == "angle" and not at.keys() - {path.over}:
        at, nothing = dict.fromkeys(model.controlled, 0.0), "held by its command"
    conditions = [amount_words(model, name, v) for name, v in at.items() if name != path.over]
    return f"at {', '.join(conditions)}" if conditions else nothing


def _still_words(path: OperatingPath) -> str:
    return f"Over this range {path.over} moves no growth rate, but for rounding."


def _warnings(locus: Locus, sides: Mapping[str, list[float]]) -> list[str]:
    path, sweep = locus.path, locus.sweep
    side = "mean of both sides" if path.side == "mean" else f"{path.side} side"
    switch = (
        "The operating points lie on a switch, where a coefficient depends on a direction: the "
        f"slopes are those of the {side} (study.side)."
    )
    alone = f"There is but one operating point along {path.over}: {sweep.high or sweep.low}."
    return [*([switch] if sides else []), *([alone] if len(sweep.places) < 2 else [])]
