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

from trms_cli.core.arrays import FloatArray, IntArray
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
_GREEK = {"pitch": "α_v", "yaw": "α_h"}
_RATES = {"pitch": "Ω_v", "yaw": "Ω_h"}
_SPEEDS = {"main": "ω_v", "tail": "ω_h"}
_COMMANDS = {"main": "u_v", "tail": "u_h"}


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
            explained_share = 1 - _residual_share(
                record, block, [beside, *(t.columns for t in (*selection, term))]
            )
            if explained_share > max(goal, share):
                best, share = term, explained_share
        if best is None:
            break
        selection.append(best)
        shares.append(share)
    if not selection:
        return ()
    sizes = _sizes(record, [beside, *(term.columns for term in selection)])
    what = _whats_missing(record.location)
    formulas = [term.formula(s, record.unit) for term, s in zip(selection, sizes, strict=True)]
    text = f"The closest short law is {formulas[0]}"
    if len(selection) > 1:
        text += f", {percent(shares[0])} {what} on held-out data; with "
        text += f"{formulas[1]} it is {percent(shares[1])}."
    else:
        text += f": {percent(shares[0])} {what} on held-out data."
    return (text,)


def _whats_missing(location: str) -> str:
    side, kind = location.split("_")
    if kind == "sensor":
        return f"of what the {side} sensor adds to the angle"
    return (
        f"of the missing {side} torque" if kind == "moment" else f"of what the {side} motor lacks"
    )


def _residual_share(record: ForceRecord, block: IntArray, columns: list[FloatArray]) -> float:
    """Share of the force's energy that a regression leaves on blocks that it has not seen."""
    target = record.force[:, None]
    errors = held_out_errors(np.hstack(columns), target, block, penalties=(_PENALTY,))
    return float(errors.sum()) / float(record.force @ record.force)


def _sizes(record: ForceRecord, columns: list[FloatArray]) -> list[FloatArray]:
    """Of the columns of each term, without those of what stands beside them."""
    phi = np.hstack([*columns, np.ones((len(record.force), 1))])
    scale = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    coefficients = np.linalg.lstsq(phi / scale, record.force, rcond=1e-6)[0] / scale
    ends = np.cumsum([c.shape[1] for c in columns])
    return [coefficients[a:b] for a, b in pairwise(ends.tolist())]


def _parameters_do(record: ForceRecord) -> FloatArray:
    """Columns of what nominal parameters do to the equation, (k, p)."""
    axis, rotor = record.axis, _rotor(record.axis)
    columns = [record.angles[axis]]
    if record.location.endswith("sensor"):
        return np.array(columns).T
    if axis in record.rates:
        columns.append(record.rates[axis])
    if axis == "yaw":  # the cable's spring differs from side to side
        columns.append(np.abs(record.angles[axis]))
    if axis == "pitch":
        columns += [np.sin(record.angles[axis]), np.cos(record.angles[axis])]
    if rotor in record.speeds:
        speed = record.speeds[rotor]
        columns += [speed, speed * np.abs(speed)]
    if record.location.endswith("motor") and rotor in record.commands:
        columns.append(record.commands[rotor])
    return np.array(columns).T


def short_terms(record: ForceRecord) -> Iterator[ShortTerm]:
    """All that are tried, as far as the record has what they are of."""
    axis = record.axis
    other = "yaw" if axis == "pitch" else "pitch"
    if record.location.endswith("motor"):
        yield from _of_a_drive(record, _rotor(axis), _rotor(other))
        return
    yield from _of_an_angle(record.angles[axis], _GREEK[axis])
    if record.location.endswith("sensor"):
        return
    if other in record.angles:
        yield from _harmonics(record.angles[other], _GREEK[other], _FEW)
    if axis in record.rates:
        rate, name = record.rates[axis], _RATES[axis]
        yield _term(f"sgn {name}", "", _sign(rate))
        yield _term(f"{name}|{name}|", "rad²/s²", rate * np.abs(rate))
    if other in record.rates:
        yield _term(_RATES[other], "rad/s", record.rates[other])
    yield from _of_rotors(record, axis, other)


def _of_an_angle(angle: FloatArray, name: str) -> Iterator[ShortTerm]:
    yield from _harmonics(angle, name, _HARMONICS)
    yield _term(f"{name}²", "rad²", angle**2)
    yield _term(f"{name}³", "rad³", angle**3)
    for limit in np.quantile(np.abs(angle), _CATCHES).tolist():
        at = float(f"{limit:.2g}")
        beyond = np.sign(angle) * np.maximum(np.abs(angle) - at, 0.0)
        yield _term(
            f"(|{name}| − {at:g} rad) sgn {name} beyond |{name}| = {at:g} rad", "rad", beyond
        )


def _of_rotors(record: ForceRecord, axis: str, other: str) -> Iterator[ShortTerm]:
    rotor, beside = _rotor(axis), _rotor(other)
    if rotor in record.speeds:
        w, name = record.speeds[rotor], _SPEEDS[rotor]
        thrust, unit = w * np.abs(w), "rad²/s²"
        for angle_axis, angle in record.angles.items():
            symbol = _GREEK[angle_axis]
            yield _term(f"{name}|{name}| sin² {symbol}", unit, thrust * np.sin(angle) ** 2)
            yield _term(f"{name}|{name}| sin {symbol}", unit, thrust * np.sin(angle))
        yield _term(f"|{name}|³ sgn {name}", "rad³/s³", w**3)
        if axis in record.rates:
            rate = record.rates[axis]
            yield _term(f"|{name}| {_RATES[axis]}", unit, np.abs(w) * rate)
    if beside in record.speeds:
        w, name = record.speeds[beside], _SPEEDS[beside]
        yield _term(f"{name}|{name}|", "rad²/s²", w * np.abs(w))
    if "main" in record.speeds and other in record.rates:
        spin = record.speeds["main"] * record.rates[other]
        yield _term(f"ω_v {_RATES[other]}", "rad²/s²", spin)


def _of_a_drive(record: ForceRecord, rotor: str, other: str) -> Iterator[ShortTerm]:
    if rotor in record.speeds:
        w, name = record.speeds[rotor], _SPEEDS[rotor]
        yield _term(f"sgn {name}", "", _sign(w))
        yield _term(f"{name}³", "rad³/s³", w**3)
    if rotor in record.commands:
        u, name = record.commands[rotor], _COMMANDS[rotor]
        yield _term(f"sgn {name}", "", _sign(u))
        yield _term(f"{name}|{name}|", "V²", u * np.abs(u))
        yield _term(f"{name}³", "V³", u**3)
        if other in record.commands:
            load, beside = record.commands[other], _COMMANDS[other]
            yield _term(f"{name} {beside}", "V²", u * load)
            yield _term(f"{name} {beside}²", "V³", u * load**2)
            yield _term(f"{name} |{beside}|", "V²", u * np.abs(load))
            yield _term(beside, "V", load)


def _harmonics(angle: FloatArray, name: str, numbers: range) -> Iterator[ShortTerm]:
    for k in numbers:
        times = f"{k} " if k > 1 else ""
        columns = np.column_stack([np.sin(k * angle), np.cos(k * angle)])
        yield ShortTerm(f"sin({times}{name} {{phase}})", "", columns)


def _term(text: str, unit: str, column: FloatArray) -> ShortTerm:
    return ShortTerm(text, unit, column[:, None])


def _sign(values: FloatArray) -> FloatArray:
    return np.asarray(np.tanh(values / (_SHARP * float(values.std()) + 1e-12)))


def _rotor(axis: str) -> str:
    return "main" if axis == "pitch" else "tail"
