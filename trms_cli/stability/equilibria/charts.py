"""Figures of equilibria: the curves over one input, and the map over both."""

import math
from collections.abc import Sequence

import numpy as np

from trms_cli.core import chart as draw
from trms_cli.core.arrays import FloatArray
from trms_cli.core.wording import symbol
from trms_cli.core.wording import unit as written_unit
from trms_cli.models.model import Model
from trms_cli.stability.equilibria.result import EquilibriaResult
from trms_cli.stability.equilibria.summary import outcome_names, symbol_list
from trms_cli.stability.equilibria.survey import EquilibriumMap, Kind, NamedPoint, Survey
from trms_cli.stability.local.sweep import unit_of

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


def shown_signals(survey: Survey) -> list[str]:
    """What is drawn over an input: angles that change with it, speeds, released inputs."""
    candidates = dict.fromkeys([*outcome_names(survey.model), *survey.system.released])
    return [name for name in candidates if np.ptp(_along(survey, name)) > _VARIES]


def curves_chart(
    survey: Survey, signal_names: Sequence[str], named: Sequence[NamedPoint]
) -> draw.Chart:
    """Each signal over the input, a panel for each."""
    model, over = survey.model, survey.setting.over
    conditions = [
        f"{symbol(name)} = {value:g}" for name, value in survey.setting.fixed_values.items()
    ]
    if survey.system.released:
        conditions.append(f"{symbol_list(survey.system.released)} as rest asks for")
    condition = f" ({', '.join(conditions)})" if conditions else ""
    across = _axis(model, over, survey.setting.bounds)
    panels = [
        draw.Panel(across, _axis(model, name), _marks(survey, name, named, legend=k == 0))
        for k, name in enumerate(signal_names)
    ]
    caption = (
        f"All equilibria of {model.name} over {symbol(over)}{condition}: "
        "solid where small motions die out, dashed where they grow; dots are proved, and proved to "
        "be all."
    )
    return draw.Chart(f"equilibria_{over}", panels, caption, columns=2 if len(panels) != 3 else 3)


def map_chart(result: EquilibriaResult, over_both: EquilibriumMap) -> draw.Chart:
    """Lines of equal angle over both inputs; an angle that does not change has no panel."""
    first, second = (_axis(result.model, one.setting.over) for one in result.surveys)
    steps = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
    panels = []
    for name, values in over_both.angles.items():
        finite = values[np.isfinite(values)]
        if not finite.size or np.ptp(finite) < _VARIES:
            continue
        low, high = float(finite.min()), float(finite.max())
        step = next(size for size in steps if (high - low) / size <= 12)
        levels = [
            round(k * step, 9) for k in range(math.ceil(low / step), math.floor(high / step) + 1)
        ]
        grid = over_both.first, over_both.second
        region = draw.Region(*grid, np.isfinite(values), "stable rest")
        lines = draw.Contour(*grid, values, levels, numbers=True)
        panels.append(draw.Panel(first, second, [region, lines], f"{symbol(name)} [rad]"))
    return draw.Chart(
        "equilibria_map",
        panels,
        f"Angles at which {result.model.name} rests over both inputs, where a stable equilibrium "
        "lies in the box.",
    )


def _marks(survey: Survey, name: str, named: Sequence[NamedPoint], legend: bool) -> list[draw.Mark]:
    model, over = survey.model, survey.setting.over
    marks: list[draw.Mark] = []
    reached = _along(survey, name)
    stop = model.stops.get(name, math.inf)
    if math.isfinite(stop):
        marks += [
            draw.Line(y=side * stop, label="stop" if legend else "")
            for side in (-1, 1)
            if np.any(side * reached >= 0.8 * stop)
        ]
    for one in survey.curves:
        u, y = one.values(model, over), one.values(model, name)
        growing = np.array([point.verdict == "unstable" for point in one.points])
        # What neither grows nor dies out (a free yaw) is the same all along a curve.
        idle = all(point.verdict == "marginal" for point in one.points if point.unstable == 0)
        # One point beyond, so that the parts touch.
        wide = growing | np.r_[growing[1:], False]
        calm, unstable = ("marginal" if idle else "stable", "unstable") if legend else ("", "")
        if not growing.all():
            marks.append(draw.Curve(u, np.where(growing, np.nan, y), calm, "blue", "solid", 1.8))
        if wide.any():
            still = np.where(wide, y, np.nan)
            marks.append(draw.Curve(u, still, unstable, "vermilion", "dashed", 1.8))
    proved = [
        (check.input, point.value(model, name))
        for check in survey.checks
        if check.agree and check.proof.complete
        for point in check.points
    ]
    if proved:
        at, where = [u for u, _ in proved], [y for _, y in proved]
        marks.append(draw.Points(at, where, "proved" if legend else "", "dot", "ink", size=2.5))
    unit = written_unit(unit_of(model, over))
    for kind, (label, marker, colour) in MARKS.items():
        special = [one for one in survey.landmarks if one.kind == kind]
        if special:
            at = [float(one.y[-1]) for one in special]
            where = [one.at.value(model, name) for one in special]
            labels = [f"{value:.4g} {unit}" for value in at] if legend and marker == "star" else ()
            marks.append(
                draw.Points(at, where, label if legend else "", marker, colour, labels, 7.0)
            )
    conditions = survey.setting.fixed_values.items()
    here = [
        point
        for point in named
        if all(abs(point.value(model, other) - value) < 1e-6 for other, value in conditions)
    ]
    if here:
        at = [point.value(model, over) for point in here]
        where = [point.value(model, name) for point in here]
        marks.append(draw.Points(at, where, "", "square", "green", size=6.0))
        low, high = survey.setting.bounds
        aside, tall = _ASIDE * (high - low), float(np.ptp(reached)) or 1.0
        for point, place, height in zip(here, at, where, strict=True):
            # On the side that the curve does not turn to.
            away = -_BELOW if _rises(survey, name, place, height, tall) else _ABOVE
            marks.append(draw.Note(place + aside, height + away * tall, point.name))
    return marks


def _rises(survey: Survey, name: str, u: float, y: float, tall: float) -> bool:
    """Whether the curve next to a place rises with the input."""
    low, high = survey.setting.bounds
    best, rising = math.inf, True
    for one in survey.curves:
        if len(one.points) < 2:
            continue
        inputs = one.values(survey.model, survey.setting.over)
        values = one.values(survey.model, name)
        away = np.hypot((inputs - u) / (high - low), (values - y) / tall)
        k = int(np.argmin(away))
        before, after = max(k - 1, 0), min(k + 1, len(values) - 1)
        if away[k] < best:
            turn = (inputs[after] - inputs[before]) * (values[after] - values[before])
            best, rising = float(away[k]), bool(turn >= 0.0)
    return rising


def _along(survey: Survey, name: str) -> FloatArray:
    """A state or command along all curves."""
    values = [one.values(survey.model, name) for one in survey.curves]
    return np.concatenate(values or [np.zeros(1)])


def _axis(model: Model, name: str, limits: tuple[float, float] | None = None) -> draw.Axis:
    return draw.Axis(symbol(name), written_unit(unit_of(model, name)), limits)
