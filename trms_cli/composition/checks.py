"""What is typed, checked against what there is, and put in Hydra's words.

Checked before Hydra starts: a key or an option that does not exist is answered with the nearest
that does. Three forms are ours and rewritten:

- ``model=fit.yaml``: a path chooses the option ``from_file`` with that path, and so does the
  folder of a fit;
- ``effect=yaw_coulomb_friction``: a group that takes several options also takes one;
- ``plant.parameters.k_g=0.05``: the keys of a mapping that is empty in its YAML need no ``+``;
  their names are checked by the plugin that knows them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import Groups, Primary, read_yaml
from trms_cli.composition.laws import EFFECTS, chosen_nodes
from trms_cli.composition.overrides import PATH_KEYS, ComposeRequest, Override, parse, quote_value
from trms_cli.composition.own_names import as_own_signal, takes_own_names
from trms_cli.composition.plain_values import value_at
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import TARGET, nearest, require_known

#: What one command draws is a picture, and what another writes is a page with pictures.
_SAME = {"picture": "page", "page": "picture"}

#: First names of the keys of a sweep itself, which ``-m`` takes off (``configs/sweep.yaml``).
_OF_SWEEPS = ("sampler", "launcher", "retries")

#: The model in the folder of a fit.
MODEL_NAME = "model.yaml"
_GROUP, _KEY = "model", "model="
_YAML = (".yaml", ".yml")
#: Endings of files that are no options: recordings, documents, pages, logs.
_OTHERS = (".json", ".csv", ".mat", ".html", ".mcap", ".png", ".parquet")
_PLACED = re.compile(r"^(?:override\s+)?/?([\w/]+)@([\w.]+)$")
_PLAIN_NAME = re.compile(r"[\w.+-]+(/[\w.+-]+)*")


def prepare(request: ComposeRequest, primary: Primary, groups: Groups) -> list[str]:
    """The overrides in Hydra's words; raises ConfigurationError for an unknown key or option."""
    request = request._replace(overrides=with_model_files(request.overrides, primary, groups))
    prepared: list[str] = []
    keys = DeclaredKeys(primary, groups, request.overrides)
    for override in _last_of_each_choice(request, primary, groups):
        if override.key.split(".")[0].split("/")[0] == "hydra":
            raise ConfigurationError(
                f"{override}: keys of Hydra's own are not taken",
                where=override.key,
                remedy="a sweep has a sampler and a launcher of its own (`trms list sampler`); the "
                "folder of a run is out=FOLDER",
            )
        if override.package:
            placed = as_own_signal(_placed_choice(override, primary, groups), keys)
            if (placed.key, placed.package[1:]) in keys.places():
                # `+signal@ref.alpha_v=sine` is meant without the plus: the place is there
                placed = placed._replace(prefix=placed.prefix.lstrip("+"))
            prepared.append(str(placed))
            continue
        _check_first_name(override, primary, groups)
        if override.key in primary.defaults:
            prepared += map(str, _choice(override, primary, groups, request.multirun))
        else:
            prepared.append(str(prepared_value(override, keys, request.multirun)))
    return prepared


def _last_of_each_choice(
    request: ComposeRequest, primary: Primary, groups: Groups
) -> list[Override]:
    """The overrides; of a group that is chosen twice the later choice, as it is with values."""
    effective_overrides: list[Override] = []
    for text in request.overrides:
        override = parse(text, groups)
        if override.key in primary.defaults:
            effective_overrides = [
                other for other in effective_overrides if other[1:3] != override[1:3]
            ]
        effective_overrides.append(override)
    return effective_overrides


def _placed_choice(override: Override, primary: Primary, groups: Groups) -> Override:
    """A group that another option includes at a place of its own: ``signal@ref.alpha_v=sine``."""
    where = override.key + override.package
    require_known(override.key, groups, f"there is no group {override.key!r}", where)
    first = override.package[1:].split(".")[0]
    if first not in primary.names:
        raise unknown_key(first, None, where, primary.names)
    if (override.value or "").strip() in ("null", "None", ""):
        # Hydra has no word for taking a choice away that another option makes.
        raise ConfigurationError(
            f"{override.value!r} given, and one of the group {override.key} is wanted",
            where=where,
            remedy=f"there are: {', '.join(groups[override.key])}; what is left out of the command "
            "line is not chosen",
        )
    items = [item.strip("[]") for item in plain_names(override.value or "") or []]
    for name in (name.strip() for item in items for name in item.split(",")):
        if name and name != "null":
            _require_option(override.key, name, groups, override.package)
    return override


