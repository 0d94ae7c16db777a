"""What equilibria come to in sentences: the lead, the measures and the warnings."""

import math
from collections.abc import Sequence

from trms_cli.core.findings import Datum, Measure
from trms_cli.core.wording import symbol
from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.proof import RangePiece
from trms_cli.stability.equilibria.result import EquilibriaResult, proved_share
from trms_cli.stability.equilibria.survey import EquilibriumPoint, FrictionBand, Landmark, Survey
from trms_cli.stability.local.sweep import unit_of

#: Landmarks that the answer names.
_FIRST = ("fold", "kink", "oscillation", "exchange", "crossing")
_MOST_PIECES = 7
#: Every so many points of a curve are asked whether they lie on a switch.
_SWITCH_STRIDE = 5


def lead_sentences(result: EquilibriaResult) -> list[str]:
    """Where the rig rests, where equilibria end, what is proved, and what friction holds."""
    model, lead = result.model, []
    for point in result.named_points:
        commands, states = (
            ", ".join(value_text(model, name, point.value(model, name)) for name in group)
            for group in (names(model.inputs), outcome_names(model))
        )
        stability = stability_cell(point).value
        lead.append(f"{point.name.capitalize()}: {commands}: {states} ({stability}).")
    for one in result.surveys:
        marks = [_landmark_words(one, mark) for mark in one.landmarks if mark.kind in _FIRST]
        lead += [sentence(words) for words in dict.fromkeys(marks)]
        lead.append(_proof_words(one))
    for point in result.named_points:
        lead += [sentence(f"{point.name}: {_band_words(model, band)}") for band in point.bands]
    return lead


def measures_of(result: EquilibriaResult) -> list[Measure]:
    """Where the first axis rests at each named point, and the commands at which equilibria end."""
    model, measures = result.model, []
    for axis in list(model.controlled)[:1]:
        unit = unit_of(model, axis)
        for point in result.named_points:
            stability = stability_cell(point)
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


def warning_sentences(result: EquilibriaResult, left_out: Sequence[str]) -> list[str]:
    """What casts doubt on the result; of effects left out of the equations, those that matter."""
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


def _landmark_words(survey: Survey, one: Landmark) -> str:
    model = survey.model
    at = value_text(model, survey.setting.over, float(one.y[-1]), 6)
    angles = [name for name in model.controlled if name not in survey.system.free]
    place = ", ".join(value_text(model, name, one.at.value(model, name)) for name in angles)
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
    share = proved_share(survey.pieces)
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


def _band_words(model: Model, band: FrictionBand) -> str:
    """What friction holds."""
    text = f"dry friction of {_number(band.torque)} N m holds {symbol(band.angle)} anywhere"
    if band.lower is not None and band.upper is not None:
        return f"{text} from {_number(band.lower)} to {_number(band.upper)} rad"
    if band.command is not None:
        name, low, high = band.command
        top = _with_unit(high, unit_of(model, name))
        return f"{text}, for {symbol(name)} from {_number(low)} to {top}"
    return text


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
            f"at {value_text(survey.model, survey.setting.over, check.input)} the number is "
            f"not proved: {len(proof.proved)} found, undecided: {places}"
            + (f" and {more} places more" if more > 0 else "")
            + f"; the curves have {len(check.points) or 'none'} there"
        )
    return words


def stability_cell(point: EquilibriumPoint) -> Datum:
    """``stable``, or how many motions grow."""
    if point.unstable:
        return Datum(f"{point.unstable} growing", "bad")
    if point.verdict == "unstable":
        return Datum("grows with t", "bad")
    return Datum(point.verdict, "good" if point.verdict == "stable" else "doubtful")


def outcome_names(model: Model) -> list[str]:
    """What commands come to: controlled angles and rotors' speeds."""
    speeds = (name for name in model.state_names if name.startswith("omega"))
    return list(dict.fromkeys([*model.controlled, *speeds]))


def value_text(model: Model, name: str, value: float, digits: int = 4) -> str:
    """``α_v = 0.1 rad``."""
    return f"{symbol(name)} = {_with_unit(value, unit_of(model, name), digits)}"


def symbol_list(signals: Sequence[str]) -> str:
    """``α_v, ω_v``."""
    return ", ".join(symbol(name) for name in signals)


def sentence(words: str) -> str:
    """With a capital and a full stop."""
    return words[0].upper() + words[1:] + "."


def _with_unit(value: float, unit: str, digits: int = 4) -> str:
    return f"{_number(value, digits)} {unit}".removesuffix(" 1").rstrip()


def _number(value: float, digits: int = 4) -> str:
    """A few digits; what is rounding is zero."""
    return f"{0.0 if abs(value) < 1e-9 else value:.{digits}g}"
