"""Plain values of a composed configuration: checked, each with its key in the message."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from trms_cli.core.errors import ConfigurationError

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition


def value_at(config: Any, key: str) -> Any:
    """What stands at a dotted key, None where there is nothing; of an empty key the whole."""
    for name in key.split(".") if key else ():
        config = config.get(name) if isinstance(config, Mapping) else None
    return config


def check_files(config: Mapping[str, Any]) -> None:
    """Refuse what ``out`` and ``picture`` cannot be, before any work is done.

    Raises ConfigurationError for the first key that is wrong.
    """
    check_out(config["out"])
    truth(config["picture"], "picture")


def check_out(out: Any) -> None:
    """Refuse what is neither a folder's name nor null; raises ConfigurationError."""
    if out is not None and not (isinstance(out, str) and out):
        raise ConfigurationError(f"{out!r} given", where="out", remedy="name a folder, or null")


def number(value: Any, where: str) -> float:
    """A finite number from the configuration; raises ConfigurationError if it is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
        raise ConfigurationError(f"{value!r} given", where=where, remedy="give a number")
    return float(value)


def whole_number(value: Any, where: str) -> int:
    """A whole number from zero on from the configuration.

    Raises ConfigurationError if it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ConfigurationError(
            f"{value!r} given", where=where, remedy="give a whole number from 0 on"
        )
    return value


def truth(value: Any, where: str) -> bool:
    """True or false from the configuration; raises ConfigurationError if it is neither."""
    if not isinstance(value, bool):
        raise ConfigurationError(f"{value!r} given", where=where, remedy="true or false")
    return value


def model_of_choice(composition: Composition) -> str:
    """What the model of a configuration is called: its option, or its file as it was typed."""
    node, choice = composition.config["model"], str(composition.choices.get("model"))
    path = node.get("path") if isinstance(node, Mapping) else None
    return path if choice == "from_file" and isinstance(path, str) else choice
