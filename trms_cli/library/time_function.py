"""A function of time as a signal: ``ref={"alpha_h": lambda t: 0.3 * np.sin(t)}``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.signal import Array


@dataclass(frozen=True, repr=False)
class TimeFunction:
    """``r(t) = function(t)``.

    Attributes
    ----------
    function : callable
        Of the times, (n,) s, with (n,) values, or of one time with one value.
    """

    function: Callable[..., Any]

    def sample(self, times: Array) -> Array:
        """Value at each time, ``times: (n,) s -> (n,)``.

        Raises
        ------
        ConfigurationError
            If the function does not give a number for each time.
        """
        times = np.asarray(times, dtype=float)
        try:
            values = np.asarray(self.function(times), dtype=float)
        except (TypeError, ValueError):  # of one time only, as most are first written
            values = np.array([self.function(float(time)) for time in times], dtype=float)
        if values.shape not in ((), times.shape):
            raise ConfigurationError(
                f"{self!r} gives values of the shape {values.shape} for times of {times.shape}",
                where="ref",
                remedy="return one value for each time",
            )
        return np.broadcast_to(values, times.shape).copy()

    def __repr__(self) -> str:
        try:
            source = inspect.getsource(self.function).strip()
        except (OSError, TypeError):
            source = ""
        name = getattr(self.function, "__name__", "function")
        return f"TimeFunction({source if source and name == '<lambda>' else name})"
