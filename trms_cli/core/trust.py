"""Which code a configuration may name: our plugins, and packages that a user allowed.

A configuration, a model file or a log may come from anyone, and ``_target_`` in it names code. So
a name is only followed into

- this program: to classes that are values (frozen dataclasses) or derive from :data:`_BASES`, and
  to the few functions of :data:`_FACTORIES`. None of them does anything but hold or read data;
- a package that the user allowed (:mod:`trms_cli.core.allowed`): to classes and functions that are
  defined in it. What it has imported from elsewhere stays out of reach.

Folders of configuration are never put on Python's module search path: a file ``numpy.py`` in one of
them is not imported by anybody. A package that was allowed is found in them by its name alone.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from trms_cli.core.allowed import allowed_for_good, allowed_for_now
from trms_cli.core.errors import ConfigurationError

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
            raise _refused(target, where)
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


def check_own(found: Any, target: str, where: str) -> None:
    """Refuse what was found under a name and is no plugin of that place.

    Raises ConfigurationError for what was defined elsewhere, and for what is no class and no
    function.
    """
    package = target.partition(".")[0]
    home = str(getattr(found, "__module__", None))
    if home.partition(".")[0] != package or not (inspect.isclass(found) or _is_function(found)):
        raise ConfigurationError(
            f"{target!r} is no class of {package}",
            where=where,
            remedy=f"name a class that is defined in {package} itself, by its own module"
            + (f": {home} is another package" if home not in ("None", package) else ""),
        )
    if package == _OWN and not _is_plugin(found):
        raise _refused(target, where)


def imported(module: str) -> ModuleType:
    """A module that :func:`check_allowed` has let pass.

    Raises ImportError: And whatever the module raises.
    """
    return importlib.import_module(module)


def _is_plugin(found: Any) -> bool:
    if f"{found.__module__}.{found.__qualname__}" in _FACTORIES:
        return True
    if not inspect.isclass(found):
        return False
    if any(f"{base.__module__}.{base.__qualname__}" in _BASES for base in found.__mro__):
        return True
    return dataclasses.is_dataclass(found) and found.__dataclass_params__.frozen  # type: ignore[attr-defined]


def _is_function(found: Any) -> bool:
    return inspect.isfunction(found)


def _refused(target: str, where: str) -> ConfigurationError:
    return ConfigurationError(
        f"{target!r} is no plugin",
        where=where,
        remedy="`trms list` tells which there are; a class of your own lies in a package of yours",
    )


def _config_folder(place: Path) -> Path:
    """The configuration folder that a package was found in, or beside."""
    listed = _folders.places
    return next((folder for folder in listed if place in (folder, folder.parent)), place)
