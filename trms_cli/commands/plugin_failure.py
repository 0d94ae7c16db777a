"""Whose fault it was: an exception inside a plugin, as a message that names the plugin."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from typing import Any

from trms_cli.core.errors import SimulationError


def plugin_failure(
    error: Exception, parts: Mapping[str, Any], time: float
) -> SimulationError | None:
    """The failure of a plugin in words; None if no plugin was at work.

    Parameters
    ----------
    error : Exception
        As it came out of the loop.
    parts : dict of str to object
        The plugins by their key in the configuration.
    time : float
        Simulated time that was reached, s.
    """
    trace = error.__traceback__
    while trace is not None:
        acting = trace.tb_frame.f_locals.get("self")
        for key, part in parts.items():
            if acting is part:
                return _words(error, key, part, time)
        trace = trace.tb_next
    return None


def _words(error: Exception, key: str, part: Any, time: float) -> SimulationError:
    kind = type(part)
    last = traceback.extract_tb(error.__traceback__)[-1]
    moment = f"at {time:.2f} s" if time > 0 else "at the start"
    return SimulationError(
        f"the {key} {kind.__module__}.{kind.__qualname__} failed {moment}: "
        f"{type(error).__name__}: {error}",
        where=f"{last.filename}, line {last.lineno}, in {last.name}",
        remedy="the whole trace: add --debug",
    )
