"""Several processes that are given one folder, or one file, at the same moment."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from trms_cli.runs.run_folder import hold, let_go

_MANY = 8
#: What each begins with: a call that tells that it is ready, and waits for the file `go`.
_BEGIN = """
import sys, time
from pathlib import Path
def begin():
    Path(f"ready-{sys.argv[2]}").touch()
    while not Path("go").exists():
        pass
"""
#: Claims a folder; tells what came of it.
_CLAIM = """
from trms_cli.runs.run_folder import new_folder
from trms_cli.core.errors import TrmsError
out = None if sys.argv[1] == "dated" else sys.argv[1]
begin()
try:
    folder = new_folder(out, "run")
except TrmsError as error:
    print(f"refused {error.problem}")
else:
    time.sleep(0.3)  # a run that is composed first
    for name in ("a", "b"):
        (folder / name).write_text(sys.argv[2])
    print(f"won {folder}")
"""


def _raced(program: str, cwd: Path, *arguments: str) -> list[str]:
    """What each of many processes says that begin at the same moment."""
    racers = [
        subprocess.Popen(
            [sys.executable, "-c", _BEGIN + program, *arguments, str(number)],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(_MANY)
    ]
    deadline = time.monotonic() + 120
    while len(list(cwd.glob("ready-*"))) < _MANY and time.monotonic() < deadline:
        time.sleep(0.01)
    (cwd / "go").touch()
    said = []
    for racer in racers:
        out, error = racer.communicate(timeout=120)
        assert racer.returncode == 0, error
        said.append(out.strip())
    return said


@pytest.mark.parametrize("there", [False, True])
def test_of_many_that_are_given_one_folder_one_gets_it(tmp_path: Path, there: bool) -> None:
    if there:
        (tmp_path / "one").mkdir()
    said = _raced(_CLAIM, tmp_path, "one")
    winners = [str(number) for number, words in enumerate(said) if words.startswith("won")]
    assert len(winners) == 1, said
    assert {(tmp_path / "one" / name).read_text() for name in ("a", "b")} == set(winners)
    assert all("writing into" in w or "not empty" in w for w in said if w.startswith("refused"))


def test_dated_folders_are_all_different(tmp_path: Path) -> None:
    said = _raced(_CLAIM, tmp_path, "dated")
    assert all(words.startswith("won") for words in said), said
    assert len(set(said)) == _MANY
    for words in said:
        folder = tmp_path / words.removeprefix("won ")
        assert folder.joinpath("a").read_text() == folder.joinpath("b").read_text()


def test_a_folder_whose_process_was_killed_can_be_taken(tmp_path: Path) -> None:
    program = (
        "import sys, time\nfrom trms_cli.runs.run_folder import new_folder\n"
        "new_folder('one', 'run')\nprint('held', flush=True)\ntime.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None and holder.stdout.readline().strip() == "held"
        assert not hold(tmp_path / "one")
        holder.send_signal(signal.SIGKILL)
        holder.wait(timeout=30)
    assert hold(tmp_path / "one") and hold(tmp_path / "one")  # it may take its own again
    let_go(tmp_path / "one")
    let_go(tmp_path / "one")


def test_no_descriptor_is_kept_of_folders_that_are_written(tmp_path: Path) -> None:
    from trms_cli.runs.run_folder import new_folder

    before = len(os.listdir("/proc/self/fd"))
    for number in range(300):
        (new_folder(tmp_path / str(number), "run") / "run.mcap").touch()
    assert len(os.listdir("/proc/self/fd")) - before <= 70


_WRITE = """
from trms_cli.core.whole_file import replace_whole
begin()
for _ in range(100):
    replace_whole(Path(sys.argv[1]), sys.argv[2].encode() * 100_000)
"""


def test_a_file_that_many_write_is_always_one_of_theirs(tmp_path: Path) -> None:
    _raced(_WRITE, tmp_path, "document.json")
    content = (tmp_path / "document.json").read_bytes()
    assert len(content) == 100_000 and len(set(content)) == 1
    assert not list(tmp_path.glob(".*"))


_LINK = """
from trms_cli.core.errors import TrmsError
from trms_cli.core.whole_file import whole_file
begin()
try:
    with whole_file(Path(sys.argv[1])) as temporary:
        temporary.write_text(sys.argv[2])
except TrmsError:
    print("refused")
else:
    print("won")
"""


def test_of_many_exports_to_one_file_one_writes_it(tmp_path: Path) -> None:
    said = _raced(_LINK, tmp_path, "export.csv")
    assert said.count("won") == 1 and said.count("refused") == _MANY - 1
    assert (tmp_path / "export.csv").read_text() == str(said.index("won"))


_CACHE = """
import casadi as ca
import numpy as np
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.process_cache import cached_result
x = ca.MX.sym("x")
begin()
function = BufferedFunction(ca.Function("raced", [x], [ca.sin(x) + 1]))
kept = cached_result(sys.argv[1], [1], dict[str, float], lambda: {"value": 0.5})
print(float(function.evaluate(0.5)[0][0]), kept["value"])
"""


def test_many_that_compile_and_keep_the_same_thing_at_once(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "cache" / "functions"))
    said = _raced(_CACHE, tmp_path, __file__)
    assert len(set(said)) == 1
    kept = list((tmp_path / "cache" / "results").iterdir())
    assert len(kept) == 1 and json.loads(kept[0].read_text()) == {"value": 0.5}
    libraries = list((tmp_path / "cache" / "functions").iterdir())
    assert len(libraries) == 1 and libraries[0].suffix == ".so"