def _check_first_name(override: Override, primary: Primary, groups: Groups) -> None:
    first = override.key.split(".")[0]
    allowed = primary.names
    if first in allowed:
        return
    other = _SAME.get(first)
    if other in allowed:
        raise ConfigurationError(
            f"there is no key {first!r}",
            where=override.key,
            remedy=f"the key is {other}: {override._replace(key=str(other))}",
        )
    if first in _OF_SWEEPS:
        raise ConfigurationError(
            f"{override} steers a sweep, and this is a single run",
            where=override.key,
            remedy="add -m for a sweep (`trms help sweep`), or leave it out",
        )
    if override.key in groups:
        raise ConfigurationError(
            f"group {first!r} has no place of its own (given: {override})",
            where=override.key,
            remedy=f"tell for which key: {first}@PLACE=OPTION, as signal@ref.alpha_v=sine",
        )
    raise unknown_key(first, override.value, override.key, allowed)


def _choice(override: Override, primary: Primary, groups: Groups, multirun: bool) -> list[Override]:
    """The choice of a group's option, checked, with paths and single names rewritten."""
    group, value = override.key, override.value
    if override.prefix == "~" or not value:
        problem = "cannot be left out" if override.prefix == "~" else "names nothing"
        sign = "" if override.prefix == "~" else "="
        raise ConfigurationError(
            f"{group}{sign} {problem}", where=group, remedy=nearest("", groups.get(group, {}))
        )
    # `+ref=sine` is meant as `ref=sine`: the group has its place in the defaults
    override = override._replace(prefix="")
    several = isinstance(primary.defaults[group], list)
    path = value.strip("'\"")
    if is_path(path) and not several and not (multirun and "," in value):
        return _from_file(override, [path], groups)
    names = plain_names(value)
    if names is None:  # quotes, functions or interpolations: Hydra's to judge
        return [override]
    if value.count("[") != value.count("]"):
        raise ConfigurationError(
            f"a bracket is missing in {value!r}", where=group, remedy=f"write '{group}=[NAME,NAME]'"
        )
    if several:
        _refuse_twice(group, names)
        override = override._replace(value=_as_lists(group, value, names, multirun))
        names = [name for item in names for name in plain_names(item.strip("[]")) or []]
        if group == EFFECTS and (nodes := chosen_nodes(names, groups)) and not multirun:
            return _generated(override, names, nodes, groups)
        names = [name for name in names if group != EFFECTS or name not in nodes]
    elif any(is_path(name) for name in names):
        return _from_file(override, names, groups)
    for name in names:
        if name != "null" or primary.defaults[group] is not None:
            _require_option(group, name, groups)
    return [override]


def _generated(
    override: Override, names: Sequence[str], nodes: Mapping[str, Mapping[str, Any]], groups: Groups
) -> list[Override]:
    """The choice of the options that there are, and a value for each effect that is generated."""
    options = [name for name in names if name not in nodes]
    for name in options:
        _require_option(override.key, name, groups)
    values = []
    for name, node in nodes.items():
        content = ",".join(f"{key}:{json.dumps(value)}" for key, value in node.items())
        values.append(Override("++", f"{override.key}.{name}", "", f"{{{content}}}"))
    return [override._replace(value=f"[{','.join(options)}]"), *values]


def _require_option(group: str, name: str, groups: Groups, package: str = "") -> None:
    problem = f"{group} has no option {name!r}"
    require_known(name, groups.get(group, {}), problem, group + package)


def plain_names(value: str) -> list[str] | None:
    """The alternatives of a value at its outer commas; None if it is more than plain names."""
    if re.search(r"[\"'(){}$]", value):
        return None
    items = [item.strip() for item in re.findall(r"\[[^\]]*\]|[^,\[\]]+", value)]
    return [item for item in items if item]


def _refuse_twice(group: str, lists: Sequence[str]) -> None:
    """The second of two equal names would replace the first in silence."""
    for item in lists:
        names = plain_names(item.strip("[]")) or []
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
    paths = ",".join(quote_value(str(Path(name).expanduser())) for name in names)
    overrides = [override._replace(value="from_file"), Override("", f"{group}.path", "", paths)]
    rigs = {_rig_of(Path(name).expanduser()) for name in names}
    if group == "model" and len(rigs) == 1 and "" not in rigs:
        # Before all that was typed, which thus may choose another.
        overrides.insert(0, Override("", "model@model.rig", "", rigs.pop()))
    return overrides


def _rig_of(path: Path) -> str:
    """The rig that a network file names, empty for none; see :mod:`trms_cli.models.narx_file`."""
    try:
        match = re.search(r"^rig:\s*(\w+)\s*(#.*)?$", path.read_text(encoding="utf-8"), re.M)
    except (OSError, UnicodeDecodeError):
        return ""
    return match[1] if match else ""


