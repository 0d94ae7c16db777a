"""Which code a configuration may name: our plugins, and packages that a user allowed.

A configuration, a model file or a log may come from anyone, and ``_target_`` in it names code. So
a name is only followed into

- this program: to classes that are values (frozen dataclasses) or derive from :data:`_BASES`, and
  to the few functions of :data:`_FACTORIES`. None of them does anything but hold or read data;
- a package that the user allowed: to classes and functions that are defined in it. What it has
  imported from elsewhere stays out of reach. For one call such packages stand in the environment
  variable ``TRMS_ALLOW`` (``my_lab,other``), which the option ``--allow`` adds to, so that the
  worker processes of a sweep know them too. For good they stand in ``allowed.json`` in the user's
  configuration folder, which ``trms allow`` writes: each with the folder that it lies in, or as an
  installed one.

C source runs as well where an exported controller drives a rig. Its folder stands in no file: only
the command that names it on its own line allows it, for its process.

Folders of configuration are never put on Python's module search path: a file ``numpy.py`` in one of
them is not imported by anybody. A package that was allowed is found in them by its name alone.
"""

import dataclasses
import importlib
import inspect
import json
import os
import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.whole_file import replace_whole

ENVIRONMENT = "TRMS_ALLOW"
SCHEMA = "trms.allowed/1"
_NAME = re.compile(r"[A-Za-z_]\w*")
_LONGEST = 2**20  # bytes of the file


def allowed_file() -> Path:
    """Where what is allowed for good is kept (``XDG_CONFIG_HOME``)."""
    base = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    return Path(base) / "trms" / "allowed.json"


def allowed_for_now() -> frozenset[str]:
    """Packages that this call may run, wherever they are found."""
    words = re.split(r"[,:;\s]+", os.environ.get(ENVIRONMENT, ""))
    return frozenset(word for word in words if _NAME.fullmatch(word) and _refusal(word) is None)


def allow_for_now(package: str) -> None:
    """Let this process, and those that it starts, run a package.

    Raises ConfigurationError for what is no package's name, and for Python's own library.
    """
    check_name(package)
    os.environ[ENVIRONMENT] = ",".join(sorted({*allowed_for_now(), package}))


def allowed_for_good() -> dict[str, Path | None]:
    """Packages with the folder that they lie in; None for an installed one.

    Raises ConfigurationError if the file is there and is not what ``trms allow`` writes.
    """
    file = allowed_file()
    if not file.is_absolute():  # no home: nothing that lies in the working folder counts
        return {}
    try:
        with file.open("rb") as content:
            document = json.loads(content.read(_LONGEST))
        packages = document["packages"]
        return {
            str(name): None if place is None else Path(str(place))
            for name, place in packages.items()
            if _NAME.fullmatch(str(name)) and _refusal(str(name)) is None
        }
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ConfigurationError(
            f"the list of allowed packages cannot be read: {error}",
            where=str(file),
            remedy="delete the file, and allow again what you need: trms allow PACKAGE",
        ) from error


def write_allowed(packages: Mapping[str, Path | None]) -> None:
    """Keep what is allowed for good.

    Raises OSError if the folder cannot be written.
    """
    file = allowed_file()
    if not file.is_absolute():
        raise OSError("you have no home folder, and XDG_CONFIG_HOME names none")
    file.parent.mkdir(parents=True, exist_ok=True)
    places = {name: None if at is None else str(at) for name, at in sorted(packages.items())}
    text = json.dumps({"schema": SCHEMA, "packages": places}, indent=2, ensure_ascii=False)
    replace_whole(file, f"{text}\n".encode())


#: Folders of exported controllers that this process may compile and run.
_exports: set[Path] = set()


def allow_export(folder: Path) -> None:
    """Let this process compile and run the exported controller in a folder."""
    _exports.add(folder.resolve())


def check_export(folder: Path, where: str) -> None:
    """Refuse C source that whoever typed the command did not name.

    Raises ConfigurationError with the line that runs it.
    """
    if folder.resolve() not in _exports:
        raise ConfigurationError(
            f"the controller in {str(folder)!r} is C source, which this call does not allow to run",
            where=where,
            remedy="if you know whose it is and trust it, drive with it:\n"
            f"  trms rig drive --exported {shlex.quote(str(folder))}\n"
            "another law: controller=newton_mpc observer=ukf",
        )


def check_name(package: str) -> None:
    """Refuse what is no package's name, and what would allow everything.

    Raises ConfigurationError with the name that was meant, where there is one.
    """
    if not _NAME.fullmatch(package):
        first = re.split(r"[.\s/]", package)[0]
        hint = f"the package is named without what is in it: {first}" if first else "name a package"
        raise ConfigurationError(f"{package!r} is no package", where="--allow", remedy=hint)
    refusal = _refusal(package)
    if refusal is not None:
        raise ConfigurationError(
            f"{package} {refusal}", where="--allow", remedy="name the package of your own classes"
        )


