"""A rig that two functions of the user's reach: a vendor's library, a card, anything with Python.

``read()`` gives a dictionary of numbers by channel, ``write(values)`` takes one; ``open()`` and
``close()`` are called around a run where they are given. Nothing stands on the other side that
lands the rig when this program dies, unless the user's device has a watchdog of its own.
"""

from __future__ import annotations

import inspect
import math
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from trms_cli.core.errors import ConfigurationError, SimulationError, TrmsError
from trms_cli.core.invocation import whole_trace
from trms_cli.core.plugins import locate_function, nearest
from trms_cli.core.printable import short_repr
from trms_cli.plants.hardware import HardwareRig, HardwareRun
from trms_cli.plants.plant import PlantSetup

_FUNCTIONS = ("read", "write", "open", "close")


@dataclass(frozen=True, kw_only=True)
class CallableRig(HardwareRig):
    """A rig behind functions: each a dotted name of an allowed package; from Python also itself."""

    read: Any  #: ``read() -> dict``: raw number by channel; NaN where there is none now
    write: Any  #: ``write(dict)``: raw number by channel
    open: Any = None  #: ``open()``, before anything else; None: nothing to do
    close: Any = None  #: ``close()``, after everything else, whatever went before

    def __post_init__(self) -> None:
        for name in _FUNCTIONS:
            self.function(name)
        for name, wire in self.wiring.items():
            if not isinstance(wire.channel, str):
                raise ConfigurationError(
                    f"{wire.channel!r} given",
                    where=f"wiring.{name}.channel",
                    remedy="the key of a dictionary that your functions use, as text: 'pitch'",
                )

    def function(self, name: str) -> Callable[..., Any] | None:
        """What is given for read, write, open or close; None where nothing is.

        Raises ConfigurationError for what is no function of an allowed package.
        """
        given = getattr(self, name)
        if given is None and name in ("open", "close"):
            return None
        if isinstance(given, str):
            return locate_function(given, f"plant.{name}")
        if not callable(given):
            raise ConfigurationError(
                f"{given!r} given",
                where=f"plant.{name}",
                remedy=f"a function of a package of yours: plant.{name}=my_lab.bench.{name}",
            )
        return given

    def init(self, setup: PlantSetup) -> CallableRun:
        """The rig before it is opened.

        Raises ConfigurationError for a wiring that is wrong.
        """
        return CallableRun(self, setup)


class CallableRun(HardwareRun):
    """See :class:`trms_cli.plants.hardware.HardwareRun`."""

    rig: CallableRig

    def __init__(self, rig: CallableRig, setup: PlantSetup) -> None:
        super().__init__(rig, setup)
        self._functions = {name: rig.function(name) for name in _FUNCTIONS}
        self._is_open = self._is_read = False

    def connect(self) -> None:
        """Open the rig, and see that it can be read.

        Raises ConfigurationError for what ``read`` should not return.
        """
        if self._functions["open"] is not None:
            self._call("open")
        self._is_open = True
        self._read()
        self._is_read = True

    def disarm(self) -> None:
        """The safe command once more: nobody else gives it when this program is gone."""
        if self._is_read:
            self.advance(self._safe)

    def close(self, reason: str) -> None:
        """Close what was opened."""
        if self._is_open and self._functions["close"] is not None:
            self._is_open = False
            self._call("close")

    def _read(self) -> Mapping[int | str, float] | None:
        reading = self._call("read")
        if not isinstance(reading, Mapping):
            raise self._wrong_reading(f"returned {short_repr(reading)}, no dictionary")
        raw: dict[int | str, float] = {}
        for name, channel in zip(self._readings.names, self._readings.channels, strict=True):
            if channel not in reading:
                raise self._wrong_reading(
                    f"returned no {channel!r}, the channel of {name}",
                    nearest(str(channel), map(str, reading)).replace("allowed", "it returned"),
                )
            value = reading[channel]
            try:
                if isinstance(value, (str, bytes, bool)):
                    raise TypeError
                raw[channel] = float(value)
            except (TypeError, ValueError):
                raise self._wrong_reading(
                    f"returned {short_repr(value)} for {channel!r}, which is no number"
                ) from None
        return None if all(map(math.isnan, raw.values())) else raw

    def _write(self, raw: Mapping[int | str, float]) -> None:
        self._call("write", dict(raw))

    def _call(self, name: str, *arguments: Any) -> Any:
        """What the user's function returns; its exception in words, with the line it came from."""
        function = self._functions[name]
        assert function is not None
        try:
            return function(*arguments)
        except TrmsError:
            raise
        except Exception as error:
            raise SimulationError(
                f"plant.{name} failed: {type(error).__name__}: {error}",
                where=_own_line(function, error),
                remedy=whole_trace(),
            ) from error

    def _wrong_reading(self, problem: str, remedy: str = "") -> TrmsError:
        channels = ", ".join(f"{channel!r}: …" for channel in self._readings.channels)
        kind = SimulationError if self._is_read else ConfigurationError
        function = self._functions["read"]
        return kind(
            f"plant.read {problem}",
            where=_line_of(function),
            remedy=remedy or f"return a number by channel: {{{channels}}}; NaN where there is none",
        )


def _own_line(function: Callable[..., Any], error: Exception) -> str:
    """File and line of the user's function at which an exception left it."""
    frames = traceback.extract_tb(error.__traceback__)
    code = getattr(inspect.unwrap(function), "__code__", None)
    own = [frame for frame in frames if code is not None and frame.filename == code.co_filename]
    last = (own or frames)[-1]
    return f"{last.filename}, line {last.lineno}, in {last.name}"


def _line_of(function: Callable[..., Any] | None) -> str:
    """Where a function begins; what it is called for one without code of its own."""
    code = getattr(function, "__code__", None)
    if code is None:
        return repr(function)
    return f"{code.co_filename}, line {code.co_firstlineno}, in {code.co_name}"
