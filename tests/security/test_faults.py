"""What a run survives: killed at any time, a full disk, a folder that takes nothing, no home."""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

_KILLS = 20
#: Simulated seconds of a run that is killed: it takes some seconds.
_LONG = 2000


def _command(*words: str) -> list[str]:
    return [sys.executable, "-m", "trms_cli", *words]


def _environment(**more: str) -> dict[str, str]:
    return os.environ | {"TRMS_RUNS": "off", "OMP_NUM_THREADS": "1", "NO_COLOR": "1"} | more


@pytest.mark.slow
def test_a_run_killed_at_any_time_leaves_a_log_that_opens(tmp_path: Path) -> None:
    from trms_cli.recordings.log_reader import read_log

    draw = random.Random(7)
    read = lost = 0
    for number in range(_KILLS):
        log = tmp_path / f"run-{number}" / "run.mcap"
        words = _command(
            "run", "controller=pid", f"sim.duration={_LONG}", "picture=false", f"out=run-{number}"
        )
        with subprocess.Popen(
            words, cwd=tmp_path, env=_environment(), stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as run:  # fmt: skip
            deadline = time.monotonic() + 120
            while not log.exists() and time.monotonic() < deadline and run.poll() is None:
                time.sleep(0.005)
            time.sleep(draw.uniform(0.0, 1.5))
            run.send_signal(signal.SIGKILL)
            run.wait(timeout=60)
        if not log.exists() or log.stat().st_size < 9:
            lost += 1
            continue
        found = read_log(log)
        read += 1
        if not found.complete:
            assert found.outcome == "died"
            for table in found.tables.values():
                assert (table.time[1:] >= table.time[:-1]).all()
    print(f"\n{read} of {_KILLS} logs read, {lost} killed before the first byte")
    assert read >= _KILLS // 2


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000])
def test_a_damaged_result_in_the_cache_is_made_again(content, tmp_path, monkeypatch) -> None:
    from trms_cli.core.process_cache import cached_result

    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "functions"))

    def result() -> dict[str, float]:
        return cached_result(__file__, [1], dict[str, float], lambda: {"value": 0.1 + 0.2})

    first = result()
    (file,) = (tmp_path / "results").iterdir()
    file.write_bytes(content)
    assert result() == first and json.loads(file.read_text()) == first


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become nobody")
def test_nobody_without_a_home_can_run() -> None:
    """A container runs as a user that has no home and no name: slower, and no error."""

    def nobody() -> None:
        os.setgroups([])
        os.setgid(54321)
        os.setuid(54321)

    environment = {k: v for k, v in _environment().items() if k not in ("HOME", "XDG_CACHE_HOME")}
    environment.pop("TRMS_CACHE", None)
    environment.pop("TRMS_RUNS", None)
    with tempfile.TemporaryDirectory() as place:  # pytest's own folders let nobody in
        folder = Path(place)
        folder.chmod(0o777)
        try:
            subprocess.run(
                [sys.executable, "-c", "import trms_cli"], cwd=folder, preexec_fn=nobody,
                capture_output=True, check=True,
            )  # fmt: skip
        except (OSError, subprocess.CalledProcessError):
            pytest.skip("this installation is not there for others")
        done = subprocess.run(
            _command("run", "controller=pid", "sim.duration=2", "picture=false", "out=one"),
            cwd=folder, env=environment, capture_output=True, text=True, preexec_fn=nobody,
            timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert (folder / "one" / "score.json").is_file()


def test_without_a_home_what_is_compiled_is_kept_for_the_process(monkeypatch) -> None:
    import casadi as ca

    from trms_cli.core.compilation import BufferedFunction, cache_folder
    from trms_cli.core.trust import allowed_for_good

    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("TRMS_CACHE", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as where it finds no home
    x = ca.MX.sym("x")
    assert float(BufferedFunction(ca.Function("f", [x], [2 * x])).evaluate(3.0)[0][0]) == 6.0
    assert cache_folder().parent.stat().st_mode & 0o077 == 0
    assert allowed_for_good() == {}
