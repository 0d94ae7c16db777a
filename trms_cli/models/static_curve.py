"""Measured curves of rotors: speed and thrust against the command, as smooth functions.

A table of steady values (``u[1],omega[rpm],thrust[N]``) becomes two functions of the speed: the
command that holds it, H⁻¹(ω), and the thrust F(ω). Each is a least-squares cubic spline, so that
the scatter of single points does not become slope, with continuous second derivatives for the
Newton-type solvers. It has as many knots as it can have while it rises throughout; beyond the
table it goes on straight.

The spline is written in truncated powers, ``P(s) + Σ_j c_j max(0, s − s_j)³`` on a scaled speed
s in [−1, 1]: a handful of operations a knot, without a branch, in any CasADi graph.

A table is a CSV with ``name[unit]`` columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.data_file import MEBIBYTE, read_bytes
from trms_cli.core.errors import ModelError

_HEADER = "u[1],omega[rpm],thrust[N]"
#: Factor to rad/s.
_SPEED_UNITS = {"rad/s": 1.0, "rpm": np.pi / 30.0}
_FEWEST_ROWS = 8
#: Most pieces of a spline; a table has fewer when it is short or scattered.
_MOST_PIECES = 16
_POINTS_PER_PIECE = 4
#: Of a file; a measured curve has some kilobytes.
_MOST = MEBIBYTE
#: Factor to SI by unit, by column.
Columns = Mapping[str, Mapping[str, float]]


def read_table(
    path: str, where: str, *, what: str, header: str, columns: Columns, fewest: int
) -> dict[str, FloatArray]:
    """Read a table, its columns in any order; lines that begin with ``#`` are skipped.

    ``where``: the configuration key, for messages. ``what``: what the table holds, in words: ``a
    static curve``. ``header``: how its first line is usually written. ``columns``: factor to SI by
    unit, of every column that there must be. ``fewest``: least number of rows. Returns (n,) columns
    in SI, in the order of the file. Raises ModelError if there is no such file, or its content is
    not such a table; with the line.
    """
    try:
        text = read_bytes(Path(path), _MOST).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise ModelError(
            f"cannot read {path!r}: {reason}",
            where=where,
            remedy=f"give a CSV of steady values with the header {header}",
        ) from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise ModelError("the file is empty", where=path, remedy=f"it begins with {header}")
    place = f"{path}:{lines[0][0]}"
    factors, order = _columns(lines[0][1], place, what, header, columns)
    rows = [_row(line, len(order), f"{path}:{number}") for number, line in lines[1:]]
    if len(rows) < fewest:
        raise ModelError(
            f"{len(rows)} points given",
            where=path,
            remedy=f"a curve needs {fewest} points or more, over both directions",
        )
    table = np.array(rows)
    return {name: table[:, order[name]] * factors[name] for name in columns}


def _columns(
    text: str, where: str, what: str, header: str, columns: Columns
) -> tuple[dict[str, float], dict[str, int]]:
    """Factor to SI and position of each column."""
    factors: dict[str, float] = {}
    order: dict[str, int] = {}
    for position, cell in enumerate(text.split(",")):
        name, _, unit = cell.strip().rstrip("]").partition("[")
        allowed = columns.get(name, {})
        if unit not in allowed or name in order:
            raise ModelError(
                f"column {cell.strip()!r} is not part of {what}",
                where=where,
                remedy=f"write the header {header}{_other_units(columns)}",
            )
        factors[name], order[name] = allowed[unit], position
    if len(order) < len(columns):
        raise ModelError(
            f"the header {text.strip()!r} lacks a column",
            where=where,
            remedy=f"write the header {header}",
        )
    return factors, order


def _other_units(columns: Columns) -> str:
    """Words on columns that may have another unit than the usual one."""
    others = [
        f"{name} also in {next(iter(units))}" for name, units in columns.items() if len(units) > 1
    ]
    return f" ({', '.join(others)})" if others else ""


def _row(line: str, width: int, where: str) -> list[float]:
    try:
        row = [float(cell) for cell in line.split(",")]
    except ValueError:
        row = []
    if len(row) != width or not np.isfinite(row).all():
        raise ModelError(
            f"{line.strip()!r} is no row of {width} numbers",
            where=where,
            remedy="write decimals with a point and separate columns by commas",
        )
    return row


@dataclass(frozen=True)
class StaticCurve:
    """Steady values of a rotor at rising commands."""

    command: FloatArray  #: (n,) array; normalised, "1"
    speed: FloatArray  #: (n,) array; rad/s, rising
    thrust: FloatArray  #: (n,) array; N


@dataclass(frozen=True)
class RisingSpline:
    """A cubic spline that rises throughout, straight beyond its ends."""

    #: ``centre``, ``scale``: The argument becomes ``s = (x − centre)/scale``, in [−1, 1]
    centre: float
    scale: float
    #: (4,) array; of the first piece, in powers of s + 1 from the constant on
    polynomial: FloatArray
    #: ``knots``, ``jumps``: (m,) arrays; where, in s, the third derivative jumps, and by how much
    #: (over 6)
    knots: FloatArray
    jumps: FloatArray
    slopes: tuple[float, float]  #: df/ds at both ends

    def __call__(self, x: ca.SX) -> ca.SX:
        """The function as an expression."""
        free = (x - self.centre) / self.scale
        s = ca.fmin(ca.fmax(free, -1.0), 1.0)
        from_left = s + 1.0
        value = ca.SX(0)
        for coefficient in self.polynomial[::-1]:
            value = value * from_left + coefficient
        for knot, jump in zip(self.knots, self.jumps, strict=True):
            beyond = ca.fmax(s - knot, 0.0)
            value += jump * beyond * beyond * beyond
        outside = free - s
        slope = ca.if_else(free < 0, self.slopes[0], self.slopes[1])
        return value + slope * outside


def rising_spline(x: FloatArray, y: FloatArray) -> RisingSpline | None:
    """The least-squares spline of a table with the most pieces that rises; None if none does.

    ``x``, ``y``: (n,) arrays; x rising.
    """
    from scipy.interpolate import PPoly, make_lsq_spline

    centre, scale = float(x[-1] + x[0]) / 2, float(x[-1] - x[0]) / 2
    s = (x - centre) / scale
    for pieces in range(min(_MOST_PIECES, len(x) // _POINTS_PER_PIECE), 0, -1):
        inner = np.quantile(s, np.arange(1, pieces) / pieces)
        knots = np.concatenate([[-1.0] * 4, inner, [1.0] * 4])
        piecewise = PPoly.from_spline(make_lsq_spline(s, y, knots, k=3))
        slope = piecewise.derivative()
        if np.min(slope(np.linspace(-1.0, 1.0, 2001))) <= 0:
            continue
        # `from_spline` keeps the repeated end knots as pieces of no length.
        real = np.flatnonzero(np.diff(piecewise.x) > 0)
        cubic = piecewise.c[:, real]
        return RisingSpline(
            centre,
            scale,
            cubic[::-1, 0].copy(),
            piecewise.x[real][1:].copy(),
            np.diff(cubic[0]),
            (float(slope(-1.0)), float(slope(1.0))),
        )
    return None


def read_static_curve(path: str, where: str) -> StaticCurve:
    """Read a table of steady values from CSV.

    ``path``: columns ``u[1]``, ``omega[rpm]`` or ``omega[rad/s]``, ``thrust[N]`` in any order;
    lines that begin with ``#`` are skipped. ``where``: the configuration key, for messages. Raises
    ModelError if there is no such file, or its content is not such a table.
    """
    table = read_table(
        path,
        where,
        what="a static curve",
        header=_HEADER,
        columns={"u": {"1": 1.0}, "omega": _SPEED_UNITS, "thrust": {"N": 1.0}},
        fewest=_FEWEST_ROWS,
    )
    u, omega, thrust = table["u"], table["omega"], table["thrust"]
    rising = np.argsort(u)
    u, omega, thrust = u[rising], omega[rising], thrust[rising]
    if np.any(np.diff(u) <= 0) or np.any(np.diff(omega) <= 0):
        worst = int(np.argmin(np.diff(omega)))
        raise ModelError(
            f"the speed does not rise with the command between u = {u[worst]:g} and "
            f"{u[worst + 1]:g}",
            where=path,
            remedy="give each command once, with the speed that it holds; leave a dead zone out",
        )
    return StaticCurve(u, omega, thrust)
