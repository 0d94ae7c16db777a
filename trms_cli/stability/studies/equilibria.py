"""``study=equilibria``: where the rig can rest, all of it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from trms_cli.core import chart as draw
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.findings import (
    Column,
    Datum,
    Findings,
    Measure,
    Section,
    Table,
    Value,
    json_data,
    table,
)
from trms_cli.core.plugins import require_known
from trms_cli.core.wording import symbol, with_unit
from trms_cli.core.wording import unit as written_unit
from trms_cli.models.model import Model, Signal, by_name, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.equilibria.proof import RangePiece
from trms_cli.stability.equilibria.rest_system import rest_system
from trms_cli.stability.equilibria.survey import (
    EquilibriumMap,
    EquilibriumPoint,
    FrictionBand,
    Kind,
    Landmark,
    NamedPoint,
    Survey,
    SurveySetting,
    equilibrium_map,
    named_points,
    setting_of,
    survey,
    usual_bounds,
)
from trms_cli.stability.local.sweep import unit_of
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
        warnings = _warnings(result, subject.left_out_of_equations())
        data = {
            "surveys": [_survey_data(one) for one in surveys],
            "named": [_named_data(model, point) for point in named],
        }
        sections = [_section(one, named) for one in surveys]
        chart = None if stable_map is None else _map_chart(result, stable_map)
        if chart is not None and chart.panels:
            text = (
                "Each point is the stable equilibrium that a step of the command leads to from its "
                "neighbour; it is searched for, not proved to be the only one."
            )
            sections.append(Section("Over both inputs", [text], [chart]))
        sections.append(_special_section(result))
        notes = [*missing, *warnings, *held_outside]
        lead, measures = _lead(result), _measures(result)
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


#: Landmarks that the answer names.
_FIRST = ("fold", "kink", "oscillation", "exchange", "crossing")
_MOST_PIECES = 7
#: Every so many points of a curve are asked whether they lie on a switch.
_SWITCH_STRIDE = 5
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


@dataclass(frozen=True)
class EquilibriaResult:
    """All equilibria of a model."""

    model: Model
    surveys: Sequence[Survey]
    named_points: Sequence[NamedPoint]


def _survey_data(survey: Survey) -> dict[str, Any]:
    model = survey.model
    return {
        "over": survey.setting.over,
        "range": survey.setting.bounds,
        "inputs": survey.setting.inputs,
        "held": survey.setting.held_angles,
        "released": survey.system.released,
        "free": survey.system.free,
        "box": _columns(survey.system.unknowns, survey.box.lower, survey.box.upper),
        "curves": [
            {
                "states": _columns(model.states, *(p.x for p in one.points)),
                "inputs": _columns(model.inputs, *(p.u for p in one.points)),
                "growing": [p.unstable for p in one.points],
                "verdict": [p.verdict for p in one.points],
                "rightmost": [float(p.eigenvalues[0].real) for p in one.points],
                "ends": one.curve.ends,
            }
            for one in survey.curves
        ],
        "landmarks": [
            {
                "kind": one.kind,
                "angle": one.name or None,
                "input": float(one.y[-1]),
                "frequency": one.frequency,
                "growing": one.at.unstable,
                **_states(model, one.at),
            }
            for one in survey.landmarks
        ],
        "proofs": [
            {
                "input": check.input,
                "complete": check.proof.complete,
                "count": check.proof.count,
                "agrees_with_curves": check.agree,
                "equilibria": [
                    {
                        "unique": one.unique,
                        "exists": one.exists,
                        "states": _columns(model.states, one.x.lower, one.x.upper),
                        "inputs": _columns(model.inputs, one.u.lower, one.u.upper),
                    }
                    for one in check.proof.enclosed
                ],
            }
            for check in survey.checks
        ],
        "range_proof": survey.pieces,
        "range_proved": _proved_share(survey.pieces),
    }


def _named_data(model: Model, point: NamedPoint) -> dict[str, Any]:
    return {
        "name": point.name,
        **_states(model, point),
        "eigenvalues": point.eigenvalues,
        "growing": point.unstable,
        "verdict": point.verdict,
        "quantities": point.quantities,
        "friction": [
            {name: value for name, value in vars(band).items() if name != "angle"}
            for band in point.bands
        ],
    }


def _states(model: Model, at: OperatingPoint) -> dict[str, Any]:
    return {"states": by_name(model.states, at.x), "inputs": by_name(model.inputs, at.u)}


def _columns(signals: Sequence[Signal], *rows: FloatArray) -> dict[str, Any]:
    """The numbers of each signal, by its name."""
    return dict(zip(names(signals), np.array(rows).reshape(-1, len(signals)).T, strict=True))


def _proved_share(pieces: Sequence[RangePiece]) -> float | None:
    """Share of a range in which the number is proved."""
    if not pieces:
        return None
    whole = pieces[-1].upper - pieces[0].lower
    return sum(piece.upper - piece.lower for piece in pieces if piece.count is not None) / whole


def _number(value: float, digits: int = 4) -> str:
    """A few digits; what is rounding is zero."""
    return f"{0.0 if abs(value) < 1e-9 else value:.{digits}g}"


def _with_unit(value: float, unit: str, digits: int = 4) -> str:
    return f"{_number(value, digits)} {unit}".removesuffix(" 1").rstrip()


def _rounded(value: float) -> float:
    """Five digits, for a cell; what is rounding is zero."""
    return 0.0 if abs(value) < 1e-9 else float(f"{value:.5g}")


def _value_text(model: Model, name: str, value: float, digits: int = 4) -> str:
    """``α_v = 0.1 rad``."""
    return f"{symbol(name)} = {_with_unit(value, unit_of(model, name), digits)}"


def _value_columns(model: Model, signal_names: Sequence[str]) -> list[Column]:
    """Columns of states and commands, of operating points."""

    def cell(name: str) -> Callable[[OperatingPoint], Value]:
        return lambda point: _rounded(point.value(model, name))

    return [
        Column(with_unit(symbol(name), unit_of(model, name)), cell(name)) for name in signal_names
    ]


def _outcomes(model: Model) -> list[str]:
    """What commands come to: controlled angles and rotors' speeds."""
    speeds = (name for name in model.state_names if name.startswith("omega"))
    return list(dict.fromkeys([*model.controlled, *speeds]))


