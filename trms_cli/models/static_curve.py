"""Measured curves: a rotor's speed and thrust, and a motor's voltage, against the command.

A table of steady values (``u[1],omega[rpm],thrust[N]``) becomes two functions of the speed: the
command that holds it, H⁻¹(ω), and the thrust F(ω). Each is a least-squares cubic spline, so that
the scatter of single points does not become slope, with continuous second derivatives for the
Newton-type solvers. It has as many knots as it can have while it rises throughout; beyond the
table it goes on straight.

The spline is written in truncated powers, ``P(s) + Σ_j c_j max(0, s − s_j)³`` on a scaled speed
s in [−1, 1]: a handful of operations a knot, without a branch, in any CasADi graph.

A table is a CSV with ``name[unit]`` columns.

The interface circuit, what voltage a command gives its motor, is a gain, ``v = k_u u``, or such a
curve (``u[V],v[V]``). Either may saturate; a table whose ends are flat saturates where it does. The
limits of a TRMS are near ±21.5 V (main) and ±16.5 V (tail), which commands up to 2.5 V do not reach
with the nominal gains.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.data_file import MEBIBYTE, read_bytes
from trms_cli.core.errors import ConfigurationError, ModelError

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


_INTERFACE_HEADER = "u[V],v[V]"
_VOLTAGE_UNITS = {"V": 1.0, "mV": 1e-3}

#: A piece at an end whose slope is below this share of the mean slope is taken as saturated.
_FLAT = 0.05


@dataclass(frozen=True)
class Gain:
    """An amplifier."""

    name: str  #: Its parameter, V/V
    limit: float | None = None  #: Where the voltage saturates, to either side, V; None: nowhere

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters that it takes from the model's set."""
        return (self.name,)

    def voltage(self, u: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """v(u), V."""
        volt = c[self.name] * u
        return volt if self.limit is None else ca.fmin(ca.fmax(volt, -self.limit), self.limit)


@dataclass(frozen=True)
class MeasuredInterface:
    """A measured curve."""

    curve: RisingSpline  #: v by u, both in V, of the part that rises
    least: float  #: Where it saturates, V
    most: float  #: infinite where it does not

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return ()

    def voltage(self, u: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        volt = self.curve(u)
        if np.isfinite(self.most):
            volt = ca.fmin(volt, self.most)
        if np.isfinite(self.least):
            volt = ca.fmax(volt, self.least)
        return volt


#: Voltage at a motor by its command, as an expression.
InterfaceCircuit = Gain | MeasuredInterface


def interface_of(axis: str, table: str | None, limit: float | None, where: str) -> InterfaceCircuit:
    """The circuit of a motor.

    ``axis``: suffix of its gain, ``v`` or ``h``. ``table``: path of a measured curve; None takes
    the gain of the parameter set. ``limit``: where the voltage saturates to either side, V; None:
    where the table does, or nowhere. ``where``: beginning of the configuration keys
    ``<where>interface`` and ``<where>voltage_limit``. Raises ConfigurationError for a limit that is
    not above zero. Raises ModelError for a table that cannot be used.
    """
    if limit is not None and not limit > 0:
        raise ConfigurationError(
            f"{limit!r} given",
            where=f"{where}voltage_limit",
            remedy="give a voltage above 0 (21.5 main, 16.5 tail), or null",
        )
    if table is None:
        return Gain(f"k_u{axis}", limit)
    u, volt = _read_interface(table, f"{where}interface")
    first, last = _rising_part(u, volt)
    curve = rising_spline(u[first:last], volt[first:last])
    if curve is None or volt[first] >= 0 or volt[last - 1] <= 0:
        raise ModelError(
            "the voltage does not rise with the command from below to above zero",
            where=table,
            remedy="measure over both directions, and look for rows of another run",
        )
    least = float(volt[:first].mean()) if first > 0 else -np.inf
    most = float(volt[last:].mean()) if last < len(volt) else np.inf
    if limit is not None:
        least, most = max(least, -limit), min(most, limit)
    return MeasuredInterface(curve, least, most)


def _read_interface(path: str, where: str) -> tuple[FloatArray, FloatArray]:
    table = read_table(
        path,
        where,
        what="an interface curve",
        header=_INTERFACE_HEADER,
        columns={"u": _VOLTAGE_UNITS, "v": _VOLTAGE_UNITS},
        fewest=_FEWEST_ROWS,
    )
    order = np.argsort(table["u"])
    u, volt = table["u"][order], table["v"][order]
    twice = np.flatnonzero(np.diff(u) <= 0)
    if twice.size:
        raise ModelError(
            f"the command u = {u[twice[0]]:g} V stands twice",
            where=path,
            remedy="give each command once, with the mean of its voltages",
        )
    return u, volt


def _rising_part(u: FloatArray, volt: FloatArray) -> tuple[int, int]:
    """From where up to, and without, where the curve rises; flat ends are saturation."""
    slopes = np.diff(volt) / np.diff(u)
    rising = np.flatnonzero(slopes > _FLAT * np.median(slopes[len(u) // 4 : -(len(u) // 4)]))
    if rising.size == 0 or rising[-1] + 2 - rising[0] < _FEWEST_ROWS // 2:
        return 0, len(u)
    return int(rising[0]), int(rising[-1]) + 2
