"""The folder of a rig, which a command that is called inside it finds by itself.

``trms.toml`` in the working folder, or in one above it, names the folders of configuration, the
packages that they take classes from, and the options that count where none is typed::

    config = ["configs"]
    packages = ["my_rig"]

    [defaults]
    model = "my_rig"

It is data and grants nothing: a package that it names runs once the user has allowed it, as ever.
A file of another user is not read, for a folder that everybody writes into may lie above.
``TRMS_CONFIG_DIR`` names folders of configuration in place of the search.
"""

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.invocation import note

FILE = "trms.toml"
ENVIRONMENT = "TRMS_CONFIG_DIR"
_KEYS = ("config", "packages", "defaults")
_LONGEST = 2**16  # bytes of the file


@dataclass(frozen=True)
class RigFolder:
    """What ``trms.toml`` says."""

    file: Path
    config_dirs: tuple[Path, ...]  #: absolute, each there
    packages: tuple[str, ...] = ()  #: that its configurations name
    defaults: Mapping[str, str] = field(default_factory=dict)  #: option by group


def config_dirs() -> tuple[Path, ...]:
    """Folders of configuration that count without being named, absolute.

    Raises ConfigurationError for one that is not there, and for a ``trms.toml`` that is none.
    """
    named = os.environ.get(ENVIRONMENT, "")
    if named:
        base = Path.cwd()
        return tuple(_folder(base, part, ENVIRONMENT) for part in named.split(os.pathsep) if part)
    folder = rig_folder()
    return () if folder is None else folder.config_dirs


def rig_folder() -> RigFolder | None:
    """The nearest ``trms.toml`` in the working folder or above; None where there is none."""
    if os.environ.get(ENVIRONMENT):
        return None
    try:
        here = Path.cwd()
    except FileNotFoundError:  # the working folder was removed
        return None
    for folder in (here, *here.parents):
        file = folder / FILE
        with suppress(OSError):  # a folder above may be closed to us
            if not file.is_file():
                continue
            return _read(file) if _is_ours(file) else None
    return None


def _read(file: Path) -> RigFolder:
    import tomllib

    try:
        with file.open("rb") as content:
            document = tomllib.loads(content.read(_LONGEST).decode())
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"cannot be read: {error}", where=str(file), remedy="mend it, or remove it"
        ) from error
    unknown = next((key for key in document if key not in _KEYS), None)
    if unknown is not None:
        raise ConfigurationError(
            f"unknown key {unknown!r}", where=str(file), remedy=f"there are: {', '.join(_KEYS)}"
        )
    folders = _names(document, "config", file)
    defaults = document.get("defaults", {})
    if not isinstance(defaults, dict) or not all(isinstance(v, str) for v in defaults.values()):
        raise _wrong(file, "defaults", 'an option by group: model = "my_rig"')
    return RigFolder(
        file,
        tuple(_folder(file.parent, name, str(file)) for name in folders),
        tuple(_names(document, "packages", file)),
        defaults,
    )


def _names(document: Mapping[str, Any], key: str, file: Path) -> list[str]:
    names = document.get(key, [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise _wrong(file, key, f'a list of texts: {key} = ["NAME"]')
    return names


def _wrong(file: Path, key: str, wanted: str) -> ConfigurationError:
    return ConfigurationError(
        f"{key} is not as it should be", where=str(file), remedy=f"write {wanted}"
    )


def _folder(base: Path, name: str, where: str) -> Path:
    folder = (base / Path(name).expanduser()).resolve()
    if not folder.is_dir():
        raise ConfigurationError(
            f"there is no folder {str(folder)!r}",
            where=where,
            remedy="name the folder that holds your YAML groups",
        )
    return folder


_left_unread: set[Path] = set()


def _is_ours(file: Path) -> bool:
    """Whether the file is this user's, or the machine's; told once where it is somebody else's."""
    if not hasattr(os, "getuid") or file.stat().st_uid in (os.getuid(), 0):
        return True
    if file not in _left_unread:
        _left_unread.add(file)
        note(
            f"note   {file} is another user's and was not read; where you trust it: "
            f"{ENVIRONMENT}={file.parent / 'configs'} trms …"
        )
    return False
