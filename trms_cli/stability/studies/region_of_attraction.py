"""Which starts come to rest at an equilibrium: estimates that are proved, and the region itself."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import (
    Column,
    Datum,
    Findings,
    Judgement,
    Measure,
    Section,
    Table,
    json_data,
    round_significant,
    table,
)
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.stability.attraction.estimates import Method, RegionEstimate
from trms_cli.stability.attraction.loop_region import LoopRegion, loop_region
from trms_cli.stability.attraction.region import (
    SETTLED,
    AttractionRegion,
    ConfidenceShare,
    RegionRequest,
    attraction_region,
    plane_axes,
    plane_starts,
)
from trms_cli.stability.attraction.system import around, complex_text, require_attractive
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

TITLE = "Region of attraction"


@dataclass(frozen=True, kw_only=True)
class RegionOfAttraction(RegionRequest):
    """Estimates of a region of attraction beside the region by simulation."""

    #: Equilibrium: angles (rad) or commands (V). Empty: a main command of 1.8 V, or the rest
    #: without command where the model has no equilibrium at that; with a controller, level, and yaw
    #: at 0.3 rad, where the tail rotor turns.
    at: Mapping[str, float] = field(default_factory=dict)

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Estimate, prove, and simulate.

        Raises TrmsError for an equilibrium that is unstable or marginal, and for a model without
        equations.
        """
        model = subject.require_equations(
            "study=region_of_attraction", "replay the model from the starts of interest (trms run)"
        )
        if subject.loop is not None:
            level = {name: 0.3 if name == "alpha_h" else 0.0 for name in model.controlled}
            point = operating_point(model, self.at or level, "study.at")
            return _loop_findings(loop_region(subject, point, self, tell), self.plane)
        point = self._point(model)
        states = model.state_names if self.states == "all" else self.states or model.controlled
        system = around(model, point, states)
        require_attractive(system)
        region = attraction_region(system, self, tell)
        left_out = subject.left_out_of_equations()
        notes = _warnings(region)
        if left_out:
            notes.append(
                f"{', '.join(left_out)} {'is' if len(left_out) == 1 else 'are'} no part of the "
                "equations, neither in the proofs nor in these simulations."
            )
        data, measures = json_data(_results(region)), _measures(region)
        return Findings(TITLE, _lead(region), _sections(region), data, notes, measures)

    def _point(self, model: Model) -> OperatingPoint:
        if self.at:
            return operating_point(model, self.at, "study.at")
        try:
            return operating_point(model, {"u_v": 1.8})
        except ConfigurationError:
            # No such command, or no rest there (a yaw that nothing holds turns with it).
            return operating_point(model, {}, "study.at")


METHOD = (
    "With y the deviation from the equilibrium, V falls along the motions in each of the sets and "
    "no motion leaves it, so that all that begins in it comes to rest at the equilibrium. "
    "'Lyapunov equation' and 'LMI over a box' write the equations as ẏ = A(y) y with A(y) in an "
    "interval matrix, and prove AᵀP + PA ≺ 0 at all its corners. The other methods take the "
    "largest level set of V in which sampling finds V̇ < 0, and prove V̇ < 0 in it by interval "
    "branch and bound (up to three states; beyond, the boxes would be too many); V is quadratic, "
    "or fitted by linear programmes so that its level set grows: a quadratic with the integrals of "
    "the model's own rates, or a polynomial of degree 4.",
    "The region itself is found by simulation. Mechanical stops are no part of the equations: a "
    "motion that a rig's stop would catch counts here as the equations have it.",
)


def percent(share: ConfidenceShare) -> str:
    """``72 % (67–78 %)``."""
    value, low, high = (100.0 * v for v in (share.value, share.lower, share.upper))
    if value < 0.1:
        wide = low < 0.5 * value or high > 2.0 * value
        return f"{value:.1g} %" + (f" ({low:.1g}–{min(high, 100.0):.1g} %)" if wide else "")
    digits = 0 if value >= 10.0 else max(1, -math.floor(math.log10(max(value, 1e-12))))
    digits, high = min(digits, 6), min(high, 100.0)
    # Ends that look the same, or an end that looks like a certainty, say nothing.
    while digits < 6 and (
        (low < high and f"{low:.{digits}f}" == f"{high:.{digits}f}")
        or (low < 100.0 and float(f"{low:.{digits}f}") == 100.0)
        or (high < 100.0 and float(f"{high:.{digits}f}") == 100.0)
    ):
        digits += 1
    numbers = [f"{v:.{digits}f}" if v < 100.0 else "100" for v in (value, low, high)]
    return f"{numbers[0]} % ({numbers[1]}–{numbers[2]} %)"


