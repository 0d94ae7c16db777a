"""What is typed after ``trms run``: read, checked against what there is, and put in Hydra's words.

Checked before Hydra starts: a key or an option that does not exist is answered with the nearest
that does. Three forms are ours and rewritten:

- ``model=fit.yaml``: a path chooses the option ``from_file`` with that path, and so does the
  folder of a fit;
- ``effect=yaw_coulomb_friction``: a group that takes several options also takes one;
- ``plant.parameters.k_g=0.05``: the keys of a mapping that is empty in its YAML need no ``+``;
  their names are checked by the plugin that knows them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from trms_cli.composition.catalogue import Groups, Primary, take_config_dirs
from trms_cli.composition.declared_keys import DeclaredKeys, is_path
from trms_cli.composition.model_files import with_model_files
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

#: Keys whose value is a path: quoted for Hydra's grammar, which forbids ``=``, ``(`` and others.
PATH_KEYS = ("out", "file", "path", "real", "resume")

#: What one command draws is a picture, and what another writes is a page with pictures.
_SAME = {"picture": "page", "page": "picture"}

#: First names of the keys of a sweep itself, which ``-m`` takes off (``configs/sweep.yaml``).
_OF_SWEEPS = ("sampler", "launcher", "retries")

#: All options of the composing command; ``--from`` is taken off before.
_OPTIONS = ("--allow", "--cfg", "--config-dir", "--from", "--multirun", "--help", "--debug")
_PLAIN_NAME = re.compile(r"[\w.+-]+(/[\w.+-]+)*")


class Request(NamedTuple):
    """What was asked for on the command line of a composing command."""

    overrides: tuple[str, ...]  #: as typed
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


def read_request(argv: Sequence[str]) -> Request:
    """Split `argv` into overrides and the options that every composing command has.

    Raises ConfigurationError for an unknown option; a command takes its own options off before.
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
        elif word.startswith("-"):
            raise ConfigurationError(
                f"unknown option {word!r}",
                where="the command line",
                remedy=nearest(word, _OPTIONS),
            )
        else:
            overrides.append(word)
    return Request(tuple(overrides), config_dirs, show, multirun)


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


def prepare(request: Request, primary: Primary, groups: Groups) -> list[str]:
    """The overrides in Hydra's words.

    Raises ConfigurationError for an unknown key or option.
    """
    request = request._replace(overrides=with_model_files(request.overrides, primary, groups))
    prepared: list[str] = []
    keys = DeclaredKeys(primary, groups, request.overrides)
    for override in _last_of_each_choice(request, primary, groups):
        if override.key.split(".")[0].split("/")[0] == "hydra":
            raise _hydra_key(override)
        if override.package:
            placed = _placed_choice(override, primary, groups)
            if (placed.key, placed.package[1:]) in keys.places():
                # `+signal@ref.alpha_v=sine` is meant without the plus: the place is there
                placed = placed._replace(prefix=placed.prefix.lstrip("+"))
            prepared.append(str(placed))
            continue
        _check_first_name(override, primary, groups)
        if override.key in primary.defaults:
            prepared += map(str, _choice(override, primary, groups, request.multirun))
        else:
            prepared.append(str(_value(override, keys, request.multirun)))
    return prepared


def _last_of_each_choice(request: Request, primary: Primary, groups: Groups) -> list[Override]:
    """The overrides; of a group that is chosen twice the later choice, as it is with values."""
    kept: list[Override] = []
    for text in request.overrides:
        override = parse(text, groups)
        if override.key in primary.defaults:
            kept = [other for other in kept if other[1:3] != override[1:3]]
        kept.append(override)
    return kept


def _hydra_key(override: Override) -> ConfigurationError:
    return ConfigurationError(
        f"{override}: keys of Hydra's own are not taken",
        where=override.key,
        remedy="a sweep has a sampler and a launcher of its own (`trms list sampler`); the folder "
        "of a run is out=FOLDER",
    )


