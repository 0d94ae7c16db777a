"""The installed program in an empty folder, for what the docs tell a person to type."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Program = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def trms(tmp_path: Path) -> Program:
    """Run ``trms`` as a person would, in an empty folder."""
    script = Path(sys.executable).with_name("trms")
    assert script.is_file(), "install the package first: make setup"

    def run(*argv: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(script), *argv],
            cwd=tmp_path,
            env=os.environ
            | {"NO_COLOR": "1", "TRMS_ALLOW": "my_lab", "XDG_CONFIG_HOME": str(tmp_path)},
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=120,
        )

    return run
