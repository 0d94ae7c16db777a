"""One short run for all tests of the library that only look at it, and a folder to write in."""

from pathlib import Path

import pytest

from trms_cli import Run, run


@pytest.fixture(scope="session")
def lqr(tmp_path_factory) -> Run:
    folder = tmp_path_factory.mktemp("library") / "lqr"
    return run(controller="lqr", ref="sine", sim={"duration": 2}, out=folder)


@pytest.fixture
def here(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path
