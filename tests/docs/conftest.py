"""The program in an empty folder, the site that is built once, and a browser to look at it."""

import fcntl
import functools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.program import Program, forgotten, in_process

ROOT = Path(__file__).parents[2]


@pytest.fixture
def trms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Program]:
    """Run ``trms`` in an empty folder, in this process, with the docs' package allowed."""
    monkeypatch.setenv("TRMS_ALLOW", "my_lab")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    with forgotten(tmp_path):
        yield functools.partial(in_process, tmp_path)


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The site, built once for all workers of a test run."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent
    out, said = shared / "site", shared / "site.log"
    with (shared / "site.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not said.exists():
            command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
            command += ["-d", str(shared / "doctrees"), str(ROOT / "docs"), str(out)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=900)
            said.write_text(f"{done.returncode}\n{done.stdout}{done.stderr}", encoding="utf-8")
    code, _, words = said.read_text(encoding="utf-8").partition("\n")
    assert code == "0", f"the site does not build without a warning:\n{words[-6000:]}"
    return out


@pytest.fixture(scope="session")
def worker_id(request: pytest.FixtureRequest) -> str:
    """Name of the process that runs these tests, also where tests run in one."""
    return str(getattr(request.config, "workerinput", {}).get("workerid", "master"))
