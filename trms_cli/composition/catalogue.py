"""What can be chosen: the groups and options in the configuration folders, read at once.

A group is a folder, an option a YAML in it, and the option's first comment line tells what it
is. Neither Hydra nor a plugin's module is imported, so that `list`, a command's help and tab
completion do not wait for them.
"""

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from trms_cli.composition.rig_folder import config_dirs
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.resources import config_folder

_DEFAULT_LINE = re.compile(r"^\s*-\s+(?:optional\s+)?([\w/]+):[^#]*?(?:#\s*(.*))?$")
#: Primary configurations; what an earlier one says of a group counts.
_PRIMARIES = ("run", "identify", "validate", "excite", "stability", "sweep")

#: Groups that the primary configurations do not have: they are chosen inside others.
_INSIDE_OTHERS = {
    "law": "of an effect on any input, axis or output of a model: effect=PORT_LAW",
    "disturbance": "torques on the rig: disturbance@plant.disturbances=NAME",
    "parameters": "values of a model: model.parameter_set=NAME",
    "networks": "trained networks of the models narx_…: model.network=NAME",
    "qp_solver": "of newton_mpc: qp_solver@controller.qp=NAME",
    "shaping": "smooths a reference: shaping@ref.shaping=NAME",
    "training": "of a network: training@method.training=NAME",
    "signal": "what one axis follows: signal@ref.alpha_v=NAME",
    "wiring": "channels, scales and signs of a real rig: wiring@plant.wiring=NAME",
    "landing": "how a rig is brought to rest: landing@plant.landing=NAME",
    "envelope": "what a rig may do: envelope@plant.envelope=NAME",
    "sensors": "how well a rig is measured: sensors@plant.sensors=NAME",
}


class Option(NamedTuple):
    """One YAML of a group."""

    group: str
    name: str
    file: Path
    summary: str  #: first comment line of the file
    source: Path  #: the configuration folder it was found in


Groups = dict[str, dict[str, Option]]


def take_config_dirs(argv: Sequence[str]) -> tuple[tuple[Path, ...], list[str]]:
    """Take every ``--config-dir DIR`` (or ``--config-dir=DIR``) off `argv`, checked.

    Returns (folders, rest); the folders as absolute paths in the order given, those of the rig's
    folder that we are in after them (:mod:`.rig_folder`), and what is left of `argv`.
    """
    typed, rest = take_option(argv, "--config-dir", "-cd")
    return tuple(dict.fromkeys((*map(_checked_folder, typed), *config_dirs()))), rest


def take_allowed(argv: Sequence[str]) -> list[str]:
    """Take every ``--allow PACKAGE`` (or ``--allow=PACKAGE``) off `argv`, and allow it for now.

    Raises ConfigurationError if it names no package.
    """
    from trms_cli.core.trust import allow_for_now

    packages, rest = take_option(argv, "--allow")
    for named in packages:
        for package in named.split(","):
            allow_for_now(package.strip())
    return rest


def take_option(argv: Sequence[str], *names: str) -> tuple[list[str], list[str]]:
    """Take every ``NAME VALUE`` and ``NAME=VALUE`` off `argv`: the values, and what is left."""
    values: list[str] = []
    rest: list[str] = []
    words = iter(argv)
    for word in words:
        name, equals, value = word.partition("=")
        if name in names:
            values.append(value if equals else next(words, ""))
        else:
            rest.append(word)
    return values, rest


def _checked_folder(text: str) -> Path:
    where = "--config-dir"
    if not text:
        raise ConfigurationError(
            "no folder given", where=where, remedy="write --config-dir FOLDER_WITH_YAML_GROUPS"
        )
    folder = Path(text).expanduser().resolve()
    if not folder.is_dir():
        kind = "is no folder" if folder.exists() else "does not exist"
        raise ConfigurationError(
            f"{text!r} {kind}", where=where, remedy="name the folder that holds your YAML groups"
        )
    if next(folder.glob("*/**/*.yaml"), None) is None:
        raise ConfigurationError(
            f"{text!r} holds no group: no folder in it has a YAML",
            where=where,
            remedy="name the folder above the groups: DIR in DIR/controller/mine.yaml",
        )
    return folder


def make_importable(folders: Iterable[Path]) -> None:
    """Let ``_target_`` name an allowed package that lies in a configuration folder or beside it.

    What is installed wins. What was not allowed stays data, wherever it lies.
    """
    from trms_cli.core.trust import look_in

    look_in(folders)


def roots(config_dirs: Sequence[Path] = ()) -> tuple[Path, ...]:
    """The configuration folders; an option in an earlier one hides its namesake in a later one."""
    return (*config_dirs, config_folder())


