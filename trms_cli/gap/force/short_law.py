"""The shortest formula that comes near a missing force: one or two physical terms, in words.

Each candidate is a term with the sizes that a regression gives it: a harmonic of a turn of an angle
with its phase, a spring that catches beyond an angle, a sign, a product of a thrust with an angle.
Beside it stands what the nominal parameters do to that equation, since a refit has mixed that into
the missing force. The share that is told is of blocks that were left out.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.wording import number, percent
from trms_cli.gap.force.exogenous import held_out_errors
from trms_cli.gap.force.laws import ForceRecord

#: Hz, of the regression, s, of the blocks that are left out, and its ridge penalty.
_RATE, _BLOCK, _PENALTY = 6.0, 10.0, 1e-5
#: Harmonics of a turn of the own angle, and of the other axis'.
_HARMONICS, _FEW = range(1, 25), range(1, 5)
#: Quantiles of an angle's size beyond which something may catch.
_CATCHES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
#: Of a rate's or speed's spread, within which its sign turns.
_SHARP = 0.03
#: Share that a first term must explain to be told, and that a second must add.
_FIRST, _SECOND = 0.3, 0.04


@dataclass(frozen=True)
class ShortTerm:
    """One term: its columns and how it is written."""

    text: str  #: of the columns' function, with ``{phase}`` for a harmonic
    unit: str  #: of the column, to divide the force's unit by
    columns: FloatArray  #: (k, 1) array; of a harmonic its sine and cosine, (k, 2)

    def formula(self, sizes: FloatArray, unit: str) -> str:
        """With the sizes of its columns in it."""
        if len(sizes) == 2:
            size, phase = float(np.hypot(*sizes)), float(np.arctan2(sizes[1], sizes[0]))
            sign = "+" if phase >= 0 else "−"
            expression = self.text.format(phase=f"{sign} {abs(phase):.2g}")
        else:
            size, expression = float(sizes[0]), self.text
        per = f"/({self.unit})" if "/" in self.unit else f"/{self.unit}" if self.unit else ""
        return f"{number(size, 2)} {unit.replace('*', ' ')}{per} · {expression}"


def short_law_of(record: ForceRecord) -> tuple[str, ...]:
    """The closest short formula in a sentence; empty where none comes near."""
    record = record.thinned(_RATE)
    energy = float(record.force @ record.force)
    if energy <= 0 or not record.angles:
        return ()
    block = record.blocks(_BLOCK)
    beside = _parameters_do(record)
    selection: list[ShortTerm] = []
    shares: list[float] = []
    candidates = list(short_terms(record))
    for least in (_FIRST, _SECOND):
        best, share = None, shares[-1] if shares else 0.0
        goal = share + least
        for term in candidates:
            columns = np.hstack([beside, *(t.columns for t in (*selection, term))])
            errors = held_out_errors(columns, record.force[:, None], block, penalties=(_PENALTY,))
            explained_share = 1 - float(errors.sum()) / energy
            if explained_share > max(goal, share):
                best, share = term, explained_share
        if best is None:
            break
        selection.append(best)
        shares.append(share)
    if not selection:
        return ()
    sizes = _sizes(record, [beside, *(term.columns for term in selection)])
    what = _whats_missing(record)
    formulas = [term.formula(s, record.unit) for term, s in zip(selection, sizes, strict=True)]
    text = f"The closest short law is {formulas[0]}"
    if len(selection) > 1:
        text += f", {percent(shares[0])} {what} on held-out data; with "
        text += f"{formulas[1]} it is {percent(shares[1])}."
    else:
        text += f": {percent(shares[0])} {what} on held-out data."
    return (text,)


def _whats_missing(record: ForceRecord) -> str:
    kind, part = record.kind, record.parts.part_of(record.location)
    if kind == "sensor":
        return f"of what the {part} sensor adds to the {record.parts.nouns(record.axis)[0]}"
    force = "torque" if record.unit == "N*m" else "force"
    return (
        f"of the missing {part} {force}" if kind == "moment" else f"of what the {part} motor lacks"
    )


def _sizes(record: ForceRecord, columns: list[FloatArray]) -> list[FloatArray]:
    """Of the columns of each term, without those of what stands beside them."""
    phi = np.hstack([*columns, np.ones((len(record.force), 1))])
    scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    coefficients = np.linalg.lstsq(phi / scale, record.force, rcond=1e-6)[0] / scale
    ends = np.cumsum([c.shape[1] for c in columns])
    return [coefficients[a:b] for a, b in pairwise(ends.tolist())]


def _parameters_do(record: ForceRecord) -> FloatArray:
    """Columns of what nominal parameters do to the equation, (k, p)."""
    axis, rotor, parts = record.axis, record.drive, record.parts
    columns = [record.angles[axis]]
    if record.kind == "sensor":
        return np.array(columns).T
    if axis in record.rates:
        columns.append(record.rates[axis])
    if axis == parts.tilting:
        columns += [np.sin(record.angles[axis]), np.cos(record.angles[axis])]
    else:  # a cable's spring differs from side to side
        columns.append(np.abs(record.angles[axis]))
    if rotor in record.speeds:
        speed = record.speeds[rotor]
        columns += [speed, speed * np.abs(speed)]
    if rotor in record.commands and (record.kind == "motor" or rotor not in parts.rotors):
        columns.append(record.commands[rotor])
    return np.array(columns).T


def short_terms(record: ForceRecord) -> Iterator[ShortTerm]:
    """All that are tried, as far as the record has what they are of."""
    axis, parts = record.axis, record.parts
    other = parts.other_axis(axis)
    if record.kind == "motor":
        yield from _of_a_drive(record, record.drive, parts.drive_of(other))
        return
    yield from _of_an_angle(record, axis)
    if record.kind == "sensor":
        return
    if other in record.angles and parts.turns(other):
        yield from _harmonics(record.angles[other], parts.symbol(other), _FEW)
    if axis in record.rates:
        rate, name = record.rates[axis], parts.rate_symbol(axis)
        yield _term(f"sgn {name}", "", _sign(rate))
        yield _term(f"{name}|{name}|", f"{parts.unit(axis)}²/s²", rate * np.abs(rate))
    if other in record.rates:
        yield _term(parts.rate_symbol(other), f"{parts.unit(other)}/s", record.rates[other])
    yield from _of_rotors(record, axis, other)


def _of_an_angle(record: ForceRecord, axis: str) -> Iterator[ShortTerm]:
    angle, name, unit = record.angles[axis], record.parts.symbol(axis), record.parts.unit(axis)
    if record.parts.turns(axis):
        yield from _harmonics(angle, name, _HARMONICS)
    yield _term(f"{name}²", f"{unit}²", angle**2)
    yield _term(f"{name}³", f"{unit}³", angle**3)
    for limit in np.quantile(np.abs(angle), _CATCHES).tolist():
        at = float(f"{limit:.2g}")
        beyond = np.sign(angle) * np.maximum(np.abs(angle) - at, 0.0)
        text = f"(|{name}| − {at:g} {unit}) sgn {name} beyond |{name}| = {at:g} {unit}"
        yield _term(text, unit, beyond)


def _of_rotors(record: ForceRecord, axis: str, other: str) -> Iterator[ShortTerm]:
    parts = record.parts
    rotor, beside, tilting = (parts.drive_of(name) for name in (axis, other, parts.tilting))
    if rotor in record.speeds:
        w, name = record.speeds[rotor], parts.speed_symbol(rotor)
        thrust, unit = w * np.abs(w), "rad²/s²"
        for angle_axis, angle in record.angles.items():
            symbol = parts.symbol(angle_axis)
            yield _term(f"{name}|{name}| sin² {symbol}", unit, thrust * np.sin(angle) ** 2)
            yield _term(f"{name}|{name}| sin {symbol}", unit, thrust * np.sin(angle))
        yield _term(f"|{name}|³ sgn {name}", "rad³/s³", w**3)
        if axis in record.rates:
            rate = record.rates[axis]
            yield _term(f"|{name}| {parts.rate_symbol(axis)}", unit, np.abs(w) * rate)
    if beside in record.speeds:
        w, name = record.speeds[beside], parts.speed_symbol(beside)
        yield _term(f"{name}|{name}|", "rad²/s²", w * np.abs(w))
    if tilting in record.speeds and other in record.rates:
        spin = record.speeds[tilting] * record.rates[other]
        text = f"{parts.speed_symbol(tilting)} {parts.rate_symbol(other)}"
        yield _term(text, "rad²/s²", spin)


def _of_a_drive(record: ForceRecord, rotor: str, other: str) -> Iterator[ShortTerm]:
    parts, volts = record.parts, record.parts.command_unit(rotor)
    if rotor in record.speeds:
        w, name = record.speeds[rotor], parts.speed_symbol(rotor)
        yield _term(f"sgn {name}", "", _sign(w))
        yield _term(f"{name}³", "rad³/s³", w**3)
    if rotor in record.commands:
        u, name = record.commands[rotor], parts.command_symbol(rotor)
        yield _term(f"sgn {name}", "", _sign(u))
        yield _term(f"{name}|{name}|", f"{volts}²", u * np.abs(u))
        yield _term(f"{name}³", f"{volts}³", u**3)
        if other in record.commands:
            load, beside = record.commands[other], parts.command_symbol(other)
            yield _term(f"{name} {beside}", f"{volts}²", u * load)
            yield _term(f"{name} {beside}²", f"{volts}³", u * load**2)
            yield _term(f"{name} |{beside}|", f"{volts}²", u * np.abs(load))
            yield _term(beside, volts, load)


def _harmonics(angle: FloatArray, name: str, numbers: range) -> Iterator[ShortTerm]:
    for k in numbers:
        times = f"{k} " if k > 1 else ""
        columns = np.column_stack([np.sin(k * angle), np.cos(k * angle)])
        yield ShortTerm(f"sin({times}{name} {{phase}})", "", columns)


def _term(text: str, unit: str, column: FloatArray) -> ShortTerm:
    return ShortTerm(text, unit, column[:, None])


def _sign(values: FloatArray) -> FloatArray:
    return np.asarray(np.tanh(values / (_SHARP * float(values.std()) + 1e-12)))
