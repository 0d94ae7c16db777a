"""The figures of the study of equilibria."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core.arrays import FloatArray
from trms_cli.core.wording import symbol
from trms_cli.core.wording import unit as written_unit
from trms_cli.models.model import Model, Signal
from trms_cli.stability.equilibria.landmarks import Kind
from trms_cli.stability.equilibria.named_points import NamedPoint
from trms_cli.stability.equilibria.survey import EquilibriumMap, Survey, SurveyCurve

#: Name, marker and colour of what is special on a curve.
MARKS: dict[Kind, tuple[str, draw.Marker, draw.Colour]] = {
    "fold": ("fold", "star", "ink"),
    "kink": ("fold at a kink", "star", "grey"),
    "oscillation": ("oscillation begins", "triangle", "purple"),
    "exchange": ("stability changes", "square", "purple"),
    "crossing": ("curves cross", "cross", "ink"),
}
_VARIES = 1e-6
#: Where a name stands beside its point, as shares of the panel: to the right, beneath, above.
_ASIDE, _BELOW, _ABOVE = 0.025, 0.065, 0.03


def shown_signals(model: Model, survey: Survey) -> list[Signal]:
    """What is drawn over an input: angles that change with it, speeds, released inputs."""
    every = [*model.states, *model.inputs]
    wanted = [*model.controlled, *(s.name for s in model.states if s.name.startswith("omega"))]
    wanted += [*survey.system.released]
    shown: list[Signal] = []
    for name in dict.fromkeys(wanted):
        signal = next(s for s in every if s.name == name)
        values = np.concatenate(
            [values_of(model, one, name) for one in survey.curves] or [np.zeros(1)]
        )
        if np.ptp(values) > _VARIES:
            shown.append(signal)
    return shown


def values_of(model: Model, curve: SurveyCurve, name: str) -> FloatArray:
    """A state or command along a curve."""
    return np.array([point.value(model, name) for point in curve.points])


def curves_chart(model: Model, survey: Survey, named: Sequence[NamedPoint]) -> draw.Chart:
    """Equilibria over one input."""
    over = survey.setting.over
    unit = next(s.unit for s in model.inputs if s.name == over)
    panels = [
        draw.Panel(
            draw.Axis(symbol(over), written_unit(unit), survey.setting.bounds),
            draw.Axis(symbol(signal.name), written_unit(signal.unit)),
            _marks(model, survey, signal, written_unit(unit), named, legend=k == 0),
        )
        for k, signal in enumerate(shown_signals(model, survey))
    ]
    return draw.Chart(
        f"equilibria_{over}",
        panels,
        f"All equilibria of {model.name} over {symbol(over)}{_condition(survey)}: "
        "solid where small motions die out, dashed where they grow; dots are proved, and proved to "
        "be all.",
        columns=2 if len(panels) != 3 else 3,
    )


def _condition(survey: Survey) -> str:
    given = [
        f"{symbol(n)} = {v:g}" for n, v in {**survey.setting.inputs, **survey.setting.held}.items()
    ]
    if survey.system.released:
        given.append(f"{', '.join(symbol(n) for n in survey.system.released)} as rest asks for")
    return f" ({', '.join(given)})" if given else ""


def _marks(
    model: Model,
    survey: Survey,
    signal: Signal,
    unit: str,
    named: Sequence[NamedPoint],
    legend: bool,
) -> list[draw.Points | draw.Curve | draw.Line | draw.Note]:
    name = signal.name
    marks: list[draw.Points | draw.Curve | draw.Line | draw.Note] = []
    reached = np.concatenate(
        [values_of(model, one, name) for one in survey.curves] or [np.zeros(1)]
    )
    stop = model.stops.get(name, math.inf)
    if math.isfinite(stop):
        marks += [
            draw.Line(y=side * stop, label="stop" if legend else "")
            for side in (-1, 1)
            if np.any(side * reached >= 0.8 * stop)
        ]
    over = survey.setting.over
    for one in survey.curves:
        u, y = values_of(model, one, over), values_of(model, one, name)
        growing = np.array([point.verdict == "unstable" for point in one.points])
        # What neither grows nor dies out (a free yaw) is the same all along a curve.
        idle = all(point.verdict == "marginal" for point in one.points if point.unstable == 0)
        for mask, label, colour, style in (
            (~growing, "marginal" if idle else "stable", "blue", "solid"),
            (growing, "unstable", "vermilion", "dashed"),
        ):
            # One point beyond, so that the parts touch.
            wide = mask | np.r_[mask[1:], False] if label == "unstable" else mask
            if wide.any():
                marks.append(
                    draw.Curve(
                        u,
                        np.where(wide, y, np.nan),
                        label if legend else "",
                        colour,  # type: ignore[arg-type]
                        style,  # type: ignore[arg-type]
                        1.8,
                    )
                )
    proved = [
        (check.input, point.value(model, name))
        for check in survey.checks
        if check.agree and check.proof.complete
        for point in check.points
    ]
    if proved:
        at, where = [u for u, _ in proved], [y for _, y in proved]
        marks.append(draw.Points(at, where, "proved" if legend else "", "dot", "ink", size=2.5))
    for kind, (label, marker, colour) in MARKS.items():
        special = [one for one in survey.landmarks if one.kind == kind]
        if special:
            at = [float(one.y[-1]) for one in special]
            where = [one.at.value(model, name) for one in special]
            labels = [f"{value:.4g} {unit}" for value in at] if legend and marker == "star" else ()
            marks.append(
                draw.Points(at, where, label if legend else "", marker, colour, labels, 7.0)
            )
    here = [point for point in named if _belongs(model, survey, point)]
    if here:
        at = [point.value(model, over) for point in here]
        where = [point.value(model, name) for point in here]
        marks.append(draw.Points(at, where, "", "square", "green", size=6.0))
        low, high = survey.setting.bounds
        aside, tall = _ASIDE * (high - low), float(np.ptp(reached)) or 1.0
        for point, place, height in zip(here, at, where, strict=True):
            # On the side that the curve does not turn to.
            away = -_BELOW if _rises(model, survey, name, place, height, tall) else _ABOVE
            marks.append(draw.Note(place + aside, height + away * tall, point.name))
    return marks


def _rises(model: Model, survey: Survey, name: str, u: float, y: float, tall: float) -> bool:
    """Whether the curve next to a place rises with the input."""
    over = survey.setting.over
    low, high = survey.setting.bounds
    best, rising = math.inf, True
    for one in survey.curves:
        if len(one.points) < 2:
            continue
        inputs, values = values_of(model, one, over), values_of(model, one, name)
        away = np.hypot((inputs - u) / (high - low), (values - y) / tall)
        k = int(np.argmin(away))
        before, after = max(k - 1, 0), min(k + 1, len(values) - 1)
        if away[k] < best:
            turn = (inputs[after] - inputs[before]) * (values[after] - values[before])
            best, rising = float(away[k]), bool(turn >= 0.0)
    return rising


def _belongs(model: Model, survey: Survey, point: NamedPoint) -> bool:
    """Whether a named point lies under the conditions of a survey."""
    given = {**survey.setting.inputs, **survey.setting.held}
    return all(abs(point.value(model, name) - value) < 1e-6 for name, value in given.items())


def map_chart(model: Model, over_both: EquilibriumMap, first: str, second: str) -> draw.Chart:
    """Where the rig rests over both inputs."""
    units = {signal.name: signal.unit for signal in model.inputs}
    panels = []
    for name, values in over_both.angles.items():
        finite = values[np.isfinite(values)]
        if not finite.size or np.ptp(finite) < _VARIES:
            continue
        levels = _levels(float(finite.min()), float(finite.max()))
        panels.append(
            draw.Panel(
                draw.Axis(symbol(first), written_unit(units[first])),
                draw.Axis(symbol(second), written_unit(units[second])),
                [
                    draw.Region(
                        over_both.first, over_both.second, np.isfinite(values), "stable rest"
                    ),
                    draw.Contour(over_both.first, over_both.second, values, levels, numbers=True),
                ],
                f"{symbol(name)} [rad]",
            )
        )
    return draw.Chart(
        "equilibria_map",
        panels,
        f"Angles at which {model.name} rests over both inputs, where a stable equilibrium lies "
        "in the box.",
    )


def _levels(low: float, high: float) -> list[float]:
    steps = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
    step = next(size for size in steps if (high - low) / size <= 12)
    first, last = math.ceil(low / step), math.floor(high / step)
    return [round(k * step, 9) for k in range(first, last + 1)]
