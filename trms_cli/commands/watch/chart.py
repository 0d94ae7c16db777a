"""Curves over time in characters: eight dots a cell, or plain signs where there is no Unicode."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Bits of a braille character by row and column of its dots (U+2800 and on).
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_BLANK = 0x2800
_LEAST_RANGE = 0.1  # of the scale, in the curve's unit: the noise of a rig at rest is not a curve


@dataclass(frozen=True)
class TerminalCurve:
    """A line of a chart."""

    values: FloatArray  #: (n,) array; NaN where there is none
    style: str  #: How it looks, as rich has it
    sign: str  #: What draws it without Unicode


@dataclass(frozen=True)
class TerminalCell:
    """A character of a chart."""

    sign: str  #: The character
    style: str  #: How it looks, as rich has it


def scale(*values: FloatArray) -> tuple[float, float]:
    """Round limits around all that is to be seen, at least a tenth apart."""
    present = np.concatenate([v[np.isfinite(v)] for v in values] or [np.empty(0)])
    low, high = (float(present.min()), float(present.max())) if present.size else (0.0, 0.0)
    if high - low < _LEAST_RANGE:
        middle = (low + high) / 2
        low, high = middle - _LEAST_RANGE / 2, middle + _LEAST_RANGE / 2
    rough = (high - low) / 8
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough * 0.999)
    return step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)


def chart(
    time: FloatArray,
    curves: tuple[TerminalCurve, ...],
    within: tuple[float, float],
    limits: tuple[float, float],
    size: tuple[int, int],
    *,
    plain: bool = False,
) -> list[list[TerminalCell]]:
    """Draw curves over `time` (s, rising), the later ones over the earlier; the rows from the top.

    `within`: time at the left and at the right edge, s. `limits`: value at the lower and at the
    upper edge. `size`: columns and rows, in characters. `plain`: only ASCII.
    """
    columns, rows = size
    across, down = (1, 1) if plain else (2, 4)
    bits = np.zeros((rows, columns), dtype=int)
    owner = np.full((rows, columns), -1)
    for number, curve in enumerate(curves):
        low, high = _heights(time, curve.values, within, columns * across)
        edge = limits[1] - limits[0]
        tallest = rows * down - 1
        top = np.clip(np.rint((limits[1] - high) / edge * tallest), 0, tallest)
        bottom = np.clip(np.rint((limits[1] - low) / edge * tallest), 0, tallest)
        for x in np.flatnonzero(~np.isnan(high)):
            for y in range(int(top[x]), int(bottom[x]) + 1):
                bits[y // down, x // across] |= _DOTS[y % down, x % across]
                owner[y // down, x // across] = number
    return [
        [_cell(int(b), int(o), curves, plain) for b, o in zip(bits[row], owner[row], strict=True)]
        for row in range(rows)
    ]


def _cell(bits: int, owner: int, curves: tuple[TerminalCurve, ...], plain: bool) -> TerminalCell:
    if owner < 0:
        return TerminalCell(" ", "")
    return TerminalCell(curves[owner].sign if plain else chr(_BLANK + bits), curves[owner].style)


def _heights(
    time: FloatArray, values: FloatArray, within: tuple[float, float], columns: int
) -> tuple[FloatArray, FloatArray]:
    """The lowest and the highest value in each column; NaN where the curve has a gap.

    A column also reaches to where the one before it ended, so that a curve is one line.
    """
    low, high = np.full(columns, np.nan), np.full(columns, np.nan)
    present = np.isfinite(values)
    time, values = time[present], values[present]
    if not len(time):
        return low, high
    width = (within[1] - within[0]) / columns
    index = np.clip(((time - within[0]) / width).astype(int), 0, columns - 1)
    np.fmin.at(low, index, values)
    np.fmax.at(high, index, values)
    if len(time) == 1:
        return low, high
    steps = np.diff(time)
    longest = max(3.0 * float(np.median(steps)), 2.0 * width)  # beyond it, samples are missing
    for k in np.flatnonzero(np.diff(index)):
        here, there = index[k], index[k + 1]
        if steps[k] > longest:
            continue
        # The value on the way at each column's edge between two samples.
        between = np.arange(here + 1, there + 1)
        edges = within[0] + between * width
        share = np.clip((edges - time[k]) / steps[k], 0.0, 1.0)
        on_the_way = values[k] + share * (values[k + 1] - values[k])
        for column, value in zip(between, on_the_way, strict=True):
            for place in (column - 1, column):
                low[place] = np.fmin(low[place], value)
                high[place] = np.fmax(high[place], value)
    return low, high