def _placed_choice(override: Override, primary: Primary, groups: Groups) -> Override:
    """A group that another option includes at a place of its own: ``signal@ref.alpha_v=sine``."""
    if override.key not in groups:
        raise ConfigurationError(
            f"there is no group {override.key!r}",
            where=override.key + override.package,
            remedy=nearest(override.key, groups),
        )
    first = override.package[1:].split(".")[0]
    allowed = {*primary.defaults, *primary.body}
    if first not in allowed:
        raise ConfigurationError(
            f"there is no key {first!r}",
            where=override.key + override.package,
            remedy=nearest(first, allowed),
        )
    if (override.value or "").strip() in ("null", "None", ""):
        # Hydra has no word for taking a choice away that another option makes.
        raise ConfigurationError(
            f"{override.value!r} given, and one of the group {override.key} is wanted",
            where=override.key + override.package,
            remedy=f"there are: {', '.join(groups[override.key])}; what is left out of the command "
            "line is not chosen",
        )
    given = [item.strip("[]") for item in _names(override.value or "") or []]
    for name in (name.strip() for item in given for name in item.split(",")):
        if name and name != "null" and name not in groups[override.key]:
            raise ConfigurationError(
                f"{override.key} has no option {name!r}",
                where=override.key + override.package,
                remedy=nearest(name, groups[override.key]),
            )
    return override


def _check_first_name(override: Override, primary: Primary, groups: Groups) -> None:
    first = override.key.split(".")[0]
    allowed = {*primary.defaults, *primary.body}
    other = _SAME.get(first)
    if first not in allowed and other in allowed:
        raise ConfigurationError(
            f"there is no key {first!r}",
            where=override.key,
            remedy=f"the key is {other}: {override._replace(key=str(other))}",
        )
    if first not in allowed and first in _OF_SWEEPS:
        raise ConfigurationError(
            f"{override} steers a sweep, and this is a single run",
            where=override.key,
            remedy="add -m for a sweep (`trms help sweep`), or leave it out",
        )
    if first not in allowed and override.key in groups:
        raise ConfigurationError(
            f"group {first!r} has no place of its own (given: {override})",
            where=override.key,
            remedy=f"tell for which key: {first}@PLACE=OPTION, as signal@ref.alpha_v=sine",
        )
    if first not in allowed:
        given = "" if override.value is None else f" (given: {override.value})"
        raise ConfigurationError(
            f"there is no key {first!r}{given}",
            where=override.key,
            remedy=nearest(first, allowed),
        )


def _choice(override: Override, primary: Primary, groups: Groups, multirun: bool) -> list[Override]:
    """The choice of a group's option, checked, with paths and single names rewritten."""
    group, value = override.key, override.value
    if override.prefix == "~":
        raise ConfigurationError(
            f"{group} cannot be left out", where=group, remedy=nearest("", groups.get(group, {}))
        )
    if not value:
        raise ConfigurationError(
            f"{group}= names nothing", where=group, remedy=nearest("", groups.get(group, {}))
        )
    # `+ref=sine` is meant as `ref=sine`: the group has its place in the defaults
    override = override._replace(prefix="")
    several = isinstance(primary.defaults[group], list)
    path = value.strip("'\"")
    if is_path(path) and not several and not (multirun and "," in value):
        return _from_file(override, [path], groups)
    names = _names(value)
    if names is None:  # quotes, functions or interpolations: Hydra's to judge
        return [override]
    if value.count("[") != value.count("]"):
        raise ConfigurationError(
            f"a bracket is missing in {value!r}",
            where=group,
            remedy=f"write '{group}=[NAME,NAME]'",
        )
    if several:
        _refuse_twice(group, names)
        override = override._replace(value=_as_lists(group, value, names, multirun))
        names = [name for item in names for name in _names(item.strip("[]")) or []]
    elif any(is_path(name) for name in names):
        return _from_file(override, names, groups)
    for name in names:
        if name == "null" and primary.defaults[group] is None:
            continue
        if name not in groups.get(group, {}):
            raise ConfigurationError(
                f"{group} has no option {name!r}",
                where=group,
                remedy=nearest(name, groups.get(group, {})),
            )
    return [override]


