"""What a run asks of its plugins: the methods that it calls, and whose fault a failure was."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from typing import Any

from trms_cli.core.errors import ConfigurationError, SimulationError, TrmsError
from trms_cli.core.invocation import whole_trace

#: The methods of each kind of plugin, by its key in the configuration.
_METHODS = {
    "controller": ("preview", "init", "step"),
    "observer": ("init", "step"),
    "plant": ("init",),
    "ref": ("restricted_to", "sample"),
    "supervisor": ("init",),
}
#: First words of a key that names its place in the whole configuration.
_PLACES = ("model", "plant", "observer", "controller", "ref", "effect", "sim")


def check_contract(plugin: Any, key: str) -> None:
    """Refuse a plugin that lacks a method.

    Raises ConfigurationError: it names the class and what it lacks.
    """
    needed = _METHODS[key]
    lacking = [name for name in needed if not callable(getattr(plugin, name, None))]
    if lacking:
        kind = type(plugin)
        raise ConfigurationError(
            f"{key} {kind.__module__}.{kind.__qualname__} lacks {' and '.join(lacking)}",
            where=f"{key}._target_",
            remedy=f"it needs the methods {', '.join(needed)}: see docs/writing-a-plugin.md",
        )


def plugin_failure(error: Exception, parts: Mapping[str, Any], time: float) -> TrmsError | None:
    """What a plugin has to answer for, in words; None if no plugin was at work.

    ``error``: as it came out of the loop. One that is in words already is returned itself, with the
    plugin's key before the key that it names. ``parts``: the plugins by their key in the
    configuration. ``time``: simulated time that was reached, s.
    """
    key = _at_work(error, parts)
    if isinstance(error, TrmsError):
        first = error.where.partition(".")[0]
        if key is not None and isinstance(error, ConfigurationError) and first not in _PLACES:
            error.where = f"{key}.{error.where}" if error.where else key
        return error
    return None if key is None else _words(error, key, parts[key], time)


def _at_work(error: Exception, parts: Mapping[str, Any]) -> str | None:
    """The key of the plugin that the loop called when the error came."""
    trace = error.__traceback__
    while trace is not None:
        acting = trace.tb_frame.f_locals.get("self")
        for key, part in parts.items():
            if acting is part:
                return key
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
        remedy=whole_trace(),
    )
