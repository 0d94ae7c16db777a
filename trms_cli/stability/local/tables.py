"""Modes and loci of eigenvalues in words, tables, figures and data.

The figures: the complex plane with trajectories, and damping and frequency over a range.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from trms_cli.core.arrays import ComplexArray
from trms_cli.core.chart import (
    Axis,
    Chart,
    Colour,
    Curve,
    Line,
    Mark,
    Marker,
    Panel,
    Points,
    Region,
    Style,
)
from trms_cli.core.findings import (
    Block,
    Cell,
    Column,
    Datum,
    Judgement,
    Section,
    Table,
    round_significant,
    table,
)
from trms_cli.models.model import Model
from trms_cli.stability.local import linear
from trms_cli.stability.local.sweep import Crossing, Locus, Track, amount_words, cell, unit_of

_JUDGED: dict[str, Judgement] = {"stable": "good", "marginal": "doubtful", "unstable": "bad"}
#: Rows of the table over a range.
_ROWS = 9


def eigenvalue_words(value: complex, digits: int = 4) -> str:
    """``−0.047 ± 1.83j``."""
    both = [value, value.conjugate()] if abs(value.imag) > linear.STILL else [value]
    return cell(np.array(both), digits)


def mode_table(modes: linear.Modes, caption: str = "") -> Table:
    """Names, eigenvalues, damping, frequencies, time constants, verdicts."""

    def swing(
        value: Callable[[linear.EigenMode], float | None],
    ) -> Callable[[linear.EigenMode], Cell]:
        """A cell of what swings only."""
        return lambda mode: _sig(value(mode)) if mode.oscillates else None

    def verdict(mode: linear.EigenMode) -> Datum:
        grows = mode.verdict == "unstable" and mode.eigenvalue.real <= linear.STILL
        words = "unstable (grows with t)" if grows else mode.verdict
        return Datum(words, _JUDGED[mode.verdict])

    return table(
        modes.modes,
        [
            Column("mode", lambda m: m.name + f" (×{m.multiplicity})" * (m.multiplicity > 1)),
            Column("λ [1/s]", lambda m: eigenvalue_words(m.eigenvalue, 3)),
            Column("damping ζ", swing(lambda m: m.damping_ratio)),
            Column("ω_n [rad/s]", lambda m: _sig(m.natural_frequency)),
            Column("ω_d [rad/s]", swing(lambda m: m.damped_frequency)),
            Column("f_d [Hz]", swing(lambda m: m.damped_frequency / (2 * math.pi))),
            Column("τ [s]", lambda m: _sig(m.time_constant)),
            Column("verdict", verdict),
        ],
        caption,
    )


def participation_table(model: Model, modes: linear.Modes) -> Table:
    """Shares of the states in each mode, in percent."""
    return Table(
        ("mode", *(f"{name} [%]" for name in model.state_names)),
        [
            [mode.name, *(round(100.0 * float(share), 1) for share in mode.participation)]
            for mode in modes.modes
        ],
        "Participation factors |w_i v_i| as shares of their sum.",
        on_screen=False,
    )


def range_table(locus: Locus) -> Table:
    """λ of each mode at some points of the range."""
    path, sweep = locus.path, locus.sweep
    count = len(sweep.places)
    targets = np.linspace(sweep.values[0], sweep.values[-1], min(_ROWS, count))
    indices = sorted({int(np.argmin(np.abs(sweep.values - value))) for value in targets})
    slow, hidden = locus.slow, [track for track in locus.tracks if track.fast]
    commands = () if path.kind == "command" else path.model.inputs

    def judged(rates: ComplexArray) -> Datum:
        growth = float(rates.real.max())
        judgement: Judgement = "doubtful" if abs(growth) <= linear.STILL else ""
        return Datum(cell(rates), "bad" if growth > linear.STILL else judgement)

    note = ", ".join(f"{track.name} ({cell(track.rates[count // 2])} 1/s)" for track in hidden)
    return Table(
        (
            path.head,
            *(f"{s.name} [{s.unit}]" for s in commands),
            *(f"{t.name} [1/s]" for t in slow),
        ),
        [
            (
                _sig(sweep.places[k].value),
                *(_sig(u) for u in sweep.places[k].point.u if commands),
                *(judged(track.rates[k]) for track in slow),
            )
            for k in indices
        ],
        f"Not shown, as too fast to matter here: {note}." if hidden else "",
    )


def switch_words(model: Model, switch: linear.Switch) -> str:
    """What a point on a switch means, in a sentence."""
    state = model.states[switch.state]
    entries = "; ".join(
        f"∂(d{model.state_names[i]}/dt)/∂{model.state_names[j]} is {up:.4g} above and {down:.4g} "
        "below"
        for (i, j), up, down in zip(switch.entries, switch.upper, switch.lower, strict=True)
    )
    return (
        f"The point lies on a switch: coefficients depend on the side of {state.name} "
        f"({state.description or state.unit}). {entries}."
    )


def mode_data(model: Model, mode: linear.EigenMode) -> dict[str, Any]:
    """A mode as JSON data."""
    return {
        "name": mode.name,
        "real": mode.eigenvalue.real,
        "imag": mode.eigenvalue.imag if mode.oscillates else 0.0,
        "multiplicity": mode.multiplicity,
        "defective": mode.defective,
        "alternating": mode.alternating,
        "damping_ratio": mode.damping_ratio,
        "natural_frequency_rad_s": mode.natural_frequency,
        "damped_frequency_rad_s": mode.damped_frequency,
        "damped_frequency_hz": mode.damped_frequency / (2 * math.pi),
        "time_constant_s": mode.time_constant,
        "verdict": mode.verdict,
        "participation": dict(zip(model.state_names, mode.participation, strict=True)),
    }


def locus_data(locus: Locus) -> dict[str, Any]:
    """A locus as JSON data: values, commands, and λ of every mode."""
    path, sweep, model = locus.path, locus.sweep, locus.path.model
    return {
        "over": path.over,
        "unit": unit_of(path.model, path.over),
        "side": path.side,
        "values": sweep.values,
        "commands": {
            signal.name: [place.point.u[i] for place in sweep.places]
            for i, signal in enumerate(model.inputs)
        },
        "controlled": {
            name: [place.point.x[model.state_index(name)] for place in sweep.places]
            for name in model.controlled
        },
        "ended_low": sweep.low or None,
        "ended_high": sweep.high or None,
        "modes": [
            {
                "name": track.name,
                "part": track.part,
                "fast": track.fast,
                "real": track.rates.T.real,
                "imag": track.rates.T.imag,
            }
            for track in locus.tracks
        ],
    }


def crossing_data(locus: Locus) -> list[dict[str, Any]]:
    """Its crossings as JSON data."""
    return [
        {
            "mode": locus.name(crossing),
            "value": crossing.value,
            "frequency_rad_s": crossing.frequency,
            "frequency_hz": crossing.frequency / (2 * math.pi),
            "kind": "jump" if crossing.jumps else crossing.kind,
            "unstable_above": crossing.unstable_above,
        }
        for crossing in locus.crossings
    ]


def exchange_words(locus: Locus) -> list[str]:
    """Where a curve ceases to be of the part that it is named after, towards an end of the range.

    Eigenvalues are followed without a break, and what they are of changes along them: two modes
    that come close exchange their parts.
    """
    path, sweep = locus.path, locus.sweep
    parts = linear.parts_of(path.model)
    sentences = []
    for track in (track for track in locus.slow if track.part in path.model.axes):
        own = []
        for place in sweep.places:
            shares = [place.spectrum.participation(i) for i in track.members]
            own.append(next(iter(linear.shares_of_parts(parts, np.mean(shares, axis=0)))))
        for end, step, side in ((0, 1, "below"), (-1, -1, "above")):
            other = own[end]
            if other == track.part or track.part not in own:
                continue
            run = next(k for k, part in enumerate(own[::step]) if part != other)
            value = sweep.values[::step][run - 1]
            sentences.append(
                f"{side.capitalize()} {amount_words(path.model, path.over, value, 4)} the curve "
                f"named “{track.name}” is mostly of the {other}: modes that come close exchange "
                "what they are of, and a curve is named after its average."
            )
    return sentences


def _sig(value: float | None) -> float | None:
    return 0.0 if value is not None and abs(value) < 1e-9 else round_significant(value)


_OF_PART: dict[str, Colour] = {
    "pitch": "blue",
    "yaw": "vermilion",
    "main rotor": "green",
    "tail rotor": "purple",
}
_OTHERS: tuple[Colour, ...] = ("orange", "sky", "ink", "yellow", "grey")
_STYLES: tuple[Style, ...] = ("solid", "dashed", "dotted")
_MARKERS: tuple[Marker, ...] = ("dot", "square", "triangle", "star")
#: Damping ratios whose lines are drawn in the plane.
_DAMPING = (0.1, 0.3, 0.6)


def colours_of(tracks: Sequence[Track]) -> dict[str, Colour]:
    """A colour for each mode by its part; what has none of its own takes the next one free."""
    colours: dict[str, Colour] = {}
    used: set[Colour] = set()
    free = iter([*_OTHERS] * (len(tracks) + 1))
    for track in tracks:
        part_colour = _OF_PART.get(track.part)
        colours[track.name] = (
            part_colour if part_colour is not None and part_colour not in used else next(free)
        )
        used.add(colours[track.name])
    return colours


def styles_of(colours: Mapping[str, Colour]) -> dict[str, Style]:
    """A style for each mode, so that two of one colour differ."""
    uses: dict[Colour, int] = {}
    styles: dict[str, Style] = {}
    for name, colour in colours.items():
        styles[name] = _STYLES[uses.get(colour, 0) % len(_STYLES)]
        uses[colour] = uses.get(colour, 0) + 1
    return styles


def locus_section(
    heading: str,
    method: str,
    locus: Locus,
    charts: tuple[str, str],
    value: float,
    where: str,
    *,
    first: Sequence[Block] = (),
    digits: int = 3,
    note: str = "",
) -> Section:
    """A range: tables, the complex plane with trajectories, damping and frequency over it.

    ``value`` is that of what is varied at the operating point, told with some digits; ``where``
    says in the captions what is held, ``note`` stands at the end of the second. Nothing is shown of
    a range of one point.
    """
    path, values = locus.path, locus.sweep.values
    text = [method, *locus.sweep.early_ends, *exchange_words(locus)]
    if len(values) < 2:
        return Section(heading, text)
    at = int(np.argmin(np.abs(values - value)))
    low, high = (f"{v:.3g} {path.unit}".rstrip() for v in (values[0], values[-1]))
    here = f"{values[at]:.{digits}g} {path.unit}".rstrip()
    caption = (
        f"Eigenvalues as {path.over} goes from {low} to {high}{where}; discs: {path.over} = {here}."
    )
    over = f"Damping and frequency over {path.over}{where}{note}."
    plane = _plane(charts[0], locus, at, (low, high), caption)
    return Section(
        heading, text, [*first, range_table(locus), plane, _range(charts[1], locus, value, over)]
    )


def _plane(name: str, locus: Locus, at: int, ends: tuple[str, str], caption: str) -> Chart:
    """The complex plane: where each mode is at one point, and how it moves over the range."""
    over, slow, crossings = locus.path.over, locus.slow, locus.crossings
    colours = colours_of(slow)
    styles = styles_of(colours)
    everything = np.concatenate([track.rates.ravel() for track in slow])
    left, right = float(everything.real.min()), float(everything.real.max())
    top = float(np.abs(everything.imag).max())
    width = max(right - left, 0.3, 0.15 * top)
    x = (left - 0.08 * width, max(right, 0.0) + 0.12 * width)
    y = 1.12 * top if top > linear.STILL else 0.5
    # The half plane in which motions grow.
    right_half = np.array([0.0, x[1]]), np.array([-y, y]), np.ones((2, 2), dtype=bool)
    marks: list[Mark] = [Region(*right_half, "unstable", "alarm", 0.07)]
    if top > linear.STILL:
        marks += _damping_lines(x[0], y)
    marks.append(Line(x=0.0, colour="ink", style="solid"))
    for track in slow:
        look = track.name, colours[track.name], styles[track.name]
        marks += [Curve(column.real, column.imag, *look, width=2.0) for column in track.rates.T]
    for track in slow:
        here = track.rates[at]
        marks.append(Points(here.real, here.imag, "", "dot", colours[track.name], size=8.0))
    for label, k, marker, size in (
        (f"{over} = {ends[0]}", 0, "square", 4.0),
        (f"{over} = {ends[1]}", -1, "triangle", 5.0),
    ):
        both = np.concatenate([track.rates[k] for track in slow])
        marks.append(Points(both.real, both.imag, label, marker, "ink", size=size))  # type: ignore[arg-type]
    if crossings:
        flat = [c for c in crossings if not c.jumps]
        at_axis, values = [0.0] * len(flat), [f"{c.value:.4g}" for c in flat]
        frequencies = [c.frequency for c in flat]
        marks.append(Points(at_axis, frequencies, "crosses", "star", "alarm", values, 7.0))
    panel = Panel(Axis("Re λ", "1/s", x), Axis("Im λ", "rad/s", (-y, y)), marks)
    close = _close_up(slow, crossings, x, y)
    if close is None:
        return Chart(name, [panel], caption, 1, 7.2, 5.0)
    whole = Panel(panel.x, panel.y, marks, "all modes")
    near = Panel(Axis("Re λ", "1/s", close[0]), Axis("Im λ", "rad/s", close[1]), marks, close[2])
    return Chart(name, [whole, near], caption, 2, 5.4, 4.4)


def _close_up(
    tracks: Sequence[Track], crossings: Sequence[Crossing], x: tuple[float, float], y: float
) -> tuple[tuple[float, float], tuple[float, float], str] | None:
    """Limits around the mode that crosses first, where it is small in the whole, and its name."""
    if not crossings:
        return None
    own = [track for track in tracks if crossings[0].track in track.members]
    if not own:
        return None
    rates = own[0].slowest
    spans = []
    for part, whole in ((rates.real, x[1] - x[0]), (rates.imag, 2 * y)):
        low, high = float(part.min()), float(part.max())
        if high - low > 0.3 * whole:
            return None
        margin = 0.25 * (high - low) + 0.01 * whole
        spans.append((low - margin, high + margin))
    return spans[0], spans[1], own[0].name


def _range(name: str, locus: Locus, at: float, caption: str) -> Chart:
    """Growth rate, damping ratio, frequency and pace of each mode over what is varied."""
    axis, tracks, values = Axis(locus.path.over, locus.path.unit), locus.tracks, locus.sweep.values
    colours = colours_of(tracks)
    styles = styles_of(colours)
    axis_of_growth = Line(y=0.0, colour="ink", style="solid")
    growth: list[Mark] = [axis_of_growth, Line(x=at)]
    damping: list[Mark] = [axis_of_growth, Line(x=at)]
    frequency: list[Mark] = [Line(x=at)]
    pace: list[Mark] = [Line(x=at)]
    for track in tracks:
        look = track.name, colours[track.name], styles[track.name]
        for k, column in enumerate(track.rates.T):
            size = np.abs(column)
            pace_values = np.where((size > linear.STILL) & np.isfinite(size), size, np.nan)
            if k == 0 or np.any(np.abs(size - np.abs(track.rates[:, 0])) > 1e-9):
                pace.append(Curve(values, pace_values, *look))
            if track.fast:
                continue
            swings = np.abs(column.imag) > linear.STILL
            if k == 0 or np.any(np.abs(column.real - track.rates[:, 0].real) > 1e-9):
                growth.append(Curve(values, column.real, *look))
            if k == 0 and swings.any():
                ratio = np.where(swings, -column.real / np.maximum(size, linear.STILL), np.nan)
                hertz = np.where(swings, np.abs(column.imag) / (2 * math.pi), np.nan)
                damping.append(Curve(values, ratio, *look))
                frequency.append(Curve(values, hertz, *look))
    panels = [Panel(axis, Axis("Re λ", "1/s"), growth, "growth rate")]
    if len(frequency) > 1:
        panels.append(Panel(axis, Axis("damping ratio ζ"), damping, "damping of what swings"))
        panels.append(Panel(axis, Axis("Im λ / 2π", "Hz"), frequency, "frequency of what swings"))
    if len(locus.slow) < len(tracks) or len(panels) == 3:
        panels.append(Panel(axis, Axis("|λ|", "1/s", log=True), pace, "pace, all modes"))
    return Chart(name, panels, caption, 2, 4.6, 3.2)


def points_alone(name: str, modes: linear.Modes, caption: str = "") -> Chart:
    """The complex plane of one operating point with the modes' names."""
    finite = [m for m in modes.modes if np.isfinite(m.eigenvalue.real)]
    slowest = sorted(finite, key=lambda m: m.natural_frequency)
    limit = 8.0 * max(slowest[0].natural_frequency, 5.0) if slowest else 0.0
    visible_modes = [m for m in slowest if m.natural_frequency <= limit]
    marks: list[Mark] = [Line(x=0.0, colour="ink", style="solid")]
    used: dict[Colour, int] = {}
    for mode in visible_modes:
        value = mode.eigenvalue
        both = [value, value.conjugate()] if mode.oscillates else [value]
        own = next((c for part, c in _OF_PART.items() if mode.name.startswith(part)), None)
        free = min(_OTHERS, key=lambda other: used.get(other, 0))
        colour: Colour = own if own is not None and own not in used else free
        used[colour] = used.get(colour, 0) + 1
        # A disc or a ring where the colour is its own; another shape where it comes again.
        disc: Marker = "stable" if mode.verdict == "stable" else "unstable"
        marker = disc if used[colour] == 1 else _MARKERS[(used[colour] - 1) % len(_MARKERS)]
        marks.append(
            Points(
                [v.real for v in both], [v.imag for v in both], mode.name, marker, colour, size=9.0
            )
        )
    top = max([abs(m.eigenvalue.imag) for m in visible_modes], default=0.0)
    reals = [m.eigenvalue.real for m in visible_modes]
    width = max(0.0, *reals) - min(0.0, *reals) or 1.0
    x = Axis("Re λ", "1/s", (min(0.0, *reals) - 0.08 * width, max(0.0, *reals) + 0.08 * width))
    y = Axis("Im λ", "rad/s", (-1.15 * top, 1.15 * top) if top > linear.STILL else (-1.0, 1.0))
    return Chart(name, [Panel(x, y, marks)], caption, 1, 6.4, 4.4)


def _damping_lines(left: float, top: float) -> list[Mark]:
    """Lines of equal damping ratio in the left half plane."""
    marks: list[Mark] = []
    for ratio in _DAMPING:
        angle = math.acos(ratio)
        reach = min(-left / math.cos(angle), top / math.sin(angle)) if left < 0 else 0.0
        if reach <= 0:
            continue
        x, y = -reach * math.cos(angle), reach * math.sin(angle)
        marks.append(
            Curve([x, 0.0, x], [y, 0.0, -y], "ζ = 0.1, 0.3, 0.6", "pale", "dotted", width=1.0)
        )
    return marks
