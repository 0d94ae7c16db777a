"""The program as tests start it: in this process, without its start-up, or as it is installed."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pytest

from trms_cli.cli import main
from trms_cli.core import trust

T = TypeVar("T")
Program = Callable[..., "Done"]
#: The console script that was installed with the package under test.
INSTALLED = Path(sys.executable).with_name("trms")


@dataclass(frozen=True)
class Done:
    """What a command left."""

    returncode: int
    stdout: str
    stderr: str

    @property
    def said(self) -> str:
        """Its message, without the breaks of its lines."""
        return " ".join(self.stderr.split())

    def checked(self, code: int | None) -> Done:
        """It ended with `code` (None: with any), and what went wrong was told in words."""
        assert code in (None, self.returncode), f"{self.returncode}\n{self.stdout}{self.stderr}"
        assert "Traceback" not in self.stderr
        return self


def in_process(folder: Path, *argv: str, code: int | None = 0, **environment: str) -> Done:
    """The program in this process, in a folder; it ends with `code` (None: with any)."""
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    allowed = os.environ.get("TRMS_ALLOW", "")  # `--allow` adds to it for the process
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, value in {"NO_COLOR": "1", "TRMS_ALLOW": allowed, **environment}.items():
            patch.setenv(name, value)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            returned = main(argv)
    done = Done(returned, *(stream.buffer.getvalue().decode() for stream in (out, err)))
    return done.checked(code)


@contextlib.contextmanager
def forgotten(folder: Path) -> Iterator[None]:
    """What the program imports from a folder, or from beside configurations, is forgotten."""
    before, places = set(sys.modules), list(trust._folders.places)
    try:
        yield
    finally:
        added = [folder, *(place for place in trust._folders.places if place not in places)]
        trust._folders.places[:] = places
        for name in set(sys.modules) - before:
            module = sys.modules[name]
            files = [getattr(module, "__file__", None), *getattr(module, "__path__", ())]
            if any(file and Path(file).is_relative_to(each) for file in files for each in added):
                del sys.modules[name]


def installed(folder: Path, *argv: str, code: int | None = 0, **environment: str) -> Done:
    """The program as a person starts it, in a folder; it ends with `code` (None: with any)."""
    done = subprocess.run(
        [str(INSTALLED), *argv],
        cwd=folder,
        env=os.environ | {"NO_COLOR": "1"} | environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=120,
    )
    left = Done(done.returncode, done.stdout, done.stderr)
    return left if "--debug" in argv else left.checked(code)


def loaded_by(code: str, folder: Path, **environment: str) -> set[str]:
    """Modules that a Python of its own has loaded after this code, and their packages."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; import sys; print(*sys.modules, file=sys.stderr)"],
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return {name.partition(".")[0] for name in done.stderr.split()} | {*done.stderr.split()}


def wait_for(condition: Callable[[], T], seconds: float = 60.0) -> T:
    """What `condition` gives as soon as that is true."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError("it did not come to that")