def prepared_value(override: Override, keys: DeclaredKeys, multirun: bool) -> Override:
    """A value's override, with open mappings opened and paths quoted."""
    parts = override.key.split(".")
    if override.prefix != "~":
        # A group of several options is empty too, while none is chosen; it is not open.
        least = 2 if parts[0] in keys.declared.defaults else 1
        places = (".".join(parts[:n]) for n in range(len(parts), least - 1, -1))
        if any(keys.value(place) == {} for place in places) or takes_own_names(keys, override.key):
            override = override._replace(prefix="++")
    value = override.value
    if parts[-1] in PATH_KEYS and value and not multirun and _needs_quotes(value):
        override = override._replace(value=quote_value(value))
    return override


def _needs_quotes(value: str) -> bool:
    return value[0] not in "'\"[{" and "${" not in value and not _PLAIN_NAME.fullmatch(value)


def with_model_files(overrides: Sequence[str], primary: Primary, groups: Groups) -> tuple[str, ...]:
    """The overrides with the model's file for a folder that holds one.

    A name that is an option stays one, whatever folders there are.

    Raises ConfigurationError for a folder without a model, and for a file that is none; it tells
    which is near.
    """
    options = groups.get(_GROUP, {})
    if _GROUP not in primary.defaults or "from_file" not in options:
        return tuple(overrides)
    return tuple(
        _with_files(text, options) if text.lstrip("+").startswith(_KEY) else text
        for text in overrides
    )


def with_parameter_sets(argv: Sequence[str], groups: Groups) -> list[str]:
    """The command line with its file for a parameter set that is no model (``tras_record``)."""
    sets, options = groups.get("parameters", {}), groups.get(_GROUP, {})

    def file_of(name: str) -> str:
        return str(sets[name].file) if name in sets and name not in options else name

    replaced = []
    for word in argv:
        head, equals, value = word.partition("=")
        if head.lstrip("+") == _GROUP and equals:
            word = f"{head}={','.join(file_of(name.strip()) for name in value.split(','))}"
        replaced.append(word)
    return replaced


def _with_files(text: str, options: Container[str]) -> str:
    head, _, value = text.partition("=")
    whole = value.strip().strip("'\"")
    if Path(whole).expanduser().exists() and whole not in options:
        return f"{head}={model_file(whole)}"
    names = value.split(",")  # the alternatives of a sweep
    files = [name if name.strip() in options else model_file(name.strip()) for name in names]
    return f"{head}={','.join(files)}"


def model_file(name: str) -> str:
    """The file that a name stands for, or the name where it is none.

    Raises ConfigurationError for a folder without a model, and for a file that is none.
    """
    path = Path(name.strip("'\"")).expanduser()
    if path.is_dir() and name:
        if (path / MODEL_NAME).is_file():
            return str(path / MODEL_NAME)
        raise ConfigurationError(
            f"there is no {MODEL_NAME} in the folder {name!r}",
            where=_GROUP,
            remedy=f"name the folder of a fit (trms identify), or a model's YAML{_near(path)}",
        )
    if path.suffix in _OTHERS or (path.is_file() and path.suffix not in _YAML):
        raise ConfigurationError(
            f"{name!r} is not a model file",
            where=_GROUP,
            remedy=_near(path.parent).removeprefix(": ")
            or "name a model's YAML, the folder of a fit, or an option (`trms list model`)",
        )
    return name


def _near(folder: Path) -> str:
    """A model's file in a folder, asked for in words."""
    if (folder / MODEL_NAME).is_file():
        return f": did you mean {_GROUP}={folder / MODEL_NAME}?"
    return ""


def check_composed(config: Mapping[Any, Any], declared: Primary) -> None:
    """Hydra's ``+`` and an experiment's YAML can add any key: refuse what is not declared."""
    _refuse_unknown(config, declared.names, "")
    for group, option in declared.defaults.items():
        if option is not None and config.get(group) is None:
            raise ConfigurationError(
                f"no {group} is chosen", where=group, remedy=f"`trms list {group}` tells which"
            )
    _check_nested(config, declared.body, "")


def _check_nested(config: Mapping[Any, Any], body: Mapping[str, Any], where: str) -> None:
    for key, default in body.items():
        if not isinstance(default, Mapping) or not default or TARGET in default:
            continue
        place = f"{where}.{key}" if where else key
        if not isinstance(config.get(key), Mapping):
            raise ConfigurationError(
                f"{config.get(key)!r} given",
                where=place,
                remedy=f"set its keys: {', '.join(f'{place}.{name}=…' for name in default)}",
            )
        _refuse_unknown(config[key], default, place)
        _check_nested(config[key], default, place)


def _refuse_unknown(node: Mapping[Any, Any], allowed: Collection[str], where: str) -> None:
    for key, value in node.items():
        if key not in allowed:
            place = f"{where}.{key}" if where else str(key)
            raise unknown_key(str(key), repr(value), place, allowed)


