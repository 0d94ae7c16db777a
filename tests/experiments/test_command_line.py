"""What studies share when they are called from a shell."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import pytest

ROOT = Path(__file__).parents[2]
STUDY = """\
import os, sys, time
from pathlib import Path

from experiments.command_line import side_by_side


def work(folder):
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(120)


if __name__ == "__main__":
    list(side_by_side(work, {str(k): (sys.argv[1],) for k in range(4)}, 2, 4))
"""


def is_running(pid: int) -> bool:
    """Whether there is such a process, and it is none that only waits to be buried."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="/proc tells who runs")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_processes_of_a_study_end_with_it(tmp_path, number):
    """A study that is killed leaves none that work on for nobody."""
    study, started = tmp_path / "study.py", tmp_path / "started"
    study.write_text(STUDY, encoding="utf-8")
    started.mkdir()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, study, started], env=environment)
    pids: list[int] = []
    end = monotonic() + 60
    while len(pids) < 2 and monotonic() < end:
        pids = [int(file.name) for file in started.iterdir()]
        sleep(0.1)
    assert len(pids) == 2 and all(is_running(pid) for pid in pids)
    process.send_signal(number)
    process.wait(30)
    end = monotonic() + 30
    while any(is_running(pid) for pid in pids) and monotonic() < end:
        sleep(0.1)
    assert not any(is_running(pid) for pid in pids)
