"""What tab completion offers for an unfinished command line, from the YAML files alone."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from trms_cli.cli import COMMANDS, load_command
from trms_cli.commands.catalogue import (
    Groups,
    Primary,
    read_groups,
    read_primary,
    read_yaml,
    take_config_dirs,
)
from trms_cli.commands.overrides import PATH_KEYS
from trms_cli.core.errors import TrmsError

_OPTIONS_OF_ALL = ("--help", "--debug")
_OPTIONS_OF_COMPOSING = ("--config-dir", "--cfg", "--multirun")
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
_PLACED = re.compile(r"^(?:override\s+)?/?([\w/]+)@([\w.]+)$")


def suggest(line: str) -> list[str]:
    """The words that can stand where the last word of `line` begins.

    Parameters
    ----------
    line : str
        The command line up to the cursor, the program's name included.

    Returns
    -------
    list of str
        Whole words; one that ends in ``=``, ``.``, ``/``, ``[`` or ``,`` goes on.
    """
    *before, word = re.split(r"\s+", line.lstrip())
    before = before[1:]
    if not before:
        return _starting(word, [*COMMANDS, "--help", "--version"])
    command, *earlier = before
    if command not in COMMANDS:
        return []
    if command == "help":
        return _starting(word, COMMANDS)
    try:
        module = load_command(command)
        return _of_command(command, module, earlier, word)
    except (TrmsError, ImportError, OSError):
        return []  # the command itself tells what is wrong; a press of tab does not


def _of_command(command: str, module: Any, earlier: Sequence[str], word: str) -> list[str]:
    last = earlier[-1] if earlier else ""
    if last in ("--config-dir", "-cd"):
        return [path for path in _paths(word) if path.endswith("/")]
    if last == "--cfg":
        return _starting(word, ["job"])
    primary = getattr(module, "COMPOSES", None)
    if word.startswith("-"):
        own = _OPTION.findall(module.HELP)
        more = _OPTIONS_OF_COMPOSING if primary else ()
        return _starting(word, sorted({*own, *more, *_OPTIONS_OF_ALL}))
    if last.startswith("--") and _takes_file(last, module.HELP):
        return _paths(word)
    if command == "completion":
        return _starting(word, module.SCRIPTS)
    if command == "doctor":
        return []
    if command == "list":
        return _of_list(earlier, word)
    if primary is None:
        return _paths(word)
    return _of_overrides(primary, earlier, word)


def _takes_file(option: str, help_text: str) -> bool:
    return re.search(rf"{option}[ =](?:FILE|LOG|DIR|FOLDER|OUT|PATH)", help_text) is not None


def _of_list(earlier: Sequence[str], word: str) -> list[str]:
    config_dirs, rest = take_config_dirs(earlier)
    groups = read_groups(config_dirs)
    names = [text for text in rest if not text.startswith("-")]
    return _starting(word, groups if not names else groups.get(names[0], {}))


def _of_overrides(primary: str, earlier: Sequence[str], word: str) -> list[str]:
    config_dirs, rest = take_config_dirs(earlier)
    declared = read_primary(primary, config_dirs)
    groups = read_groups(config_dirs)
    bare = word.lstrip("+~")
    prefix = word[: len(word) - len(bare)]
    key, equals, value = bare.partition("=")
    if not equals:
        keys = _Keys(declared, groups, rest)
        return [prefix + name for name in keys.starting(key)]
    several = isinstance(declared.defaults.get(key), list)
    group = key.partition("@")[0]
    if group in groups and (group in declared.defaults or "@" in key):
        offers = _options(groups[group], value, several)
        if "from_file" in groups[group] and not offers:
            offers = _paths(value)
    elif key.split(".")[-1] in PATH_KEYS:
        offers = _paths(value)
    else:
        present = _Keys(declared, groups, rest).value(key)
        offers = _starting(value, ["true", "false"] if isinstance(present, bool) else [])
    return [f"{prefix}{key}={offer}" for offer in offers]


def _options(options: Iterable[str], value: str, several: bool) -> list[str]:
    """Completions of the last name in ``a``, in ``a,b`` (a sweep) or in ``[a,b`` (several)."""
    head, comma, tail = value.rpartition(",")
    if not comma and value.startswith("["):
        head, tail = "[", value[1:]
    elif comma:
        head += ","
    taken = set(re.split(r"[\[\],]", head))
    if several and not head:
        head = "["
    return [head + name for name in _starting(tail, options) if name not in taken]


class _Keys:
    """The keys of a composition, as the YAML files of the chosen options have them."""

    def __init__(self, declared: Primary, groups: Groups, typed: Sequence[str]) -> None:
        self._declared = declared
        self._groups = groups
        self._typed = dict(
            text.lstrip("+").split("=", 1) for text in typed if "=" in text and text[0] != "-"
        )

    def starting(self, key: str) -> list[str]:
        """Keys one level down: a leaf ends in ``=``, a mapping in ``.``."""
        *path, last = key.split(".")
        if not path:
            names = [f"{name}=" for name in self._declared.defaults]
            names += [f"{name}." for name in self._declared.defaults if name != "experiment"]
            names += [self._shown(name, value) for name, value in self._declared.body.items()]
            placed = [f"{group}@{place}=" for group, place in self._places()] if last else []
            return _starting(last, [*names, *placed])
        if "@" in path[0]:
            return _starting(key, [f"{group}@{place}=" for group, place in self._places()])
        node = self.value(".".join(path))
        if not isinstance(node, Mapping):
            return []
        stem = ".".join(path)
        names = [self._shown(str(name), value) for name, value in node.items() if name[:1] != "_"]
        return [f"{stem}.{name}" for name in _starting(last, names)]

    def value(self, key: str) -> Any:
        """What stands at a key, None where there is nothing."""
        first, *path = key.split(".")
        node: Any = self._declared.body.get(first)
        if first in self._declared.defaults:
            node = self._group(first)
        for name in path:
            node = node.get(name) if isinstance(node, Mapping) else None
        return node

    @staticmethod
    def _shown(name: str, value: Any) -> str:
        return f"{name}." if isinstance(value, Mapping) and value else f"{name}="

    def _chosen(self, group: str, place: str = "", default: Any = None) -> list[str]:
        text = self._typed.get(f"{group}@{place}" if place else group)
        if text is not None:
            return [name for name in re.split(r"[\[\],]", text) if name]
        return list(default) if isinstance(default, list) else [str(default)] if default else []

    def _group(self, group: str) -> dict[str, Any]:
        node: dict[str, Any] = {}
        for name in self._chosen(group, default=self._declared.defaults[group]):
            node = _merged(node, self._option(group, name, group))
        return node

    def _option(self, group: str, name: str, place: str) -> dict[str, Any]:
        """The content of one option with those that its own defaults put inside it."""
        option = self._groups.get(group, {}).get(name)
        content = read_yaml(option.file) if option is not None else None
        if not isinstance(content, dict):
            return {}
        inside: dict[str, Any] = {}
        for inner_group, inner_place, default in _included(content):
            for inner in self._chosen(inner_group, f"{place}.{inner_place}", default):
                node = self._option(inner_group, inner, f"{place}.{inner_place}")
                for step in reversed(inner_place.split(".")):
                    node = {step: node}
                inside = _merged(inside, node)
        content.pop("defaults", None)
        return _merged(inside, content)

    def _places(self) -> list[tuple[str, str]]:
        """Groups that the chosen options include at a place: ``(signal, ref.alpha_v)``."""
        found = []
        for group, default in self._declared.defaults.items():
            for name in self._chosen(group, default=default):
                option = self._groups.get(group, {}).get(name)
                content = read_yaml(option.file) if option is not None else None
                if isinstance(content, dict):
                    found += [(inner, f"{group}.{place}") for inner, place, _ in _included(content)]
        return found


def _included(content: Mapping[str, Any]) -> list[tuple[str, str, Any]]:
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


def _starting(word: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(word)]


def _paths(word: str) -> list[str]:
    """Files and folders, a folder with a slash behind it."""
    folder, name = os.path.split(word)
    place = Path(folder or ".").expanduser()
    try:
        entries = sorted(place.iterdir())
    except OSError:
        return []
    stem = f"{folder.rstrip('/')}/" if folder else ""
    return [
        f"{stem}{entry.name}{'/' if entry.is_dir() else ''}"
        for entry in entries
        if entry.name.startswith(name) and (name or not entry.name.startswith("."))
    ]
