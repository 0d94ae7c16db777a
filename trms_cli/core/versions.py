"""Versions of the program and of what it computes with, for the records of what is written."""

import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from trms_cli import __version__

#: Packages whose version may change a figure of a run.
_COMPUTING_PACKAGES = ("numpy", "scipy", "casadi", "daqp", "osqp", "hydra-core", "mcap")


def versions() -> dict[str, str]:
    """Versions of what computes, by package."""
    return dict(_versions())


def changed_since(then: Mapping[str, str]) -> list[str]:
    """Those that differ from the versions of a record: ``numpy 1.26.4 → 2.1.0``."""
    here = versions()
    return [
        f"{name} {version} → {here.get(name, 'absent')}"
        for name, version in then.items()
        if here.get(name) != version
    ]


@cache
def _versions() -> dict[str, str]:
    """They stay the same while the process lives."""
    versions = {"trms": __version__, "python": platform.python_version()}
    for package in _COMPUTING_PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions
