"""The program in an empty folder, for what the docs tell a person to type."""

import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.program import Program, forgotten, in_process


@pytest.fixture
def trms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Program]:
    """Run ``trms`` in an empty folder, in this process, with the docs' package allowed."""
    monkeypatch.setenv("TRMS_ALLOW", "my_lab")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    with forgotten(tmp_path):
        yield functools.partial(in_process, tmp_path)