def _symbols(signals: Sequence[str]) -> str:
    return ", ".join(symbol(name) for name in signals)


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:] + "."


def _measures(result: EquilibriaResult) -> list[Measure]:
    """Where the first axis rests at each named point, and the commands at which equilibria end."""
    model, measures = result.model, []
    for axis in list(model.controlled)[:1]:
        unit = unit_of(model, axis)
        for point in result.named_points:
            stability = _stability(point)
            note, judgement = str(stability.value), stability.judgement
            label = f"{point.name}: {symbol(axis)}"
            value = round(point.value(model, axis), 9) + 0.0  # what is solved to zero is zero
            measures.append(Measure(label, value, unit, judgement, note))
    for one in result.surveys:
        over = one.setting.over
        measures += [
            Measure(f"fold over {symbol(over)}", float(mark.y[-1]), unit_of(model, over))
            for mark in one.landmarks
            if mark.kind == "fold"
        ]
    return measures


def _lead(result: EquilibriaResult) -> list[str]:
    model, lead = result.model, []
    for point in result.named_points:
        commands, states = (
            ", ".join(_value_text(model, name, point.value(model, name)) for name in group)
            for group in (names(model.inputs), _outcomes(model))
        )
        stability = _stability(point).value
        lead.append(f"{point.name.capitalize()}: {commands}: {states} ({stability}).")
    for one in result.surveys:
        marks = [_landmark_words(one, mark) for mark in one.landmarks if mark.kind in _FIRST]
        lead += [_sentence(words) for words in dict.fromkeys(marks)]
        lead.append(_proof_words(one))
    for point in result.named_points:
        lead += [_sentence(f"{point.name}: {band_words(model, band)}") for band in point.bands]
    return lead


def _landmark_words(survey: Survey, one: Landmark) -> str:
    model = survey.model
    at = _value_text(model, survey.setting.over, float(one.y[-1]), 6)
    angles = [name for name in model.controlled if name not in survey.system.free]
    place = ", ".join(_value_text(model, name, one.at.value(model, name)) for name in angles)
    frequency = _number(one.frequency or 0.0, 3)
    what = {
        "fold": "two equilibria meet and end in a fold at",
        "kink": "two equilibria meet and end at a kink near",
        "oscillation": f"an oscillation of {frequency} Hz begins or ends to grow at",
        "exchange": "stability changes at",
    }.get(one.kind, "another curve may cross at")
    return f"{what} {at}, {place}"


