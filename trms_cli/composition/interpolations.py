"""Which references a configuration may hold: to keys of itself, and to nothing outside of it.

``${sim.duration}`` and ``${oc.select:KEY,DEFAULT}`` are taken. Others reach out of the experiment:
``${oc.env:NAME}`` would write a secret of the environment into every log. References also multiply:
thirty lines that each name the line above twice stand for a text of a gigabyte. So what they stand
for is measured before anything is resolved.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from trms_cli.core.errors import ConfigurationError

_KEY = r"\.*[\w@]+(?:\.[\w@]+|\[\w+\])*"
_PLAIN = re.compile(rf"\$\{{\s*({_KEY})\s*\}}")
_SELECT = re.compile(
    rf"\$\{{\s*oc\.select\s*:\s*({_KEY})\s*"
    rf"(?:,\s*(?:\$\{{\s*({_KEY})\s*\}}|\{{\}}|\[\]|[^${{}}\[\],]*))?\s*\}}"
)
#: Letters and values that a configuration may stand for; those of an experiment are some 5000.
_MOST = 20_000_000
#: References that lead to references.
_DEEPEST = 30


def check_interpolations(config: Mapping[str, Any]) -> None:
    """Refuse references out of the configuration, in a circle, or to more than there is room for.

    Parameters
    ----------
    config : mapping
        Plain and unresolved.

    Raises
    ------
    ConfigurationError
        It names the key.
    """
    measure = _Measure(config)
    for key, text in _references(config, ()):
        measure.text(text, key, 0)
    measure.node(config, (), 0)


def refuse_outward(text: str, where: str) -> None:
    """Refuse a text with a reference that is no key of the configuration.

    Raises ConfigurationError with what may stand there.
    """
    rest = _PLAIN.sub("", _SELECT.sub("", text))
    if "${" in rest:
        raise ConfigurationError(
            f"{text[:200]!r} refers to something outside of the configuration",
            where=where,
            remedy="write ${KEY} for another key, or ${oc.select:KEY,DEFAULT}; what stands in the "
            "environment is given on the command line: KEY=$NAME",
        )


class _Measure:
    """How much each key stands for, counted once."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        self._known: dict[tuple[str, ...], int] = {}

    def node(self, node: Any, key: tuple[str, ...], depth: int) -> int:
        if key in self._known:
            return self._known[key]
        if isinstance(node, str):
            size = self.text(node, key, depth) if "${" in node else 1 + len(node)
        elif isinstance(node, Mapping):
            inside = (self.node(item, (*key, str(k)), depth) for k, item in node.items())
            size = 1 + sum(inside)
        elif isinstance(node, (list, tuple)):
            size = 1 + sum(self.node(item, (*key, str(i)), depth) for i, item in enumerate(node))
        else:
            size = 1
        if size > _MOST:
            raise ConfigurationError(
                "its references stand for more than there is room for",
                where=".".join(key) or "the configuration",
                remedy="refer to each key once",
            )
        self._known[key] = size
        return size

    def text(self, text: str, key: tuple[str, ...], depth: int) -> int:
        where = ".".join(key)
        refuse_outward(text, where)
        if depth > _DEEPEST:
            raise ConfigurationError(
                f"{text[:200]!r} leads in a circle, or through more than {_DEEPEST} references",
                where=where,
                remedy="give the value where it is used",
            )
        size = len(text)
        for match in (*_SELECT.finditer(text), *_PLAIN.finditer(text)):
            for name in filter(None, match.groups()):
                target = _absolute(name, key)
                size += self.node(_at(self._config, target), target, depth + 1)
        return size


def _references(node: Any, key: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    if isinstance(node, str):
        if "${" in node:
            yield key, node
    elif isinstance(node, Mapping):
        for name, item in node.items():
            yield from _references(item, (*key, str(name)))
    elif isinstance(node, (list, tuple)):
        for index, item in enumerate(node):
            yield from _references(item, (*key, str(index)))


def _absolute(name: str, key: tuple[str, ...]) -> tuple[str, ...]:
    """The key that a reference names; a leading dot is the mapping that it stands in."""
    path = name.lstrip(".")
    parts = tuple(part for part in re.split(r"[.\[\]]+", path) if part)
    dots = len(name) - len(path)
    return (*key[: max(0, len(key) - dots)], *parts) if dots else parts


def _at(config: Any, key: tuple[str, ...]) -> Any:
    for part in key:
        if isinstance(config, Mapping):
            config = config.get(part)
        elif isinstance(config, (list, tuple)) and part.isdigit() and int(part) < len(config):
            config = config[int(part)]
        else:
            return None
    return config