def from_to(estimate: RegionEstimate, k: int) -> str:
    """``−0.765 to +1.38``: how far a set goes along a coordinate, from the equilibrium."""
    low, high = (f"{v:+.3g}".replace("-", "−") for v in estimate.bounds[:, k])
    return f"{low} to {high}"


def _measures(region: AttractionRegion) -> list[Measure]:
    """The share that the largest proved set covers, and motions from it that fail."""
    best, proved = region.largest, [v for v in region.verdicts if v.estimate.proved]
    tested, failed = sum(v.tested for v in proved), sum(v.failed for v in proved)
    if best is None:
        return [Measure("proved set", "none", "", "bad")]
    measures = []
    if best.share is not None:
        note = f"of the starts that come to rest, by {best.estimate.label}"
        measures.append(Measure("proved set", percent(best.share), "", "", note))
    if tested:
        good: Judgement = "bad" if failed else "good"
        measures.append(Measure("fail from proved sets", f"{failed} of {tested}", "", good))
    return measures


def _lead(region: AttractionRegion) -> list[str]:
    system = region.system
    place = system.point.words(system.model)
    best = region.largest
    said = []
    if best is None:
        said.append(f"No region around {place} could be proved by the methods asked for.")
    else:
        reach = ", ".join(
            f"{name} {from_to(best.estimate, k)}" for k, name in enumerate(system.names)
        )
        said.append(
            f"All motions that begin in a set around {place} are proved to come to rest there "
            f"({best.estimate.label}). Evaluated on the set, it goes from the equilibrium by "
            f"{reach}; it lies within these bounds and does not fill them: it is no box."
        )
        if best.share is not None:
            said.append(
                f"It covers {percent(best.share)} of the starts in the box that do so in "
                f"simulation; these are {percent(region.truth)} of the box."
            )
    failed = sum(v.failed for v in region.verdicts if v.estimate.proved)
    tested = sum(v.tested for v in region.verdicts if v.estimate.proved)
    if tested:
        said.append(
            f"Of {tested} simulated motions from starts in proved sets {failed or 'none'} failed "
            "to come to rest."
            + (" A proof and the simulation contradict each other." * (failed > 0))
        )
    saddles = [rest for rest in region.rests if not rest.stable]
    if saddles:
        near = saddles[0].y
        away = ", ".join(
            f"{name} {value:+.3g}"
            for name, value in zip(system.names, near, strict=True)
            if abs(value) > 1e-9
        )
        said.append(
            f"The nearest unstable equilibrium that a search from random starts finds is {away} "
            "away."
        )
    return said


def _sections(region: AttractionRegion) -> list[Section]:
    blocks: list[Table | draw.Chart] = [estimate_table(region)]
    if region.plane.axes[0] != region.plane.axes[1]:
        blocks.insert(0, plane_chart(region))
    return [Section("Estimates and the region by simulation", METHOD, blocks)]


_PROVED = {True: Datum("proved", "good"), False: Datum("sampled only", "doubtful")}


def estimate_table(region: AttractionRegion) -> Table:
    """A row for each estimate."""
    labels = region.system.names
    index = max((k for k, name in enumerate(labels) if name.startswith("alpha")), default=0)
    unit = region.system.model.states[region.system.positions[index]].unit
    return table(
        region.verdicts,
        [
            Column("V", lambda v: v.estimate.label),
            Column("is", lambda v: _PROVED[v.estimate.proved]),
            Column(f"{labels[index]} from, to [{unit}]", lambda v: from_to(v.estimate, index)),
            Column("volume", lambda v: round_significant(math.exp(v.estimate.log_volume), 3)),
            Column(
                "of the true region",
                lambda v: percent(v.share) if v.share else "too small to count",
            ),
            Column(
                "of the sampled level",
                lambda v: (
                    f"{v.estimate.level / v.estimate.sampled:.0%}"
                    if v.estimate.sampled is not None
                    else None
                ),
            ),
            Column("boxes", lambda v: v.estimate.boxes or None),
            Column(
                "do not come to rest",
                lambda v: Datum(f"{v.failed} of {v.tested}", "bad" if v.failed else "good"),
            ),
        ],
        f"Volume in the units of {', '.join(labels)}. The true region is counted in a box by "
        f"{region.samples} random starts ({region.undecided} undecided after "
        f"{region.duration:.0f} s); in brackets 95 % confidence. From, to: away from the "
        "equilibrium, evaluated on the set, which is no box. The last column simulates "
        "starts in the set.",
    )