def unknown_key(
    key: str, value_text: str | None, where: str, allowed: Collection[str]
) -> ConfigurationError:
    """A key that is not there, with the nearest that is."""
    value = "" if value_text is None else f" (given: {value_text})"
    return ConfigurationError(
        f"there is no key {key!r}{value}", where=where, remedy=nearest(key, allowed)
    )


def is_path(name: str) -> bool:
    """Whether a choice names a file rather than an option."""
    return name.endswith((".yaml", ".yml")) or name.startswith(("/", "./", "../", "~"))


class DeclaredKeys:
    """Looks keys up under the choices that a command line, `typed`, makes."""

    def __init__(self, declared: Primary, groups: Groups, typed: Sequence[str]) -> None:
        self.declared = declared
        self._groups = groups
        self._typed = {
            override.key + override.package: override.value
            for override in (parse(text, groups) for text in typed if "=" in text[1:])
        }

    def value(self, key: str) -> Any:
        """What stands at a key, None where there is nothing."""
        first, _, rest = key.partition(".")
        in_group = first in self.declared.defaults
        return value_at(self._group(first) if in_group else self.declared.body.get(first), rest)

    def _option_names(self, group: str, place: str = "", default: Any = None) -> list[str]:
        text = self._typed.get(f"{group}@{place}" if place else group)
        if text is not None:
            names = [name for name in re.split(r"[\[\],]", text) if name]
            return ["from_file" if is_path(name.strip("'\"")) else name for name in names]
        return list(default) if isinstance(default, list) else [str(default)] if default else []

    def _group(self, group: str) -> dict[str, Any]:
        node: dict[str, Any] = {}
        for name in self._option_names(group, default=self.declared.defaults[group]):
            node = _merged(node, self._option(group, name, group))
        return node

    def of_option(self, group: str, name: str) -> dict[str, Any]:
        """What the YAML of an option has by itself, empty where there is none."""
        return self._option(group, name, group)

    def _option(self, group: str, name: str, place: str) -> dict[str, Any]:
        """The content of one option with those that its own defaults put inside it."""
        option = self._groups.get(group, {}).get(name)
        content = read_yaml(option.file) if option is not None else None
        if not isinstance(content, dict):
            return {}
        before, after = _beside_self(content)
        body = {key: value for key, value in content.items() if key != "defaults"}
        for base in content.get("defaults") or []:  # another option of the group: plant=ideal
            if isinstance(base, str) and base not in ("_self_", name):
                body = _merged(self._option(group, base, place), body)
        return _merged(_merged(self._inside(before, place), body), self._inside(after, place))

    def _inside(self, entries: Sequence[tuple[str, str, Any]], place: str) -> dict[str, Any]:
        """What entries of a defaults list put inside of the option at a place."""
        inside: dict[str, Any] = {}
        for inner_group, inner_place, default in entries:
            for inner in self._option_names(inner_group, f"{place}.{inner_place}", default):
                node = self._option(inner_group, inner, f"{place}.{inner_place}")
                for step in reversed(inner_place.split(".")):
                    node = {step: node}
                inside = _merged(inside, node)
        return inside

    def places(self) -> list[tuple[str, str]]:
        """Groups that the chosen options include at a place: ``(signal, ref.alpha_v)``."""
        pairs = []
        for group, default in self.declared.defaults.items():
            for name in self._option_names(group, default=default):
                option = self._groups.get(group, {}).get(name)
                content = read_yaml(option.file) if option is not None else None
                if isinstance(content, dict):
                    pairs += [
                        (inner, f"{group}.{place}") for inner, place, _ in defaults_list(content)
                    ]
        return pairs


def defaults_list(content: Mapping[str, Any]) -> list[tuple[str, str, Any]]:
    """``(group, place, option)`` of a YAML's own defaults list."""
    entries = []
    for entry in content.get("defaults") or []:
        for name, option in entry.items() if isinstance(entry, dict) else ():
            match = _PLACED.match(str(name))
            if match:
                entries.append((match[1], match[2], option))
    return entries


def _beside_self(
    content: Mapping[str, Any],
) -> tuple[list[tuple[str, str, Any]], list[tuple[str, str, Any]]]:
    """The entries of a defaults list that the YAML's own keys replace, and those that replace them.

    What stands behind ``_self_`` does: ``model@plant.model=newtonian`` in place of a reference.
    """
    entries = content.get("defaults") or []
    position = entries.index("_self_") if "_self_" in entries else len(entries)
    parts = (entries[:position], entries[position:])
    before, after = (defaults_list({"defaults": part}) for part in parts)
    return before, after


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        present = merged.get(key)
        both = isinstance(present, Mapping) and isinstance(value, Mapping)
        merged[key] = _merged(present, value) if both else value  # type: ignore[arg-type]
    return merged
