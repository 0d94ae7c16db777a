"""The keys of a YAML with their defaults and comments, as its author wrote them.

A comment behind a key tells its unit first, where it has one (``# s, period of the log``); lines
that hold only a comment in the same column go on with it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import yaml

_ATOM = r"(?:Hz|kHz|rad|rpm|deg|ms|s|min|V|A|N|m|kg|ohm|Ω|J|W|K|°|%|1|nats|samples|sample)"
_POWER = r"(?:\^-?\d|[²³⁴]|\*\*\d)?"
_UNIT = re.compile(rf"(?:√?\(?{_ATOM}{_POWER}\)?(?:[ ·*/]|/√)?)+$")


@dataclass(frozen=True)
class Key:
    """A key of a YAML: its path, default, unit and what it means; all as text."""

    path: str
    default: str
    unit: str
    meaning: str


def keys(file: Path) -> list[Key]:
    """All keys of a YAML in their order, but ``defaults`` and ``_target_``."""
    text = file.read_text(encoding="utf-8")
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if not isinstance(root, yaml.MappingNode):
        return []
    return _mapping(root, text.splitlines(), "", top=True)


def target(file: Path) -> str:
    """The class that a YAML names, empty for none."""
    match = re.search(r"^\s*_target_:\s*([\w.]+)", file.read_text(encoding="utf-8"), re.MULTILINE)
    return match[1] if match else ""


def included(file: Path) -> list[tuple[str, str, str]]:
    """``(group, place inside the option, default)`` of what an option includes."""
    content = yaml.compose(file.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    if not isinstance(content, yaml.MappingNode):
        return []
    found = []
    for name, entries in content.value:
        if name.value != "defaults" or not isinstance(entries, yaml.SequenceNode):
            continue
        for entry in entries.value:
            for key, value in entry.value if isinstance(entry, yaml.MappingNode) else ():
                match = re.match(r"^/?([\w/]+)@([\w.]+)$", key.value)
                if match:
                    plain = value.value if isinstance(value, yaml.ScalarNode) else "none"
                    found.append((match[1], match[2], plain))
    return found


def _mapping(node: yaml.MappingNode, lines: list[str], path: str, *, top: bool) -> list[Key]:
    found: list[Key] = []
    for name, value in node.value:
        if name.value == "_target_" or (top and name.value == "defaults"):
            continue
        place = f"{path}.{name.value}" if path else str(name.value)
        nested = isinstance(value, yaml.MappingNode) and not value.flow_style and value.value
        comment = _comment(name if nested else value, lines, behind_colon=bool(nested))
        if nested:
            if comment:
                found.append(Key(place, "", *_unit(comment)))
            found += _mapping(value, lines, place, top=False)
        else:
            found.append(Key(place, _text(value, lines), *_unit(comment)))
    return found


def _text(node: yaml.Node, lines: list[str]) -> str:
    """A value as it stands in the file."""
    start, end = node.start_mark, node.end_mark
    if start.line == end.line:
        return lines[start.line][start.column : end.column]
    rows = [lines[start.line][start.column :], *lines[start.line + 1 : end.line]]
    if end.line < len(lines):
        rows.append(lines[end.line][: end.column])
    return " ".join(re.sub(r"\s#.*$", "", row).strip() for row in rows).strip()


def _comment(node: yaml.Node, lines: list[str], *, behind_colon: bool) -> str:
    """What is said behind a value (or a key with a mapping beneath it), on all its lines."""
    line, column = node.end_mark.line, node.end_mark.column
    if isinstance(node, yaml.SequenceNode) and not node.flow_style:
        line, column = node.start_mark.line - 1, 0
    if line >= len(lines):
        return ""
    rest = lines[line][column:]
    match = re.match(
        r"\s*:?\s*#\s*(.*)$" if behind_colon else r"[^#]*?\s#\s*(.*)$|\s*#\s*(.*)$", rest
    )
    if match is None:
        return ""
    words = [next(group for group in match.groups() if group is not None)]
    at = lines[line].index("#", column)
    for following in lines[line + 1 :]:
        if following[:at].strip() or not following[at:].startswith("#"):
            break
        words.append(following[at:].lstrip("# ").strip())
    return " ".join(words).strip()


def _unit(comment: str) -> tuple[str, str]:
    """A comment parted into unit and meaning."""
    head = re.match(r"([^,;:]+?)(?:[,;]\s*(.*))?$", comment)
    if head is None or not _UNIT.match(head[1].strip()):
        return "", comment
    return head[1].strip(), head[2] or ""
