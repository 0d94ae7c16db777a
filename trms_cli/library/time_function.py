"""A function of time as a signal: ``ref={"alpha_h": lambda t: 0.3 * np.sin(t)}``."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from textwrap import dedent
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
        return f"TimeFunction({_words_of(self.function)})"


def _words_of(function: Callable[..., Any]) -> str:
    """The name of a function; of a lambda its source, where that can be told from its line's."""
    name = getattr(function, "__name__", type(function).__name__)
    if name != "<lambda>":
        return name
    try:
        tree = ast.parse(dedent(inspect.getsource(function)).strip())
    except (OSError, TypeError, SyntaxError):
        return name
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Lambda)]
    return ast.unparse(found[0]) if len(found) == 1 else name