def _proof_words(survey: Survey) -> str:
    over, checks = survey.setting.over, survey.checks
    unit = unit_of(survey.model, over)
    complete = sum(check.proof.complete for check in checks)
    low, high = survey.setting.bounds
    words = (
        f"Proved by intervals at {complete} of {len(checks)} values of {symbol(over)} from "
        f"{_number(low)} to {_with_unit(high, unit)}: the number of equilibria in the box"
    )
    words += ", each of them on a curve." if all(check.agree for check in checks) else "."
    share = _proved_share(survey.pieces)
    if share is not None:
        # Never rounded up to all.
        part = "all" if share == 1.0 else f"{math.floor(share * 1e4) / 100:g} %"
        pieces = "; ".join(_piece_words(survey.pieces, unit))
        words += f" Between them too, for {part} of the range: {pieces}."
    return words


def _piece_words(pieces: Sequence[RangePiece], unit: str) -> list[str]:
    """Ranges with one number; a sliver left untold between two of the same number divides none.

    Ends are rounded inwards, so that nothing is said of what is not proved.
    """
    joined: list[RangePiece] = []
    most = 2e-3 * (pieces[-1].upper - pieces[0].lower)
    for piece in (p for p in pieces if p.count is not None):
        near = bool(joined) and piece.lower - joined[-1].upper <= most
        if near and joined[-1].count == piece.count:
            joined[-1] = RangePiece(joined[-1].lower, piece.upper, piece.count)
        else:
            joined.append(piece)
    words = [
        f"{p.count or 'none'} from {math.ceil(p.lower * 1e4) / 1e4} to "
        f"{_with_unit(math.floor(p.upper * 1e4) / 1e4, unit, 6)}"
        for p in joined
    ]
    return words if len(words) <= _MOST_PIECES else [*words[:_MOST_PIECES], "…"]


def band_words(model: Model, band: FrictionBand) -> str:
    """What friction holds."""
    text = f"dry friction of {_number(band.torque)} N m holds {symbol(band.angle)} anywhere"
    if band.lower is not None and band.upper is not None:
        return f"{text} from {_number(band.lower)} to {_number(band.upper)} rad"
    if band.command is not None:
        name, low, high = band.command
        top = _with_unit(high, unit_of(model, name))
        return f"{text}, for {symbol(name)} from {_number(low)} to {top}"
    return text


def _section(one: Survey, named: Sequence[NamedPoint]) -> Section:
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
        free = f"{_symbols(one.system.free)} is determined by nothing"
        structure.append(_sentence(f"{free}: any value rests; zero is taken"))
    if one.system.released and not one.setting.held_angles:
        requirement = f"Rest asks for one value of {_symbols(one.system.released)} at each {over}"
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
    signal_names = _shown_signals(one)
    charts = [_curves_chart(one, signal_names, named)] if one.curves and signal_names else []
    return Section(f"Over {over}", text, [*charts, _point_table(one, signal_names)])


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
            rows.append([at, *cells, _stability(point), rightmost, proof])
    heads = [with_unit(symbol(over), unit_of(model, over)), *(c.head for c in columns)]
    return Table(
        [*heads, "stability", "rightmost [1/s]", "number"],
        rows,
        "All equilibria in the box at each input. `rightmost` is the largest real part of the "
        "eigenvalues; `number` tells whether it is proved that there are no others.",
        on_screen=False,
    )


def _stability(point: EquilibriumPoint) -> Datum:
    if point.unstable:
        return Datum(f"{point.unstable} growing", "bad")
    if point.verdict == "unstable":
        return Datum("grows with t", "bad")
    return Datum(point.verdict, "good" if point.verdict == "stable" else "doubtful")


def _special_section(result: EquilibriaResult) -> Section:
    model, named = result.model, result.named_points
    blocks: list[Table | draw.Chart] = []
    if named:
        values = _value_columns(model, [*names(model.inputs), *_outcomes(model)])
        columns = [Column("", "name"), *values, Column("stability", _stability)]
        blocks.append(table(named, columns, "Equilibria with a name."))
    blocks += [one for one in (_landmark_table(result), _quantity_table(result)) if one]
    return Section("Special points", (), blocks)


