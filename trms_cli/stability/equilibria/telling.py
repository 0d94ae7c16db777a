"""The study of equilibria in words and tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from trms_cli.core.findings import Judged, Table, Value
from trms_cli.models.model import Model, Signal, names
from trms_cli.stability.equilibria.charts import symbol
from trms_cli.stability.equilibria.curves import EquilibriumPoint
from trms_cli.stability.equilibria.data import proved_share
from trms_cli.stability.equilibria.landmarks import Landmark, state_of
from trms_cli.stability.equilibria.named_points import Band, NamedPoint
from trms_cli.stability.equilibria.proof import Piece
from trms_cli.stability.equilibria.survey import Survey
from trms_cli.stability.local.linear import Linear

_MOST_PIECES = 7
#: Every so many points of a curve are asked whether they lie on a switch.
_SWITCH_STRIDE = 5


def number(value: float, digits: int = 4) -> str:
    """A few digits; what is rounding is zero."""
    return f"{0.0 if abs(value) < 1e-9 else value:.{digits}g}"


def with_unit(value: float, unit: str, digits: int = 4) -> str:
    return f"{number(value, digits)} {unit}" if unit not in ("", "1") else number(value, digits)


def unit_of(model: Model, name: str) -> str:
    """Of a state or an input."""
    return next(s.unit for s in (*model.states, *model.inputs) if s.name == name)


def proof_words(survey: Survey) -> str:
    """What is proved, in one or two sentences."""
    over, unit = survey.setting.over, unit_of(survey.system.model, survey.setting.over)
    checks = survey.checks
    complete = sum(check.proof.complete for check in checks)
    low, high = survey.setting.bounds
    words = (
        f"Proved by intervals at {complete} of {len(checks)} values of {symbol(over)} from "
        f"{number(low)} to {with_unit(high, unit)}: the number of equilibria in the box"
    )
    agree = all(check.agree for check in checks)
    words += ", each of them on a curve." if agree else "."
    share = proved_share(survey.pieces)
    if share is not None:
        words += (
            f" Between them too, for {_percent(share)} of the range: "
            f"{'; '.join(_pieces(survey.pieces, unit))}."
        )
    return words


def _percent(share: float) -> str:
    """Never rounded up to all."""
    return "all" if share == 1.0 else f"{math.floor(share * 1e4) / 100:g} %"


def _pieces(pieces: Sequence[Piece], unit: str) -> list[str]:
    """Ranges with one number; a sliver left untold between two of the same number divides none."""
    joined: list[Piece] = []
    most = 2e-3 * (pieces[-1].upper - pieces[0].lower)
    for piece in (p for p in pieces if p.count is not None):
        near = bool(joined) and piece.lower - joined[-1].upper <= most
        if near and joined[-1].count == piece.count:
            joined[-1] = Piece(joined[-1].lower, piece.upper, piece.count)
        else:
            joined.append(piece)
    words = [
        f"{p.count or 'none'} from {_inwards(p.lower, math.ceil)} to "
        f"{with_unit(_inwards(p.upper, math.floor), unit, 6)}"
        for p in joined
    ]
    return words if len(words) <= _MOST_PIECES else [*words[:_MOST_PIECES], "…"]


def _inwards(value: float, rounded: Callable[[float], int]) -> float:
    """To a ten-thousandth, so that nothing is said of what is not proved."""
    return rounded(value * 1e4) / 1e4


def undecided_words(survey: Survey) -> list[str]:
    """Where a proof could not decide."""
    over, unit = survey.setting.over, unit_of(survey.system.model, survey.setting.over)
    words = []
    for check in survey.checks:
        if check.proof.complete:
            continue
        places = "; ".join(
            ", ".join(
                f"{symbol(signal.name)} {number(float(one.z.lower[k]))} to "
                f"{with_unit(float(one.z.upper[k]), signal.unit)}"
                for k, signal in enumerate(survey.system.unknowns)
            )
            + (" (at least one is there)" if one.exists else "")
            for one in check.proof.undecided[:2]
        )
        more = len(check.proof.undecided) - 2
        words.append(
            f"at {symbol(over)} = {with_unit(check.input, unit)} the number is not proved: "
            f"{len(check.proof.proved)} found, undecided: {places}"
            + (f" and {more} places more" if more > 0 else "")
            + _degenerate(check.points)
        )
    return words


def _degenerate(points: Sequence[EquilibriumPoint]) -> str:
    return f"; the curves have {len(points)} there" if points else "; the curves have none there"


def landmark_words(survey: Survey, one: Landmark) -> str:
    """One special point, in words."""
    model = survey.system.model
    over = survey.setting.over
    place = f"{symbol(over)} = {with_unit(float(one.y[-1]), unit_of(model, over), 6)}"
    angles = ", ".join(
        f"{symbol(name)} = {with_unit(state_of(survey.equations, one, name), unit_of(model, name))}"
        for name in model.controlled
        if name not in survey.system.free
    )
    if one.kind == "fold":
        return f"two equilibria meet and end in a fold at {place}, {angles}"
    if one.kind == "kink":
        return f"two equilibria meet and end at a kink near {place}, {angles}"
    if one.kind == "oscillation":
        return (
            f"an oscillation of {number(one.frequency or 0.0, 3)} Hz begins or ends to grow at "
            f"{place}, {angles}"
        )
    if one.kind == "exchange":
        return f"stability changes at {place}, {angles}"
    return f"another curve may cross at {place}, {angles}"


def named_words(model: Model, point: NamedPoint) -> str:
    """A named point with the figures that matter."""
    commands = ", ".join(
        f"{symbol(s.name)} = {with_unit(v, s.unit)}"
        for s, v in zip(model.inputs, point.u.tolist(), strict=True)
    )
    shown = [*model.controlled, *(n for n in model.state_names if n.startswith("omega"))]
    values = {name: float(point.x[model.state_index(name)]) for name in shown}
    states = ", ".join(
        f"{symbol(name)} = {with_unit(value, unit_of(model, name))}"
        for name, value in values.items()
    )
    return f"{point.name.capitalize()}: {commands}: {states} ({_stability(point).value})"


def band_words(model: Model, band: Band) -> str:
    """What friction holds."""
    held = f"dry friction of {number(band.torque)} N m"
    if band.lower is not None and band.upper is not None:
        return (
            f"{held} holds {symbol(band.angle)} anywhere from {number(band.lower)} to "
            f"{number(band.upper)} rad"
        )
    if band.command is not None:
        name, low, high = band.command
        return (
            f"{held} holds {symbol(band.angle)} anywhere, for {symbol(name)} from {number(low)} to "
            f"{with_unit(high, unit_of(model, name))}"
        )
    return f"{held} holds {symbol(band.angle)} anywhere"


def point_table(model: Model, survey: Survey, shown: Sequence[Signal]) -> Table:
    """Equilibria at the inputs of the proofs."""
    over = survey.setting.over
    heads = [_head(over, unit_of(model, over)), *(_head(s.name, s.unit) for s in shown)]
    rows: list[list[Value | Judged]] = []
    for check in survey.checks:
        verdict = (
            Judged("proved", "good") if check.proof.complete else Judged("undecided", "doubtful")
        )
        if not check.agree:
            verdict = Judged("curves differ", "bad")
        if not check.points:
            blank: list[Value | Judged] = [None] * len(shown)
            rows.append([_round(check.input), *blank, "none in the box", None, verdict])
        for point in check.points:
            values = [_round(_value(model, point, s.name)) for s in shown]
            stable = _stability(point)
            rightmost = _round(float(point.eigenvalues[0].real))
            rows.append([_round(check.input), *values, stable, rightmost, verdict])
    return Table(
        [*heads, "stability", "rightmost [1/s]", "number"],
        rows,
        "All equilibria in the box at each input. `rightmost` is the largest real part of the "
        "eigenvalues; `number` tells whether it is proved that there are no others.",
        on_screen=False,
    )


def _stability(point: EquilibriumPoint | NamedPoint) -> Judged:
    """In a word or two."""
    if point.unstable:
        return Judged(f"{point.unstable} growing", "bad")
    if point.verdict == "unstable":
        return Judged("grows with t", "bad")
    return Judged(point.verdict, "good" if point.verdict == "stable" else "doubtful")


def switch_words(survey: Survey, linear: Linear) -> str | None:
    """That a curve lies on a switch, and which slopes then count; None where none does."""
    model = survey.system.model
    for one in survey.curves:
        for point, y in zip(
            one.points[::_SWITCH_STRIDE], one.curve.y[::_SWITCH_STRIDE], strict=True
        ):
            found = linear.switches(point.x, survey.equations.point(y)[2])
            if not found:
                continue
            places = ", ".join(
                f"{symbol(model.state_names[s.state])} = {number(float(point.x[s.state]))}"
                for s in found
            )
            return (
                f"over {symbol(survey.setting.over)} equilibria lie on a switch ({places}), on "
                "whose sides the slopes differ: stability is told for the mean of both, which "
                "small swings across it see; either side: study=local"
            )
    return None


def _value(model: Model, point: EquilibriumPoint, name: str) -> float:
    if name in model.state_names:
        return float(point.x[model.state_index(name)])
    return float(point.u[names(model.inputs).index(name)])


def _round(value: float) -> float:
    return 0.0 if abs(value) < 1e-9 else float(f"{value:.5g}")


def _head(name: str, unit: str) -> str:
    return f"{symbol(name)} [{unit}]" if unit not in ("", "1") else symbol(name)


def named_table(model: Model, points: Sequence[NamedPoint]) -> Table:
    """Rest, hover and other named points."""
    shown = [*names(model.inputs), *model.controlled]
    shown += [n for n in model.state_names if n.startswith("omega") and n not in shown]
    rows: list[list[Value | Judged]] = []
    for point in points:
        values = {**dict(zip(model.state_names, point.x.tolist(), strict=True))}
        values |= dict(zip(names(model.inputs), point.u.tolist(), strict=True))
        stable = _stability(point)
        rows.append([point.name, *(_round(values[name]) for name in shown), stable])
    return Table(
        ["", *(_head(name, unit_of(model, name)) for name in shown), "stability"],
        rows,
        "Equilibria with a name.",
    )


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


def quantity_table(model: Model, points: Sequence[NamedPoint]) -> Table | None:
    """Physical quantities at the named points."""
    locked = [part for part, whole in _PARTS.items() if whole not in (*model.axes, *model.rotors)]
    known = [
        name
        for name in _QUANTITIES
        if any(name in point.quantities for point in points)
        and not any(part in name for part in locked)
    ]
    if not known:
        return None
    rows: list[list[Value | Judged]] = [
        [_QUANTITIES[name], *(_round(point.quantities.get(name, math.nan)) for point in points)]
        for name in known
    ]
    return Table(["", *(point.name for point in points)], rows, "Physical quantities there.")


def landmark_table(model: Model, surveys: Sequence[Survey]) -> Table | None:
    """Folds, changes of stability and levels of all curves."""
    rows: list[list[Value | Judged]] = []
    for survey in surveys:
        over = survey.setting.over
        for one in survey.landmarks:
            if one.kind == "zero":
                continue
            angles = [
                None
                if name in survey.system.free
                else _round(state_of(survey.equations, one, name))
                for name in model.controlled
            ]
            what = f"{symbol(one.name)} = 0" if one.kind == "level" else _KIND_WORDS[one.kind]
            frequency = None if one.frequency is None else _round(one.frequency)
            place = f"{symbol(over)} = {with_unit(float(one.y[-1]), unit_of(model, over), 7)}"
            rows.append([what, place, *angles, frequency])
    if not rows:
        return None
    heads = [_head(name, unit_of(model, name)) for name in model.controlled]
    return Table(["", "where", *heads, "frequency [Hz]"], rows, "Special points of the curves.")


_KIND_WORDS = {
    "fold": "fold",
    "kink": "fold at a kink",
    "oscillation": "oscillation begins",
    "exchange": "stability changes",
    "crossing": "curves cross",
}
