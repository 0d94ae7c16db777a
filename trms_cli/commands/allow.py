"""``trms allow``: which packages' classes a configuration may name, for good."""

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from trms_cli.commands.plain_options import as_options
from trms_cli.composition.catalogue import take_config_dirs
from trms_cli.composition.rig_folder import rig_folder
from trms_cli.core import trust
from trms_cli.core.errors import EXIT_OK, ConfigurationError, TrmsError
from trms_cli.core.invocation import program
from trms_cli.core.printable import print_json

SUMMARY = "let the classes of a package of yours, or of somebody else's, run"

HELP = """\
usage: trms allow [PACKAGE [--config-dir DIR]…] [--remove PACKAGE] [--json]

  A configuration names classes (`_target_`), and may come from anyone. Those of trms can always
  be named; those of another package only after you have allowed it, because they are programs
  that run with your rights. Without a PACKAGE: what is allowed.

  PACKAGE            an installed one, as Python imports it: my_lab
  --config-dir DIR   or one that lies in a folder of configuration, or beside it; then it is
                     allowed in that place alone, and a namesake elsewhere is not; in the folder
                     of a rig (trms init) its own folders count without being named
  --remove PACKAGE   allow it no longer
  --json             what is allowed as JSON (schema trms.allowed/1)

  For one call: trms run --allow PACKAGE …, or the environment variable TRMS_ALLOW=a,b.

examples
  trms allow my_lab                               it is installed
  trms allow my_lab --config-dir my_lab/configs   it lies beside its configuration
  trms allow                                      what is allowed
"""

_REMOVE = "--remove"


def main(argv: Sequence[str]) -> int:
    """Allow a package, remove one, or tell what is allowed."""
    options = {"json": False, "remove": True, "config-dir": True}
    given = as_options(argv, options)
    folders, rest = take_config_dirs(given)
    only_there = len(rest) != len(given)  # folders were named; else those of a rig's folder
    as_json = "--json" in rest
    words = [word for word in rest if word not in ("--json", "--list")]
    removing = _REMOVE in words or any(word.startswith(f"{_REMOVE}=") for word in words)
    names = [word.removeprefix(f"{_REMOVE}=") for word in words if word != _REMOVE]
    unknown = next((name for name in names if name.startswith("-")), None)
    if unknown is not None:
        raise ConfigurationError(
            f"unknown option {unknown!r}",
            where="trms allow",
            remedy=f"options are --config-dir, {_REMOVE}, --json",
        )
    if removing and not names:
        raise ConfigurationError(
            "no package named", where=_REMOVE, remedy=f"{program()} allow {_REMOVE} PACKAGE"
        )
    packages = trust.allowed_for_good()
    for name in names:
        if removing:
            _remove(name, packages)
        else:
            packages[name] = _package_place(name, folders, only_there)
    if names:
        _keep(packages)
    _tell(packages, as_json=as_json)
    return EXIT_OK


def _package_place(name: str, folders: Sequence[Path], only_there: bool) -> Path | None:
    """Where a package lies; None for an installed one."""
    trust.check_name(name)
    place = trust.place_of(name, folders)
    if place is not None:
        return place
    if only_there:
        raise ConfigurationError(
            f"there is no package {name!r} in {', '.join(map(str, folders))}, nor beside it",
            where="--config-dir",
            remedy=f"a package is a folder {name}/ with an __init__.py, or a file {name}.py",
        )
    if importlib.util.find_spec(name) is None:
        raise ConfigurationError(
            f"no package {name!r} is installed",
            where="trms allow",
            remedy="install it (pip install -e FOLDER), or name the folder of configuration that "
            f"it lies in or beside: {program()} allow {name} --config-dir FOLDER",
        )
    return None


def _remove(name: str, packages: dict[str, Path | None]) -> None:
    if name not in packages:
        raise ConfigurationError(
            f"{name!r} is not allowed",
            where=_REMOVE,
            remedy=f"allowed: {', '.join(packages) or 'nothing'}",
        )
    del packages[name]


def _keep(packages: dict[str, Path | None]) -> None:
    try:
        trust.write_allowed(packages)
    except OSError as error:
        raise TrmsError(
            f"the list cannot be written: {error.strerror or error}",
            where=str(trust.allowed_file()),
            remedy=f"allow it for one call: --allow PACKAGE, or {trust.ENVIRONMENT}=PACKAGE",
        ) from error


def _tell(packages: dict[str, Path | None], *, as_json: bool) -> None:
    now = sorted(trust.allowed_for_now())
    rig = rig_folder()
    waiting = [p for p in (rig.packages if rig else ()) if p not in packages and p not in now]
    if as_json:
        places = {name: None if at is None else str(at) for name, at in sorted(packages.items())}
        document = {"schema": trust.SCHEMA, "packages": places, "for_this_call": now}
        print_json(document)
        return
    if not packages and not now:
        sys.stdout.write("no package but trms itself is allowed\n")
    width = max(map(len, [*packages, *now, *waiting]), default=0) + 2
    for name, place in sorted(packages.items()):
        sys.stdout.write(f"{name:{width}}{'installed' if place is None else f'in {place}'}\n")
    for name in now:
        sys.stdout.write(f"{name:{width}}by {trust.ENVIRONMENT}, wherever it lies\n")
    for name in waiting:
        sys.stdout.write(f"{name:{width}}not allowed, and used here: {program()} allow {name}\n")
