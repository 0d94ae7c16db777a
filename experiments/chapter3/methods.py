"""Methods and training algorithms from the program's own configuration, with some keys replaced."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder


def option(group: str, name: str) -> dict[str, Any]:
    """The YAML of an option, without its defaults list."""
    path = config_folder() / group / f"{name}.yaml"
    node = dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    node.pop("defaults", None)
    return node


def method(name: str, training: str, changes: Mapping[str, Any]) -> Any:
    """A method with its training algorithm; mappings in ``changes`` are merged key by key."""
    node = option("method", name) | {"training": option("training", training)}
    for key, value in changes.items():
        node[key] = node[key] | dict(value) if isinstance(value, Mapping) else value
    return build(node, f"method {name}")
