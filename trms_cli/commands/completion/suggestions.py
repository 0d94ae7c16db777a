"""What tab completion offers for an unfinished command line, from the YAML files alone."""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from trms_cli.cli import COMMANDS, load_command
from trms_cli.composition.catalogue import read_groups, read_primary, take_config_dirs
from trms_cli.composition.checks import DeclaredKeys
from trms_cli.composition.overrides import PATH_KEYS
from trms_cli.core.data_file import RECORDINGS
from trms_cli.core.errors import TrmsError

_OPTIONS_OF_ALL = ("--help", "--help-all", "--debug")
_OPTIONS_OF_COMPOSING = ("--config-dir", "--cfg", "--multirun")
#: Commands whose words are logs, recordings and folders of them.
_OF_LOGS = ("score", "plot", "compare", "report", "import", "export", "watch")
_MOST_RUNS = 8  #: newest ones, offered before anything is typed
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def suggest(line: str) -> list[str]:
    """The words that can stand where the last word of `line`, which ends at the cursor, begins.

    Whole words; one that ends in ``=``, ``.``, ``/``, ``[`` or ``,`` goes on.
    """
    *before, word = (part.lstrip("'\"") for part in re.split(r"\s+", line.lstrip()))
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
    words = _words_of(last, module.HELP) if last.startswith("--") else []
    if words:
        return _starting(word, words)
    if last == "--from":
        return _logs(word)
    if last.startswith("--") and _takes_file(last, module.HELP):
        return _paths(word)
    if command == "completion":
        return _starting(word, module.SCRIPTS)
    if command == "doctor":
        return []
    if command == "list":
        return _of_list(earlier, word)
    if primary is None:
        return _logs(word) if command in _OF_LOGS else _paths(word)
    return _of_overrides(primary, earlier, word)


def _words_of(option: str, help_text: str) -> list[str]:
    """The words that an option takes, where its help has them as ``--format csv|mat``."""
    match = re.search(rf"{option} ([a-z]+(?:\|[a-z]+)+)", help_text)
    return match[1].split("|") if match else []


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
    if {"-m", "--multirun"} & set(rest):
        rest = [text for text in rest if not text.startswith("-")]
        own = read_primary("sweep", config_dirs)
        declared = declared._replace(
            defaults=declared.defaults | own.defaults, body=declared.body | own.body
        )
    groups = read_groups(config_dirs)
    bare = word.lstrip("+~")
    prefix = word[: len(word) - len(bare)]
    key, equals, value = bare.partition("=")
    if not equals:
        keys = DeclaredKeys(declared, groups, rest)
        return [prefix + name for name in _keys_starting(keys, key)]
    several = isinstance(declared.defaults.get(key), list)
    group = key.partition("@")[0]
    if group in groups and (group in declared.defaults or "@" in key):
        offers = _options(groups[group], value, several)
        if "from_file" in groups[group] and not offers:
            offers = _paths(value)
    elif key in ("real", "against"):
        head = "[" if value.startswith("[") else ""
        head += value[len(head) : value.rfind(",") + 1]
        offers = [head + path for path in _logs(value[len(head) :])]
    elif key.split(".")[-1] in PATH_KEYS:
        offers = _paths(value)
    else:
        present = DeclaredKeys(declared, groups, rest).value(key)
        offers = _starting(value, ["true", "false"] if isinstance(present, bool) else [])
    return [f"{prefix}{key}={offer}" for offer in offers]


def _options(options: Iterable[str], value: str, several: bool) -> list[str]:
    """Completions of the last name in ``a``, in ``a,b`` (a sweep) or in ``[a,b`` (several)."""
    head, comma, tail = value.rpartition(",")
    if not comma and value.startswith("["):
        head, tail = "[", value[1:]
    elif comma:
        head += ","
    earlier_names = set(re.split(r"[\[\],]", head))
    if several and not head:
        head = "["
    return [head + name for name in _starting(tail, options) if name not in earlier_names]


def _keys_starting(keys: DeclaredKeys, key: str) -> list[str]:
    """Keys one level down: a leaf ends in ``=``, a mapping in ``.``."""
    *path, last = key.split(".")
    if not path:
        names = [f"{name}=" for name in keys.declared.defaults]
        names += [f"{name}." for name in keys.declared.defaults if name != "experiment"]
        names += [_suggestion(name, value) for name, value in keys.declared.body.items()]
        placed = [f"{group}@{place}=" for group, place in keys.places()] if last else []
        return _starting(last, [*names, *placed])
    if "@" in path[0]:
        return _starting(key, [f"{group}@{place}=" for group, place in keys.places()])
    node = keys.value(".".join(path))
    if not isinstance(node, Mapping):
        return []
    stem = ".".join(path)
    names = [_suggestion(str(name), value) for name, value in node.items() if name[:1] != "_"]
    return [f"{stem}.{name}" for name in _starting(last, names)]


def _suggestion(name: str, value: Any) -> str:
    return f"{name}." if isinstance(value, Mapping) and value else f"{name}="


def _starting(word: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(word)]


def _logs(word: str) -> list[str]:
    """Recordings, logs and folders; before anything is typed the newest runs too."""
    offers = [p for p in _paths(word) if p.endswith("/") or p.lower().endswith(RECORDINGS)]
    if word:
        return offers
    runs = sorted(Path().glob("outputs/*/*/run.mcap"), key=lambda log: log.as_posix())
    return [*(str(log.parent) for log in runs[: -_MOST_RUNS - 1 : -1]), *offers]


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
