"""How the program was called, for the commands that it tells to type next."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path

_NAME = "trms"


def program() -> str:
    """What to type for this program: its name where the shell finds it, else the way it was called.

    A program that was started as ``.venv/bin/trms`` is on nobody's path, and another ``trms`` may
    be.
    """
    called = Path(sys.argv[0])
    if called.name == "__main__.py":
        return f"{shlex.quote(_relative(sys.executable))} -m trms_cli"
    found = shutil.which(_NAME)
    if called.name != _NAME or (found and Path(found).absolute() == called.absolute()):
        return _NAME
    return shlex.quote(sys.argv[0])


def _relative(executable: str) -> str:
    """A path under the working folder without it, else as it is."""
    path, here = Path(executable), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else executable