def _results(region: AttractionRegion) -> dict[str, Any]:
    system = region.system

    def by_state(y: FloatArray) -> dict[str, float]:
        return dict(zip(system.names, y, strict=True))

    return {
        "point": dict(zip(system.model.state_names, system.point.x, strict=True)),
        "command": dict(zip(names(system.model.inputs), system.point.u, strict=True)),
        "states": system.names,
        "settled": system.settled,
        "neutral": [system.model.state_names[i] for i in system.neutral],
        "eigenvalues": system.eigenvalues,
        "box": dict(zip(region.starts.names, region.box, strict=True)),
        "true_share_of_box": region.truth,
        "samples": region.samples,
        "undecided": region.undecided,
        "duration": region.duration,
        "estimates": [
            {
                "method": e.method,
                "label": e.label,
                "proved": e.proved,
                "means": e.means,
                "terms": dict(zip(e.candidate.basis.names, e.candidate.weights, strict=True)),
                "level": e.level,
                "sampled_level": e.sampled,
                "samples": e.samples,
                "boxes": e.boxes,
                "half_widths": by_state(e.extents),
                "extent": by_state(e.bounds.T),
                "volume": math.exp(e.log_volume),
                "share_of_true_region": v.share,
                "simulated": v.tested,
                "failed": v.failed,
            }
            for v in region.verdicts
            for e in (v.estimate,)
        ],
        "other_equilibria": [
            {"deviation": by_state(rest.y), "stable": rest.stable} for rest in region.rests
        ],
    }


def _warnings(region: AttractionRegion) -> list[str]:
    said = []
    system = region.system
    if system.settled:
        said.append(
            f"At rest throughout: {', '.join(system.settled)}. What is proved and simulated "
            "holds for motions that begin with them settled, where they stay. "
            "study.states=all lets them deviate too."
        )
    if system.neutral:
        names = ", ".join(system.model.state_names[i] for i in system.neutral)
        said.append(f"{names} moves nothing and is left out: there is no attraction in it.")
    if region.undecided:
        said.append(
            f"{region.undecided} of {region.samples} motions were neither here nor gone for good "
            f"after {region.duration:.0f} s (at rest elsewhere, or still moving), and count as not "
            "attracted."
        )
    if region.is_cut_short:
        said.append(
            f"The slowest mode would need {region.settling_time:.0f} s to die away; motions were "
            f"followed for {region.duration:.0f} s to bound the work, and what had not arrived is "
            "undecided: it widens the upper end of the share. study.duration sets another time."
        )
    if region.nothing:
        said.append(
            f"Nothing, or nothing larger than a quadratic's, was found by: "
            f"{', '.join(region.nothing)}."
        )
    if any(not v.estimate.proved for v in region.verdicts):
        said.append(
            "Sets marked 'sampled only' are not proved: V fell at every sample, and no bound was "
            "found for all points"
            + (". More boxes (study.boxes) may close it." if system.n <= 3 else ", nor tried.")
        )
    slow = np.abs(system.eigenvalues.real).min()
    frequency = max(abs(v) for v in system.eigenvalues)
    if slow < 0.05 * frequency:
        worst = max(system.eigenvalues, key=lambda v: v.real)
        said.append(
            f"The slowest mode ({complex_text(worst)} 1/s) is lightly damped: quadratic functions "
            "cover little there, whatever the method."
        )
    return said


_COLOURS: dict[Method, draw.Colour] = {
    "lyapunov": "ink",
    "inclusion": "purple",
    "level_set": "blue",
    "integrals": "vermilion",
    "quartic": "green",
}
#: Lines of the grid on which V is drawn.
_FINE = 241


def plane_chart(region: AttractionRegion) -> draw.Chart:
    """The plane: the region by simulation, the estimates, other equilibria, motions."""
    i, j = region.plane.axes
    panels = [_panel(region, region.box, "")]
    reaches = [_reach(v.estimate, region) for v in region.verdicts]
    small = [reach for reach in reaches if np.max(reach / region.box[[i, j]]) < 0.25]
    if small:
        box = region.box.copy()
        box[[i, j]] = 1.3 * np.max(small, axis=0)
        panels.append(_panel(region, box, "near the equilibrium"))
    names, model = region.starts.names, region.system.model
    others = [n for k, n in enumerate(names) if k not in (i, j)]
    rest = [*others, *region.system.settled]
    section = f" In the plane {', '.join(rest)} start at rest." if rest else ""
    unproved = any(not v.estimate.proved for v in region.verdicts)
    caption = (
        f"Region of attraction of {region.system.point.words(model)}: shaded, which starts come to "
        "rest there in simulation; lines, what is proved to be attracted"
        + (" (dashed: sampled only)." if unproved else ".")
        + section
    )
    return draw.Chart("region_of_attraction", panels, caption, columns=2, width=4.8, height=4.2)