def _names(value: str) -> list[str] | None:
    """The alternatives of a value at its outer commas; None if it is more than plain names."""
    if re.search(r"[\"'(){}$]", value):
        return None
    items = [item.strip() for item in re.findall(r"\[[^\]]*\]|[^,\[\]]+", value)]
    return [item for item in items if item]


def _refuse_twice(group: str, lists: Sequence[str]) -> None:
    """The second of two equal names would replace the first in silence."""
    for item in lists:
        names = _names(item.strip("[]")) or []
        twice = [name for i, name in enumerate(names) if name in names[:i]]
        if twice:
            raise ConfigurationError(
                f"{twice[0]} stands twice in {item}", where=group, remedy="name each once"
            )


def _as_lists(group: str, value: str, names: Sequence[str], multirun: bool) -> str:
    """`a` as `[a]`, and for a sweep `a,b` as `[a],[b]`."""
    plain = [name for name in names if not name.startswith("[")]
    if len(names) > 1 and not multirun:
        raise ConfigurationError(
            f"{value!r} are alternatives",
            where=group,
            remedy=f"write '{group}=[{','.join(plain)}]' for all at once, or add -m to take turns",
        )
    return ",".join(name if name.startswith("[") else f"[{name}]" for name in names)


def _from_file(override: Override, names: Sequence[str], groups: Groups) -> list[Override]:
    group = override.key
    if "from_file" not in groups.get(group, {}):
        raise ConfigurationError(
            f"{override.value!r} is a path, and {group} takes a name",
            where=group,
            remedy=nearest(str(override.value), groups.get(group, {})),
        )
    if not all(is_path(name) for name in names):
        raise ConfigurationError(
            f"{override.value!r} mixes names and paths",
            where=group,
            remedy="sweep over names or over paths, not both",
        )
    for name in names:
        if not Path(name).expanduser().is_file():
            raise ConfigurationError(
                f"there is no file {name!r}",
                where=group,
                remedy="name a YAML that exists, or an option: " + ", ".join(groups.get(group, {})),
            )
    paths = ",".join(quoted(str(Path(name).expanduser())) for name in names)
    chosen = [override._replace(value="from_file"), Override("", f"{group}.path", "", paths)]
    rigs = {_rig_of(Path(name).expanduser()) for name in names}
    if group == "model" and len(rigs) == 1 and "" not in rigs:
        # Before all that was typed, which thus may choose another.
        chosen.insert(0, Override("", "model@model.rig", "", rigs.pop()))
    return chosen


def _rig_of(path: Path) -> str:
    """The rig that a network file names, empty for none; see :mod:`trms_cli.models.narx_file`."""
    try:
        found = re.search(r"^rig:\s*(\w+)\s*(#.*)?$", path.read_text(encoding="utf-8"), re.M)
    except (OSError, UnicodeDecodeError):
        return ""
    return found[1] if found else ""


def _value(override: Override, keys: DeclaredKeys, multirun: bool) -> Override:
    """A value's override, with open mappings opened and paths quoted."""
    parts = override.key.split(".")
    if override.prefix != "~":
        # A group of several options is empty too, while none is chosen; it is not open.
        least = 2 if parts[0] in keys.declared.defaults else 1
        places = (".".join(parts[:n]) for n in range(len(parts), least - 1, -1))
        if any(keys.value(place) == {} for place in places):
            override = override._replace(prefix="++")
    value = override.value
    if parts[-1] in PATH_KEYS and value and not multirun and _needs_quotes(value):
        override = override._replace(value=quoted(value))
    return override


def _needs_quotes(value: str) -> bool:
    return value[0] not in "'\"[{" and "${" not in value and not _PLAIN_NAME.fullmatch(value)


def quoted(value: str) -> str:
    """`value` as a quoted string of Hydra's grammar: a backslash counts as one before a quote."""
    escaped = re.sub(
        r'(\\*)("|\Z)', lambda found: found[1] * 2 + found[2].replace('"', '\\"'), value
    )
    return f'"{escaped}"'
