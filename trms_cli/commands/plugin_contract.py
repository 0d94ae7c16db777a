"""Whether a built plugin has the methods that a run calls: asked before the run, not during it."""

from __future__ import annotations

from typing import Any

from trms_cli.core.errors import ConfigurationError

#: The methods of each kind of plugin, by its key in the configuration.
_METHODS = {
    "controller": ("preview", "init", "step"),
    "observer": ("init", "step"),
    "plant": ("init",),
    "ref": ("restricted_to", "sample"),
    "supervisor": ("init",),
}


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
