"""A function of time as a signal: ``ref={"alpha_h": lambda t: 0.3 * np.sin(t)}``."""

import ast
import inspect
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from textwrap import dedent
from typing import Any

import numpy as np

from trms_cli.core.errors import ConfigurationError, SimulationError
from trms_cli.references.signal import Array


@dataclass(frozen=True, repr=False)
class TimeFunction:
    """``r(t) = function(t)``."""

    #: Of the times, (n,) s, with (n,) values, or of one time with one value
    function: Callable[..., Any]

    def sample(self, times: Array) -> Array:
        """Value at each time, ``times: (n,) s -> (n,)``.

        Raises ConfigurationError if the values are not one for each time. Raises SimulationError if
        the function fails, or gives what is no number: with its file, line and the time.
        """
        times = np.asarray(times, dtype=float)
        try:
            values = np.asarray(self.function(times), dtype=float)
        except Exception:  # of one time only, as most are first written
            values = np.array([self._at(float(time)) for time in times])
        if values.shape not in ((), times.shape):
            raise ConfigurationError(
                f"{self!r} gives values of the shape {values.shape} for times of {times.shape}",
                where="ref",
                remedy="return one value for each time",
            )
        return np.broadcast_to(values, times.shape).copy()

    def _at(self, time: float) -> float:
        """The value at one time; a mistake in the function told with its line."""
        try:
            value = self.function(time)
        except Exception as error:
            from trms_cli.core.invocation import whole_trace

            last = traceback.extract_tb(error.__traceback__)[-1]
            raise SimulationError(
                f"{self!r} failed at {time:.2f} s: {type(error).__name__}: {error}",
                where=f"{last.filename}, line {last.lineno}, in {last.name}",
                remedy=whole_trace(),
            ) from error
        try:
            return float(value)
        except (TypeError, ValueError):
            raise SimulationError(
                f"{self!r} gives {value!r} at {time:.2f} s, which is no number",
                where=_line_of(self.function),
                remedy="return one number for each time",
            ) from None

    def __repr__(self) -> str:
        return f"TimeFunction({_words_of(self.function)})"


def _line_of(function: Callable[..., Any]) -> str:
    """Where a function begins; its name for one without code of its own."""
    code = getattr(function, "__code__", None)
    if code is None:
        return repr(function)
    return f"{code.co_filename}, line {code.co_firstlineno}, in {code.co_name}"


def _words_of(function: Callable[..., Any]) -> str:
    """The name of a function; of a lambda its source, where that can be told from its line's."""
    name = getattr(function, "__name__", type(function).__name__)
    if name != "<lambda>":
        return name
    try:
        tree = ast.parse(dedent(inspect.getsource(function)).strip())
    except (OSError, TypeError, SyntaxError):
        return name
    lambdas = [node for node in ast.walk(tree) if isinstance(node, ast.Lambda)]
    return ast.unparse(lambdas[0]) if len(lambdas) == 1 else name
