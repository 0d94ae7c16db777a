"""Configurations as the index keeps them: one for runs of the same options, and what others change.

The thousand runs of a sweep have a configuration each, of which a few lines differ. So that not
each is read as YAML, its lines are held against those of the first of the same options: a line
that differs in a plain value after its key is one key that has changed. Only where more differs is
the whole document read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

from trms_cli.core.yaml_data import load_yaml
from trms_cli.scoring.comparison.runs import NO_COORDINATES, flat

#: A line of a block: indentation, key, and a value that stands for itself on this line.
_LINE = re.compile(r"( *)([A-Za-z_][\w@/.]*):(?: ([\w./+-]+))?")
_PLACE = re.compile(r"( *)(?:- )?")


@dataclass(frozen=True)
class BaseConfiguration:
    """The configuration that others are held against."""

    config: str  #: As YAML
    number: int  #: In the index
    lines: list[str] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lines", self.config.splitlines())

    @cached_property
    def flat(self) -> dict[str, str]:
        """Its values by dotted keys."""
        return flat_of(self.config)

    @cached_property
    def _keys(self) -> list[str]:
        """The key of each line that holds one plain value; "" for other lines."""
        keys: list[str] = []
        stems: list[tuple[int, str]] = []  # indentation and dotted key of the blocks around
        for line in self.lines:
            match = _LINE.fullmatch(line)
            place = _PLACE.match(line)
            indent = len(place[0]) if place else 0
            while stems and stems[-1][0] >= indent:
                stems.pop()
            if match is None:
                # nothing below a line that is not understood is, either
                stems.append((indent, ""))
                keys.append("")
                continue
            inside = all(stem for _, stem in stems)
            key = ".".join([*(stem for _, stem in stems[-1:]), match[2]]) if inside else ""
            stems.append((indent, key))
            is_value = bool(key) and match[3] is not None
            keys.append(key if is_value and self.flat.get(key) == _value(match[3]) else "")
        return keys

    def changes(self, config: str) -> dict[str, str | None]:
        """What a configuration has in place of this one's; None for keys that it lacks.

        But for those of which a comparison says nothing.

        Raises yaml.YAMLError if it cannot be read.
        """
        lines = config.splitlines()
        changed = self._changed_lines(lines) if len(lines) == len(self.lines) else None
        if changed is not None:
            return changed
        own = flat_of(config)
        keys = dict.fromkeys([*own, *self.flat])
        return {
            key: own.get(key)
            for key in keys
            if own.get(key) != self.flat.get(key) and key not in NO_COORDINATES
        }

    def _changed_lines(self, lines: list[str]) -> dict[str, str | None] | None:
        """The same line by line; None where more than plain values differ."""
        changed: dict[str, str | None] = {}
        for before, line, key in zip(self.lines, lines, self._keys, strict=True):
            if before == line:
                continue
            if key in NO_COORDINATES and line.partition(":")[0] == before.partition(":")[0]:
                continue
            match, was = _LINE.fullmatch(line), _LINE.fullmatch(before)
            if not key or match is None or was is None or match[3] is None:
                return None
            if (match[1], match[2]) != (was[1], was[2]):
                return None
            value = _value(match[3])
            if value != self.flat[key]:
                changed[key] = value
        return changed


def flat_of(config: str) -> dict[str, str]:
    """A document by dotted keys; empty for one that is no mapping."""
    content = load_yaml(config)
    return flat(content) if isinstance(content, Mapping) else {}


@lru_cache(maxsize=4096)
def _value(text: str) -> str:
    """A plain value as :func:`flat` writes it."""
    return flat({"value": load_yaml(text)})["value"]
