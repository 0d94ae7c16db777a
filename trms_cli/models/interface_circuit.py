"""The interface circuit: what voltage a command gives its motor.

A gain, ``v = k_u u``, or a measured table (CSV ``u[V],v[V]``) as a smooth rising curve. Either may
saturate; a table whose ends are flat saturates where it does. The limits of a TRMS are near
±21.5 V (main) and ±16.5 V (tail), which commands up to 2.5 V do not reach with the nominal gains.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np

from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.models.static_curve import FloatArray, RisingSpline, read_table, rising_spline

_HEADER = "u[V],v[V]"
_UNITS = {"V": 1.0, "mV": 1e-3}
_FEWEST_ROWS = 8
#: A piece at an end whose slope is below this share of the mean slope is taken as saturated.
_FLAT = 0.05


class InterfaceCircuit(Protocol):
    """Voltage at a motor by its command, as an expression."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters that it takes from the model's set."""
        ...

    def voltage(self, u: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
        """v(u), V."""
        ...


@dataclass(frozen=True)
class Gain:
    """An amplifier."""

    name: str  #: Its parameter, V/V
    limit: float | None = None  #: Where the voltage saturates, to either side, V; None: nowhere

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return (self.name,)

    def voltage(self, u: ca.SX, c: Mapping[str, ca.SX]) -> ca.SX:
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
    u, volt = _read(table, f"{where}interface")
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


def _read(path: str, where: str) -> tuple[FloatArray, FloatArray]:
    table = read_table(
        path,
        where,
        what="an interface curve",
        header=_HEADER,
        columns={"u": _UNITS, "v": _UNITS},
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
