"""The keys of a composition as the YAML files of the chosen options have them, without Hydra.

Used where composing would be too slow (tab completion) or too late (rewriting overrides). It
follows choices, lists of choices and options that include others at a place of their own; what
an experiment changes is left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from trms_cli.composition.catalogue import Groups, Primary, read_yaml

_PLACED = re.compile(r"^(?:override\s+)?/?([\w/]+)@([\w.]+)$")


def is_path(name: str) -> bool:
    """Whether a choice names a file rather than an option."""
    return name.endswith((".yaml", ".yml")) or name.startswith(("/", "./", "../", "~"))


class DeclaredKeys:
    """Looks keys up under the choices that a command line makes.

    Parameters
    ----------
    declared : Primary
        What the primary configuration declares.
    groups : dict
        The groups and options that there are.
    typed : sequence of str
        The overrides, for the choices among them.
    """

    def __init__(self, declared: Primary, groups: Groups, typed: Sequence[str]) -> None:
        self.declared = declared
        self._groups = groups
        self._typed = dict(
            text.lstrip("+").split("=", 1) for text in typed if "=" in text and text[0] != "-"
        )

    def value(self, key: str) -> Any:
        """What stands at a key, None where there is nothing."""
        first, *path = key.split(".")
        node: Any = self.declared.body.get(first)
        if first in self.declared.defaults:
            node = self._group(first)
        for name in path:
            node = node.get(name) if isinstance(node, Mapping) else None
        return node

    def _chosen(self, group: str, place: str = "", default: Any = None) -> list[str]:
        text = self._typed.get(f"{group}@{place}" if place else group)
        if text is not None:
            names = [name for name in re.split(r"[\[\],]", text) if name]
            return ["from_file" if is_path(name.strip("'\"")) else name for name in names]
        return list(default) if isinstance(default, list) else [str(default)] if default else []

    def _group(self, group: str) -> dict[str, Any]:
        node: dict[str, Any] = {}
        for name in self._chosen(group, default=self.declared.defaults[group]):
            node = _merged(node, self._option(group, name, group))
        return node

    def _option(self, group: str, name: str, place: str) -> dict[str, Any]:
        """The content of one option with those that its own defaults put inside it."""
        option = self._groups.get(group, {}).get(name)
        content = read_yaml(option.file) if option is not None else None
        if not isinstance(content, dict):
            return {}
        inside: dict[str, Any] = {}
        for inner_group, inner_place, default in included(content):
            for inner in self._chosen(inner_group, f"{place}.{inner_place}", default):
                node = self._option(inner_group, inner, f"{place}.{inner_place}")
                for step in reversed(inner_place.split(".")):
                    node = {step: node}
                inside = _merged(inside, node)
        content.pop("defaults", None)
        return _merged(inside, content)

    def places(self) -> list[tuple[str, str]]:
        """Groups that the chosen options include at a place: ``(signal, ref.alpha_v)``."""
        found = []
        for group, default in self.declared.defaults.items():
            for name in self._chosen(group, default=default):
                option = self._groups.get(group, {}).get(name)
                content = read_yaml(option.file) if option is not None else None
                if isinstance(content, dict):
                    found += [(inner, f"{group}.{place}") for inner, place, _ in included(content)]
        return found


def included(content: Mapping[str, Any]) -> list[tuple[str, str, Any]]:
    """``(group, place, option)`` of a YAML's own defaults list."""
    found = []
    for entry in content.get("defaults") or []:
        for name, option in entry.items() if isinstance(entry, dict) else ():
            match = _PLACED.match(str(name))
            if match:
                found.append((match[1], match[2], option))
    return found


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        present = merged.get(key)
        both = isinstance(present, Mapping) and isinstance(value, Mapping)
        merged[key] = _merged(present, value) if both else value  # type: ignore[arg-type]
    return merged