def _landmark_table(result: EquilibriaResult) -> Table | None:
    """Folds, changes of stability and levels of all curves."""
    model = result.model
    rows = [
        [
            f"{symbol(one.name)} = 0" if one.kind == "level" else MARKS[one.kind][0],
            _value_text(model, survey.setting.over, float(one.y[-1]), 7),
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


def _warnings(result: EquilibriaResult, left_out: Sequence[str]) -> list[str]:
    words = []
    for one in result.surveys:
        over = symbol(one.setting.over)
        differ = [f"{check.input:.4g}" for check in one.checks if not check.agree]
        if differ:
            words.append(
                f"over {over} the curves and the proof DISAGREE at {', '.join(differ)}: neither is "
                "to be trusted there"
            )
        if one.late:
            words.append(
                f"over {over} {one.late} curves were found by the proof and not by the search"
            )
        if any(check.proof.open_ended for check in one.checks):
            words.append(f"over {over} equilibria with a state beyond 1e6 are not excluded")
        words += [*_switch_words(one), *_undecided_words(one)]
        ends = [end for curve in one.curves for end in curve.curve.ends if end.startswith("where")]
        words += [f"a curve over {over} ends {end}" for end in ends]
    rotor = [name for name in left_out if "friction" in name and "rotor" in name]
    if rotor:
        words.append(
            f"{', '.join(rotor)} acts as impulses and is no part of these equilibria: a turning "
            "rotor rests at a lower speed with it"
        )
    return words


def _switch_words(survey: Survey) -> list[str]:
    """That a curve lies on a switch, and which slopes then count."""
    names = survey.model.state_names
    for one in survey.curves:
        on_curve = zip(one.points, one.curve.y, strict=True)
        for point, y in list(on_curve)[::_SWITCH_STRIDE]:
            switches = survey.system.linear.switches(point.x, survey.equations.point(y)[2])
            places = [f"{symbol(names[s.state])} = {_number(point.x[s.state])}" for s in switches]
            if places:
                return [
                    f"over {symbol(survey.setting.over)} equilibria lie on a switch "
                    f"({', '.join(places)}), on whose sides the slopes differ: stability is told "
                    "for the mean of both, which small swings across it see; either side: "
                    "study=local"
                ]
    return []


def _undecided_words(survey: Survey) -> list[str]:
    words = []
    for check in survey.checks:
        proof = check.proof
        if proof.complete:
            continue
        places = "; ".join(
            ", ".join(
                f"{symbol(signal.name)} {_number(float(one.z.lower[k]))} to "
                f"{_with_unit(float(one.z.upper[k]), signal.unit)}"
                for k, signal in enumerate(survey.system.unknowns)
            )
            + (" (at least one is there)" if one.exists else "")
            for one in proof.undecided[:2]
        )
        more = len(proof.undecided) - 2
        words.append(
            f"at {_value_text(survey.model, survey.setting.over, check.input)} the number is "
            f"not proved: {len(proof.proved)} found, undecided: {places}"
            + (f" and {more} places more" if more > 0 else "")
            + f"; the curves have {len(check.points) or 'none'} there"
        )
    return words


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


def _along(survey: Survey, name: str) -> FloatArray:
    """A state or command along all curves."""
    values = [one.values(survey.model, name) for one in survey.curves]
    return np.concatenate(values or [np.zeros(1)])


def _shown_signals(survey: Survey) -> list[str]:
    """What is drawn over an input: angles that change with it, speeds, released inputs."""
    candidates = dict.fromkeys([*_outcomes(survey.model), *survey.system.released])
    return [name for name in candidates if np.ptp(_along(survey, name)) > _VARIES]


def _axis(model: Model, name: str, limits: tuple[float, float] | None = None) -> draw.Axis:
    return draw.Axis(symbol(name), written_unit(unit_of(model, name)), limits)


def _curves_chart(
    survey: Survey, signal_names: Sequence[str], named: Sequence[NamedPoint]
) -> draw.Chart:
    model, over = survey.model, survey.setting.over
    conditions = [
        f"{symbol(name)} = {value:g}" for name, value in survey.setting.fixed_values.items()
    ]
    if survey.system.released:
        conditions.append(f"{_symbols(survey.system.released)} as rest asks for")
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


def _map_chart(result: EquilibriaResult, over_both: EquilibriumMap) -> draw.Chart:
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
