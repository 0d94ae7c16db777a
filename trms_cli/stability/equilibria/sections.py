"""The sections of a report on equilibria: what each curve holds, and the special points."""

import math
from collections.abc import Callable, Sequence

from trms_cli.core import chart as draw
from trms_cli.core.findings import Column, Datum, Section, Table, Value, table
from trms_cli.core.wording import symbol, with_unit
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.equilibria.charts import MARKS, curves_chart, shown_signals
from trms_cli.stability.equilibria.result import EquilibriaResult
from trms_cli.stability.equilibria.summary import (
    outcome_names,
    sentence,
    stability_cell,
    symbol_list,
    value_text,
)
from trms_cli.stability.equilibria.survey import NamedPoint, Survey
from trms_cli.stability.local.sweep import unit_of

_QUANTITIES = {
    "thrust_main": "thrust of the main rotor [N]",
    "thrust_tail": "thrust of the tail rotor [N]",
    "current_main": "current of the main motor [A]",
    "current_tail": "current of the tail motor [A]",
    "drag_torque_main": "drag torque of the main rotor [N m]",
    "drag_torque_tail": "drag torque of the tail rotor [N m]",
    "gravity_moment": "moment of gravity on pitch [N m]",
    "inertia_pitch": "inertia of pitch [kg m²]",
    "inertia_yaw": "inertia of yaw [kg m²]",
}
#: Axis or rotor that a quantity belongs to, by a part of its name.
_PARTS = {"main": "main", "tail": "tail", "gravity": "pitch", "pitch": "pitch", "yaw": "yaw"}


def survey_section(one: Survey, named: Sequence[NamedPoint]) -> Section:
    """The box searched, where curves run, and the equilibria over one input."""
    bounds = [
        f"{symbol(signal.name)} "
        + (
            f"{low:.4g} to {high:.4g} {signal.unit}"
            if math.isfinite(low) and math.isfinite(high)
            else "without bounds"
        )
        for signal, low, high in zip(
            one.system.unknowns, one.box.lower.tolist(), one.box.upper.tolist(), strict=True
        )
    ]
    over, structure = symbol(one.setting.over), []
    if one.system.free:
        free = f"{symbol_list(one.system.free)} is determined by nothing"
        structure.append(sentence(f"{free}: any value rests; zero is taken"))
    if one.system.released and not one.setting.held_angles:
        requirement = (
            f"Rest asks for one value of {symbol_list(one.system.released)} at each {over}"
        )
        structure.append(f"{requirement}: it is solved for.")
    text = [
        f"The box: {', '.join(bounds)}; all other states follow from these. An angle beyond its "
        "stop is reached by no rig.",
        *structure,
        *(
            f"A curve runs from {a} to {b}."
            for a, b in dict.fromkeys(c.curve.ends for c in one.curves)
        ),
    ]
    signal_names = shown_signals(one)
    charts = [curves_chart(one, signal_names, named)] if one.curves and signal_names else []
    return Section(f"Over {over}", text, [*charts, _point_table(one, signal_names)])


def special_section(result: EquilibriaResult) -> Section:
    """Named equilibria, landmarks of the curves, and physical quantities."""
    model, named = result.model, result.named_points
    blocks: list[Table | draw.Chart] = []
    if named:
        values = _value_columns(model, [*names(model.inputs), *outcome_names(model)])
        columns = [Column("", "name"), *values, Column("stability", stability_cell)]
        blocks.append(table(named, columns, "Equilibria with a name."))
    blocks += [one for one in (_landmark_table(result), _quantity_table(result)) if one]
    return Section("Special points", (), blocks)


def _point_table(survey: Survey, signal_names: Sequence[str]) -> Table:
    """Equilibria at the inputs of the proofs."""
    model, over = survey.model, survey.setting.over
    columns = _value_columns(model, signal_names)
    rows: list[list[Value | Datum]] = []
    for check in survey.checks:
        complete = check.proof.complete
        proof = Datum("proved", "good") if complete else Datum("undecided", "doubtful")
        if not check.agree:
            proof = Datum("curves differ", "bad")
        at = _rounded(check.input)
        values = table(check.points, columns).rows
        if not check.points:
            rows.append([at, *[None] * len(signal_names), "none in the box", None, proof])
        for point, cells in zip(check.points, values, strict=True):
            rightmost = _rounded(float(point.eigenvalues[0].real))
            rows.append([at, *cells, stability_cell(point), rightmost, proof])
    heads = [with_unit(symbol(over), unit_of(model, over)), *(c.head for c in columns)]
    return Table(
        [*heads, "stability", "rightmost [1/s]", "number"],
        rows,
        "All equilibria in the box at each input. `rightmost` is the largest real part of the "
        "eigenvalues; `number` tells whether it is proved that there are no others.",
        on_screen=False,
    )


def _landmark_table(result: EquilibriaResult) -> Table | None:
    """Folds, changes of stability and levels of all curves."""
    model = result.model
    rows = [
        [
            f"{symbol(one.name)} = 0" if one.kind == "level" else MARKS[one.kind][0],
            value_text(model, survey.setting.over, float(one.y[-1]), 7),
            *(
                None if name in survey.system.free else _rounded(one.at.value(model, name))
                for name in model.controlled
            ),
            None if one.frequency is None else _rounded(one.frequency),
        ]
        for survey in result.surveys
        for one in survey.landmarks
        if one.kind != "zero"
    ]
    if not rows:
        return None
    heads = [with_unit(symbol(name), unit_of(model, name)) for name in model.controlled]
    return Table(["", "where", *heads, "frequency [Hz]"], rows, "Special points of the curves.")


def _quantity_table(result: EquilibriaResult) -> Table | None:
    model, points = result.model, result.named_points
    locked = [part for part, whole in _PARTS.items() if whole not in (*model.axes, *model.rotors)]
    quantity_names = [
        name
        for name in _QUANTITIES
        if any(name in point.quantities for point in points)
        and not any(part in name for part in locked)
    ]
    if not quantity_names:
        return None
    rows: list[list[Value]] = [
        [_QUANTITIES[name], *(_rounded(point.quantities.get(name, math.nan)) for point in points)]
        for name in quantity_names
    ]
    return Table(["", *(point.name for point in points)], rows, "Physical quantities there.")


def _value_columns(model: Model, signal_names: Sequence[str]) -> list[Column]:
    """Columns of states and commands, of operating points."""

    def cell(name: str) -> Callable[[OperatingPoint], Value]:
        return lambda point: _rounded(point.value(model, name))

    return [
        Column(with_unit(symbol(name), unit_of(model, name)), cell(name)) for name in signal_names
    ]


def _rounded(value: float) -> float:
    """Five digits, for a cell; what is rounding is zero."""
    return 0.0 if abs(value) < 1e-9 else float(f"{value:.5g}")