def _reach(estimate: RegionEstimate, region: AttractionRegion) -> FloatArray:
    """Half-widths of the section of a set with the plane, (2,); tiny for an empty one."""
    axes = list(region.plane.axes)
    half = region.box[axes].copy()
    for _ in range(16):
        x, y = (np.linspace(-h, h, 61) for h in half)
        d = plane_starts(region.plane.axes, x, y, len(region.box))
        inside = np.abs(d[estimate.contains(region.starts.of(d))][:, axes])
        reach = inside.max(axis=0, initial=0.0) + half / 30.0
        if np.all(reach > 0.4 * half):
            return np.asarray(np.minimum(reach, half))
        half = np.minimum(half, np.maximum(1.2 * reach, 0.25 * half))
    return half


def _panel(region: AttractionRegion, box: FloatArray, title: str) -> draw.Panel:
    (i, j), whole = region.plane.axes, title == ""
    origin = _origin(region)
    inside = region.plane.fate == SETTLED
    near = np.ix_(np.abs(region.plane.y) <= box[j], np.abs(region.plane.x) <= box[i])
    marks: list[draw.Mark] = []
    if np.any(inside[near]):
        x, y = origin[i] + region.plane.x, origin[j] + region.plane.y
        marks.append(draw.Region(x, y, inside, "comes to rest (simulated)", "sky", 0.35))
    if whole and region.starts.direct:
        for path, settled in region.plane.paths:
            out = np.any(np.abs(path[:, [i, j]]) > 1.02 * box[[i, j]], axis=1)
            if np.all(out):
                continue
            visible_path = np.where(out[:, None], np.nan, path)
            colour: draw.Colour = "grey" if settled else "orange"
            label = "motions that do" if settled else "motions that do not"
            x, y = origin[i] + visible_path[:, i], origin[j] + visible_path[:, j]
            marks.append(draw.Curve(x, y, label, colour, width=0.7, arrow=True))
    marks += [mark for v in region.verdicts if (mark := _contour(v.estimate, region, box))]
    marks.append(draw.Points([origin[i]], [origin[j]], "equilibrium", "stable", "ink"))
    for rest in region.rests:
        place = rest.y if region.starts.direct else rest.y[: len(box)]
        if np.all(np.abs(place[[i, j]]) <= box[[i, j]]):
            label = "another rest" if rest.stable else "saddle"
            marker: draw.Marker = "stable" if rest.stable else "saddle"
            at = [origin[i] + place[i]], [origin[j] + place[j]]
            marks.append(draw.Points(*at, label, marker, "alarm", size=8))
    x_axis, y_axis = box_axes(region.system.model, region.starts.names, origin, box, (i, j))
    return draw.Panel(x_axis, y_axis, marks, title)


def box_axes(
    model: Model, states: Sequence[str], origin: FloatArray, box: FloatArray, of: tuple[int, int]
) -> list[draw.Axis]:
    """Axes of two states across a box about an origin."""
    return [
        draw.Axis(
            states[k],
            model.states[model.state_index(states[k])].unit,
            (float(origin[k] - box[k]), float(origin[k] + box[k])),
        )
        for k in of
    ]


def _origin(region: AttractionRegion) -> FloatArray:
    model = region.system.model
    return np.array([region.system.point.x[model.state_index(n)] for n in region.starts.names])


def _contour(
    estimate: RegionEstimate, region: AttractionRegion, box: FloatArray
) -> draw.Contour | None:
    i, j = region.plane.axes
    origin = _origin(region)
    # As fine as the set is small.
    half = np.minimum(1.1 * _reach(estimate, region), box[[i, j]])
    x, y = (np.linspace(-h, h, _FINE) for h in half)
    states = region.starts.of(plane_starts((i, j), x, y, len(box)))
    near = np.all(np.abs(np.linalg.solve(estimate.frame, states.T)) <= 1.2, axis=0)
    values = np.where(near, estimate.candidate.values(states) / estimate.level, np.nan)
    visible_values = values.reshape(_FINE, _FINE)[np.ix_(np.abs(y) <= box[j], np.abs(x) <= box[i])]
    # A line that does not cross the window would still be in its legend.
    if not (np.any(visible_values < 1.0) and np.any(visible_values >= 1.0)):
        return None
    label = estimate.label if estimate.proved else f"{estimate.label} (sampled)"
    colour, style = _COLOURS[estimate.method], "solid" if estimate.proved else "dashed"
    grid = origin[i] + x, origin[j] + y, values.reshape(_FINE, _FINE)
    return draw.Contour(*grid, [1.0], label, colour, style, 1.6)  # type: ignore[arg-type]