def read_groups(config_dirs: Sequence[Path] = ()) -> Groups:
    """All groups with their options, both sorted by name."""
    groups: Groups = {}
    for root in roots(config_dirs):
        for folder, subfolders, files in os.walk(root):
            subfolders[:] = sorted(name for name in subfolders if name[0] not in "._")
            group = Path(folder).relative_to(root).as_posix()
            if group == "." or group.split("/")[0] == "hydra":
                continue
            for file in files:
                name, suffix = os.path.splitext(file)
                if suffix != ".yaml" or name in groups.get(group, {}):
                    continue
                path = Path(folder, file)
                groups.setdefault(group, {})[name] = Option(
                    group, name, path, first_comment(path), root
                )
    return {group: dict(sorted(groups[group].items())) for group in sorted(groups)}


def first_comment(file: Path) -> str:
    """The first comment line of a YAML that is not a directive to Hydra."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            text = line.strip()
            if text.startswith("#"):
                text = text.lstrip("# ").strip()
                if text and not text.startswith("@package"):
                    return text
            elif text:
                break
    return ""


def primary_file(primary: str, config_dirs: Sequence[Path] = ()) -> Path:
    """The YAML that a command composes from, e.g. ``run.yaml``."""
    for root in roots(config_dirs):
        file = root / f"{primary}.yaml"
        if file.is_file():
            return file
    raise ConfigurationError(
        f"the primary configuration {primary}.yaml is missing",
        where=str(config_folder()),
        remedy="the installation is incomplete: install trms again",
    )


def read_yaml(file: Path) -> Any:
    """The content of a YAML as plain data; a syntax error names the file and the line."""
    import yaml

    from trms_cli.core.data_file import read_bytes
    from trms_cli.core.yaml_data import MOST_BYTES, load_yaml

    try:
        return load_yaml(read_bytes(file, MOST_BYTES))
    except yaml.YAMLError as error:
        raise yaml_error(error, file) from None


def yaml_error(error: Exception, file: Path | None = None) -> ConfigurationError:
    """A YAML syntax error as one that names file, line and problem."""
    mark = getattr(error, "problem_mark", None)
    place = str(file) if file is not None else str(getattr(mark, "name", "a YAML file"))
    if mark is not None:
        place += f", line {mark.line + 1}, column {mark.column + 1}"
    return ConfigurationError(
        f"not valid YAML: {getattr(error, 'problem', None) or error}",
        where=place,
        remedy="mend the line; indent with spaces, and quote text that holds a colon or a brace",
    )


class Primary(NamedTuple):
    """What a primary configuration declares."""

    defaults: dict[str, Any]  #: group → default option (a list: several at once; None: none)
    about: dict[str, str]  #: group → the comment on its line of the defaults
    body: dict[str, Any]  #: the keys that are no group, with their defaults

    @property
    def names(self) -> set[str]:
        """First names of all of its keys."""
        return {*self.defaults, *self.body}


def read_primary(primary: str, config_dirs: Sequence[Path] = ()) -> Primary:
    """The defaults list and the own keys of a primary configuration."""
    file = primary_file(primary, config_dirs)
    content = dict(read_yaml(file) or {})
    entries = [entry for entry in content.pop("defaults", []) if isinstance(entry, dict)]
    defaults = {
        str(group).removeprefix("optional "): option
        for entry in entries
        for group, option in entry.items()
    }
    about: dict[str, str] = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        match = _DEFAULT_LINE.match(line)
        if match and match[1] in defaults:
            about.setdefault(match[1], match[2] or "")
    return Primary(defaults, about, content)


def find_group(groups: Groups, name: str) -> dict[str, Option]:
    """The options of a group.

    Raises ConfigurationError if there is no such group; it names the nearest.
    """
    from trms_cli.core.plugins import require_known

    require_known(name, groups, f"there is no group {name!r}", "trms list")
    return groups[name]


def find_option(groups: Groups, group: str, name: str) -> Option:
    """An option of a group; raises ConfigurationError if there is none; it names the nearest."""
    from trms_cli.core.plugins import require_known

    options = find_group(groups, group)
    require_known(name, options, f"group {group} has no option {name!r}", "trms list")
    return options[name]


def about(config_dirs: Sequence[Path]) -> dict[str, str]:
    """What each group is for, as the primary configurations' defaults tell it."""
    about = dict(_INSIDE_OTHERS)
    for primary in reversed(_PRIMARIES):
        if (config_folder() / f"{primary}.yaml").is_file():
            about |= read_primary(primary, config_dirs).about
    return about
