"""The packages of other people that a user lets run: named for one call, or kept in a file.

For one call they stand in the environment variable ``TRMS_ALLOW`` (``my_lab,other``), which the
option ``--allow`` adds to, so that the worker processes of a sweep know them too. For good they
stand in ``allowed.json`` in the user's configuration folder, which ``trms allow`` writes: each with
the folder that it lies in, or as an installed one.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path

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
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except PermissionError:
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