def _loop_findings(result: LoopRegion, plane: Sequence[str]) -> Findings:
    """The result as a study tells it; ``plane`` names the two states of the figure."""
    runs, region = result.runs, result.region
    name, place = result.controller, result.point.words(result.subject.model)
    widths = ", ".join(f"{n} ±{v:.3g}" for n, v in zip(result.states, result.box, strict=True))
    lead = [
        f"{name} recovered from {runs.count} of {len(runs.recovered)} random starts "
        f"within {widths} around {place} in {result.duration:g} s: "
        f"{percent(runs.share)} of the box."
    ]
    limits = [
        "Runs of the loop start with the observer and the controller at rest; mechanical stops do "
        "not act."
    ]
    sections = [
        Section(
            "Runs of the loop",
            (
                f"A start is recovered if all controlled angles stay within {result.tolerance:g} "
                f"rad of where they belong over the last tenth of {result.duration:g} s.",
            ),
            [*_run_charts(result, plane), _run_table(result)],
        )
    ]
    if region is not None:
        lead += _lead(region)
        if result.inside is not None:
            failures = int((~result.inside.recovered).sum())
            lead.append(
                f"Of {len(result.inside.recovered)} runs of the loop itself from starts in the "
                f"proved set {failures or 'none'} failed to recover."
            )
        limits += [
            "Proofs are about the LQR law in continuous time, with its integral and saturation and "
            "a state that is known; the runs are the loop itself, sampled, with its observer.",
            *_warnings(region),
        ]
        blocks = _sections(region)[0].blocks
        sections.append(Section("Sets proved for the law", METHOD, blocks))
    else:
        limits.append(
            f"Nothing is proved for {name}: only an LQR's law can be written as equations here "
            "(and only where the rig has the states that the controller believes in). The share "
            "is an estimate from runs."
        )
    recovered = f"{runs.count} of {len(runs.recovered)}"
    measures = [Measure("starts recovered", recovered, "", "", f"under {name}")]
    measures += [] if region is None else _measures(region)
    data = json_data(_loop_results(result))
    return Findings(TITLE, lead, sections, data, limits, measures)


def _run_table(result: LoopRegion) -> Table:
    rows = [("random in the box", result.runs, "")]
    if result.inside is not None:
        good = bool(result.inside.recovered.all())
        rows.append(("in the proved set", result.inside, "good" if good else "bad"))
    return table(
        rows,
        [
            Column("starts", lambda row: row[0]),
            Column("runs", lambda row: len(row[1].recovered)),
            Column("recovered", lambda row: Datum(row[1].count, row[2])),
            Column("share (95 % confidence)", lambda row: percent(row[1].share)),
        ],
        "Runs of the loop itself.",
    )


def _run_charts(result: LoopRegion, plane: Sequence[str]) -> list[draw.Chart]:
    model, point, state_names, box = result.subject.model, result.point, result.states, result.box
    signals = [model.states[model.state_index(name)] for name in state_names]
    i, j = plane_axes(state_names, [s.unit for s in signals], plane)
    if not plane and len(state_names) == 2:
        i, j = 0, 1
    if i == j:
        return []
    origin = np.array([point.x[model.state_index(n)] for n in state_names])
    marks: list[draw.Mark] = []
    good, bad = (
        origin + result.runs.d[of] for of in (result.runs.recovered, ~result.runs.recovered)
    )
    if len(good):
        marks.append(draw.Points(good[:, i], good[:, j], "recovers", "dot", "blue"))
    if len(bad):
        marks.append(draw.Points(bad[:, i], bad[:, j], "does not", "cross", "alarm"))
    marks.append(draw.Points([origin[i]], [origin[j]], "equilibrium", "stable", "ink"))
    x, y = box_axes(model, state_names, origin, 1.05 * box, (i, j))
    caption = (
        f"Starts from which the loop of {result.controller} comes back to {point.words(model)}."
    )
    return [draw.Chart("recovered_starts", [draw.Panel(x, y, marks)], caption, 1, 4.8, 4.2)]


def _loop_results(result: LoopRegion) -> dict[str, Any]:
    runs, inside = result.runs, result.inside
    return {
        "runs": {
            "states": result.states,
            "box": dict(zip(result.states, result.box, strict=True)),
            "starts": runs.d,
            "recovered": runs.recovered,
            "share": runs.share,
        },
        "runs_in_proved_set": None
        if inside is None
        else {"starts": inside.d, "recovered": inside.recovered},
        "law": None if result.region is None else _results(result.region),
    }
