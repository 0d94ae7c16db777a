"""How the numbers of a rig's interface become signals in SI, and commands its numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Signal
from trms_cli.recordings.channels import STANDARD, Channel, Vocabulary, to_si


@dataclass(frozen=True, kw_only=True)
class Wire:
    """One signal: ``value = sign · unit · (scale · (raw − offset))``, or by a table from raw."""

    channel: int | str  #: Which number of a frame, from 0; of functions the key
    sign: Literal[1, -1]  #: Never assumed: a wrong one drives the rig into its stop
    scale: float = 1.0  #: Of what is left once the offset is taken off, in ``unit`` per raw 1
    offset: float = 0.0  #: What the interface shows at zero
    unit: str | None = None  #: Of the scaled value: deg, rpm, …; None for SI
    #: Readings beyond are left out like lost samples, commands cut to it; SI
    limit: tuple[float, float] | None = None
    #: Pairs of raw and value (in ``unit``) between which lines are drawn, in place of scale and
    #: offset; raw increases, and for a command the value strictly as well
    table: tuple[tuple[float, float], ...] = field(default=())

    def __post_init__(self) -> None:
        if self.scale == 0.0 or not math.isfinite(self.scale):
            raise ConfigurationError(
                f"{self.scale:g} given", where="scale", remedy="a number other than 0"
            )
        if self.limit is not None and not self.limit[0] < self.limit[1]:
            raise ConfigurationError(
                f"{list(self.limit)} given", where="limit", remedy="[lower, upper]"
            )
        raw = [pair[0] for pair in self.table]
        if self.table and (len(raw) < 2 or any(a >= b for a, b in pairwise(raw))):
            raise ConfigurationError(
                "the raw values of the table do not increase",
                where="table",
                remedy="pairs [raw, value], at least two, by increasing raw value",
            )


class Wiring:
    """The wires of readings or of commands, in the order of the signals.

    Parameters
    ----------
    wires : mapping of str to Wire
        By the name of the signal.
    names : sequence of str
        The signals of the kind that is meant, in their order.
    where : str
        Of the wires in the configuration.
    vocabulary : Vocabulary
        What the signals are.

    Raises
    ------
    ConfigurationError
        For a signal that does not exist, two on one channel, a unit that does not fit, and a table
        of commands that has no inverse.
    """

    def __init__(
        self,
        wires: Mapping[str, Wire],
        names: Sequence[str],
        where: str,
        vocabulary: Vocabulary = STANDARD,
    ) -> None:
        self.names = tuple(name for name in names if name in wires)
        self._wires = [wires[name] for name in self.names]
        self.channels = [wire.channel for wire in self._wires]
        for i, channel in enumerate(self.channels):
            if channel in self.channels[:i]:
                other = self.names[self.channels.index(channel)]
                raise ConfigurationError(
                    f"channel {channel!r} is that of {other} already",
                    where=f"{where}.{self.names[i]}.channel",
                    remedy="each signal has a channel of its own",
                )
        own = [vocabulary.channels[name] for name in self.names]
        self.signals = tuple(Signal(c.name, c.units[0], c.description) for c in own)
        self._factors = [
            wire.sign * _unit_factor(wire.unit, c, f"{where}.{c.name}.unit")
            for c, wire in zip(own, self._wires, strict=True)
        ]
        for c, wire in zip(own, self._wires, strict=True):
            name, values = c.name, [pair[1] for pair in wire.table]
            if c.role == "input" and any(a >= b for a, b in pairwise(values)):
                raise ConfigurationError(
                    "the values of a command's table do not increase, so it has no inverse",
                    where=f"{where}.{name}.table",
                    remedy="values that increase with raw; sign: -1 turns them round",
                )

    def values(self, raw: Sequence[float]) -> FloatArray:
        """Readings in SI, (n,), from their raw numbers; NaN beyond a limit."""
        values = np.empty(len(self._wires))
        for i, (wire, factor) in enumerate(zip(self._wires, self._factors, strict=True)):
            value = factor * _from_raw(wire, float(raw[i]))
            if wire.limit is not None and not wire.limit[0] <= value <= wire.limit[1]:
                value = math.nan if math.isfinite(value) else value
            values[i] = value
        return values

    def raw(self, values: Sequence[float]) -> list[float]:
        """What the interface gets for commands (n,) in SI."""
        raw = []
        for value, wire, factor in zip(values, self._wires, self._factors, strict=True):
            if wire.limit is not None:
                value = min(max(value, wire.limit[0]), wire.limit[1])
            raw.append(_to_raw(wire, value / factor))
        return raw

    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of each signal, (n,) each, SI; infinite where there is none."""
        pairs = [wire.limit or (-math.inf, math.inf) for wire in self._wires]
        return np.array([low for low, _ in pairs]), np.array([high for _, high in pairs])


def check_wires(wires: Mapping[str, Wire], where: str, allowed: Sequence[str]) -> None:
    """Refuse a signal that the rig does not have; the nearest is told."""
    for name in wires:
        if name not in allowed:
            raise ConfigurationError(
                f"there is no signal {name!r}",
                where=f"{where}.{name}",
                remedy=nearest(name, allowed),
            )


def zeroed(wire: Wire, name: str, raw: float, value: float) -> Wire:
    """The wire of a signal with the offset at which a raw number stands for a value (SI).

    Raises ConfigurationError for a table, which has its zero in itself.
    """
    if wire.table:
        raise ConfigurationError(
            f"{name} has a table, and a table has no offset",
            where=f"plant.wiring.{name}.table",
            remedy="shift the raw values of the table",
        )
    where = f"plant.wiring.{name}.unit"
    factor = wire.sign * wire.scale * _unit_factor(wire.unit, STANDARD.channels[name], where)
    return replace(wire, offset=raw - value / factor)


def _unit_factor(unit: str | None, channel: Channel, where: str) -> float:
    """What one of a unit is in SI."""
    if not unit:
        return 1.0
    from trms_cli.core.errors import RecordingError

    try:
        values, _ = to_si(np.ones(1), unit, channel.units, where=where, name=channel.name)
    except RecordingError as error:
        error.problem = error.problem.replace("column ", "")
        raise ConfigurationError(error.problem, where=where, remedy=error.remedy) from None
    return float(values[0])


def _from_raw(wire: Wire, raw: float) -> float:
    if wire.table:
        points = wire.table
        return float(np.interp(raw, [p[0] for p in points], [p[1] for p in points]))
    return wire.scale * (raw - wire.offset)


def _to_raw(wire: Wire, value: float) -> float:
    if wire.table:
        points = wire.table
        return float(np.interp(value, [p[1] for p in points], [p[0] for p in points]))
    return value / wire.scale + wire.offset