def _refusal(package: str) -> str | None:
    if package in sys.stdlib_module_names or package in ("builtins", "site", "sitecustomize"):
        return "is a part of Python: a file that may call it may do anything"
    if package == "trms_cli":
        return "need not be allowed, and its classes are known"
    return None


_OWN = "trms_cli"
#: Our plugins that are no frozen dataclasses derive from one of these.
_BASES = ("trms_cli.models.model.Model", "trms_cli.effects.effect.Effect")
#: Functions of ours that make a plugin.
_FACTORIES = (
    "trms_cli.effects.model_file.load_model",
    "trms_cli.models.narx_file.narx",
    "trms_cli.composition.given_object.object_stand_in",
)


class _Folders:
    """Finds allowed packages in the folders that they may lie in; the last finder to be asked."""

    def __init__(self) -> None:
        self.places: list[Path] = []  # of this process's configuration folders

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if "." in name or path is not None:
            return None
        return PathFinder.find_spec(name, [str(place) for place in self.of(name)])

    def of(self, package: str) -> list[Path]:
        """The folders in which a package may lie."""
        if package in allowed_for_now():
            return self.places
        with suppress(ConfigurationError):  # told where a plugin is named, not on any import
            place = allowed_for_good().get(package)
            return [] if place is None else [place]
        return []


_folders = _Folders()


def look_in(folders: Iterable[Path]) -> None:
    """Let allowed packages lie in configuration folders, or beside them."""
    for folder in folders:
        for place in (folder, folder.parent):
            if place not in _folders.places:
                _folders.places.append(place)
    if _folders not in sys.meta_path:
        sys.meta_path.append(_folders)


def place_of(package: str, folders: Iterable[Path]) -> Path | None:
    """The first of some folders that a package lies in, or beside; None for none."""
    for folder in folders:
        for place in (folder, folder.parent):
            if PathFinder.find_spec(package, [str(place)]) is not None:
                return place
    return None


def check_allowed(target: str, where: str) -> None:
    """Refuse a name outside of this program and of what the user allowed; nothing is imported.

    Raises ConfigurationError with the line that allows the package.
    """
    package, *rest = target.split(".")
    if package == _OWN:
        if "__main__" in rest:
            raise _plugin_error(target, where)
        return
    if package in allowed_for_now():
        return
    if package in allowed_for_good():
        if _folders not in sys.meta_path:
            sys.meta_path.append(_folders)
        return
    if package in sys.stdlib_module_names:
        raise ConfigurationError(
            f"{target!r} is a part of Python, and no plugin",
            where=where,
            remedy="a plugin is a class of trms, or of a package of yours",
        )
    place = place_of(package, _folders.places)
    folder = "" if place is None else f" --config-dir {_config_folder(place)}"
    raise ConfigurationError(
        f"{target!r} is code of the package {package}, which you have not allowed to run",
        where=where,
        remedy="if you know whose it is and trust it, allow it for this call:\n"
        f"  --allow {package}\nor for good:\n  trms allow {package}{folder}",
    )


def check_own(plugin: Any, target: str, where: str) -> None:
    """Refuse what was found under a name and is no plugin of that place.

    Raises ConfigurationError for what was defined elsewhere, and for what is no class and no
    function.
    """
    package = target.partition(".")[0]
    home = str(getattr(plugin, "__module__", None))
    if home.partition(".")[0] != package or not (
        inspect.isclass(plugin) or inspect.isfunction(plugin)
    ):
        raise ConfigurationError(
            f"{target!r} is no class of {package}",
            where=where,
            remedy=f"name a class that is defined in {package} itself, by its own module"
            + (f": {home} is another package" if home not in ("None", package) else ""),
        )
    if package == _OWN and not _is_plugin(plugin):
        raise _plugin_error(target, where)


def import_trusted(module: str) -> ModuleType:
    """A module that :func:`check_allowed` has let pass.

    Raises ImportError: And whatever the module raises.
    """
    return importlib.import_module(module)


def _is_plugin(plugin: Any) -> bool:
    if f"{plugin.__module__}.{plugin.__qualname__}" in _FACTORIES:
        return True
    if not inspect.isclass(plugin):
        return False
    if any(f"{base.__module__}.{base.__qualname__}" in _BASES for base in plugin.__mro__):
        return True
    return dataclasses.is_dataclass(plugin) and plugin.__dataclass_params__.frozen  # type: ignore[attr-defined]


def _plugin_error(target: str, where: str) -> ConfigurationError:
    return ConfigurationError(
        f"{target!r} is no plugin",
        where=where,
        remedy="`trms list` tells which there are; a class of your own lies in a package of yours",
    )


def _config_folder(place: Path) -> Path:
    """The configuration folder that a package was found in, or beside."""
    listed = _folders.places
    return next((folder for folder in listed if place in (folder, folder.parent)), place)
