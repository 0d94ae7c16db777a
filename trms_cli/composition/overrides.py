"""The language of overrides: ``controller=pid``, ``+key@place=value``, and the options around them.

What is typed after a composing command is read here (:func:`read_request`), each override is taken
apart here (:func:`parse`), and values are written here (:func:`quote_value`). Whether a key exists
is :mod:`trms_cli.composition.checks`'.
"""

import re
import shlex
from collections.abc import Container, Sequence
from pathlib import Path
from typing import NamedTuple

from trms_cli.composition.catalogue import (
    Groups,
    Option,
    read_groups,
    read_primary,
    read_yaml,
    take_config_dirs,
)
from trms_cli.composition.rig_folder import rig_folder
from trms_cli.core.deprecation import present_override
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.invocation import program
from trms_cli.core.plugins import nearest

#: Keys whose value is a path: quoted for Hydra's grammar, which forbids ``=``, ``(`` and others.
PATH_KEYS = ("out", "file", "path", "real", "resume")

#: All options of the composing command; ``--from`` is taken off before.
_OPTIONS = ("--allow", "--cfg", "--config-dir", "--from", "--multirun", "--help", "--debug")


class ComposeRequest(NamedTuple):
    """What was asked for on the command line of a composing command."""

    overrides: tuple[str, ...]  #: as typed, former names replaced by the present ones
    config_dirs: tuple[Path, ...]
    show: bool  #: ``--cfg job``: print the configuration and stop
    multirun: bool  #: ``-m``


class Override(NamedTuple):
    """``[+|++|~]key[@package]=value``, the value still as text (None for ``~key``)."""

    prefix: str
    key: str
    package: str
    value: str | None

    def __str__(self) -> str:
        value = "" if self.value is None else f"={self.value}"
        return f"{self.prefix}{self.key}{self.package}{value}"


def read_request(argv: Sequence[str], primary: str = "run") -> ComposeRequest:
    """Split `argv` into overrides and the options that every composing command has.

    ``--out DIR`` is taken as ``out=DIR``, as the commands without overrides have it.

    Raises ConfigurationError for an unknown option, with the line to type where it is a key; a
    command takes its own options off before.
    """
    config_dirs, rest = take_config_dirs(argv)
    overrides: list[str] = []
    show = multirun = False
    words = iter(rest)
    for word in words:
        if word in ("-m", "--multirun"):
            multirun = True
        elif word in ("--cfg", "-c") or word.startswith("--cfg="):
            what = word.partition("=")[2] or next(words, "job")
            if what != "job":
                raise ConfigurationError(
                    f"{what!r} cannot be shown", where="--cfg", remedy="write --cfg job"
                )
            show = True
        elif word == "--out" or word.startswith("--out="):
            folder = word.partition("=")[2] or next(words, "")
            if not folder or folder.startswith("-"):
                raise ConfigurationError(
                    "no folder given", where="--out", remedy="write --out FOLDER, or out=FOLDER"
                )
            overrides.append(f"out={folder}")
        elif word.startswith("-"):
            raise _unknown_option(word, list(argv), primary, config_dirs)
        else:
            overrides.append(present_override(word))
    return ComposeRequest(tuple(overrides), config_dirs, show, multirun)


def default_words(argv: Sequence[str], primary: str) -> list[str]:
    """The rig's own options as words, for the groups in which `argv` chooses none."""
    folder = rig_folder()
    if folder is None or not folder.defaults:
        return []
    dirs, words = take_config_dirs(argv)
    declared = read_primary(primary, dirs).defaults
    groups = read_groups(dirs)
    unknown = next((group for group in folder.defaults if group not in groups), None)
    if unknown is not None:
        raise ConfigurationError(
            f"there is no group {unknown!r}",
            where=f"{folder.file}, defaults",
            remedy=nearest(unknown, groups),
        )
    chosen = {word.lstrip("+~").partition("=")[0] for word in words}
    for word in words:
        if word.startswith("experiment="):
            chosen |= _choices_of(groups.get("experiment", {}).get(word.partition("=")[2]))
    return [
        f"{group}={option}"
        for group, option in folder.defaults.items()
        if group in declared and group not in chosen
    ]


def _choices_of(experiment: Option | None) -> set[str]:
    """Groups in which a scenario chooses an option."""
    if experiment is None:
        return set()
    entries = (read_yaml(experiment.file) or {}).get("defaults", [])
    keys = (key for entry in entries if isinstance(entry, dict) for key in entry)
    return {str(key).removeprefix("override").strip().lstrip("/") for key in keys}


def _unknown_option(
    word: str, argv: list[str], primary: str, config_dirs: Sequence[Path]
) -> ConfigurationError:
    """A key that was typed as an option is answered with the whole line as it is typed here."""
    declared = read_primary(primary, config_dirs)
    keys = declared.names
    if {"-m", "--multirun"} & set(argv):
        keys |= read_primary("sweep", config_dirs).names
    corrected = _as_overrides(argv, keys)
    if word in corrected:
        return ConfigurationError(
            f"unknown option {word!r}", where="the command line", remedy=nearest(word, _OPTIONS)
        )
    name, _, _ = word.lstrip("-").partition("=")
    line = shlex.join([primary.replace("_", "-"), *corrected])
    return ConfigurationError(
        f"{name} is no option, but a key",
        where=word,
        remedy=f"keys are written KEY=VALUE, without dashes:\n  {program()} {line}",
    )


def _as_overrides(argv: Sequence[str], keys: Container[str]) -> list[str]:
    """The words with each ``--KEY VALUE`` and ``--KEY=VALUE`` of a known key as ``KEY=VALUE``."""
    corrected: list[str] = []
    words = list(argv)
    while words:
        word = words.pop(0)
        key, equals, value = word.removeprefix("--").partition("=")
        first = re.split(r"[.@]", key)
        is_key = first[0] in keys or (len(first) > 1 and "@" in key and first[1] in keys)
        if not word.startswith("--") or not is_key:
            corrected.append(word)
            continue
        if not equals:
            value = (
                words.pop(0) if words and words[0][:1] != "-" and "=" not in words[0] else "VALUE"
            )
        corrected.append(f"{key}={value}")
    return corrected


def parse(text: str, groups: Groups) -> Override:
    """Take one override apart.

    Raises ConfigurationError if it is no ``key=value``; an option's bare name is answered with its
    group.
    """
    body = text.lstrip("+") if text.startswith("+") else text.removeprefix("~")
    prefix = text[: len(text) - len(body)]
    key, equals, value = body.partition("=")
    if not equals and prefix != "~":
        homes = [group for group, options in groups.items() if text in options]
        remedy = f"did you mean {homes[0]}={text}?" if homes else "write KEY=VALUE"
        raise ConfigurationError(
            f"{text!r} is no override", where="the command line", remedy=remedy
        )
    key, at, package = key.strip().partition("@")
    if not key:
        raise ConfigurationError(
            f"{text!r} names no key", where="the command line", remedy="write KEY=VALUE"
        )
    return Override(prefix, key, at + package, value if equals else None)


def quote_value(value: str) -> str:
    """`value` as a quoted string of Hydra's grammar: a backslash counts as one before a quote."""
    escaped = re.sub(
        r'(\\*)("|\Z)', lambda match: match[1] * 2 + match[2].replace('"', '\\"'), value
    )
    return f'"{escaped}"'
