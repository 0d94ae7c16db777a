"""The program in an empty folder, and a user's own folder of plugins beside it."""

import functools
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.cli.terminal import Screen
from tests.program import INSTALLED, Done, Program, forgotten, in_process, installed

#: Packages of users that the tests write, each beside its configuration.
OWN_PACKAGES = (
    "own_lab_plugins",
    "misbehaving",
    "slowest",
    "sail_of_diagnose",
    "our_rig_of_diagnose",
)


@pytest.fixture(autouse=True)
def _allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """These packages may run; what whoever runs the tests has allowed for good does not count."""
    monkeypatch.setenv("TRMS_ALLOW", ",".join(OWN_PACKAGES))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))


@pytest.fixture
def trms(tmp_path: Path) -> Iterator[Program]:
    """Run ``trms`` in an empty folder, in this process."""
    with forgotten(tmp_path):
        yield functools.partial(in_process, tmp_path)


@pytest.fixture
def refused(trms: functools.partial[Done]) -> Callable[..., None]:
    """Run a command that is refused: in these words, on one screen, and nothing is left behind."""
    (folder,) = trms.args

    def there() -> set[Path]:
        others = {"__pycache__", "settings"}
        return {path for path in folder.rglob("*") if others.isdisjoint(path.parts)}

    def run(*argv: str, words: str | Iterable[str]) -> None:
        before = there()
        done = trms(*argv, code=2)
        assert not done.stdout and len(done.stderr.splitlines()) <= 20
        for part in [words] if isinstance(words, str) else words:
            assert part in done.said
        assert there() == before

    return run


@pytest.fixture
def program(tmp_path: Path) -> Program:
    """Run the installed ``trms`` there: for what depends on the process, as streams and starts."""
    return functools.partial(installed, tmp_path)


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the installed ``trms`` there, to be interrupted, and leave nothing behind."""
    processes = []

    def start(*argv: str, folder: Path = tmp_path) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [str(INSTALLED), *argv],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            start_new_session=True,
            # a shell's background jobs ignore Ctrl-C, and so would what they start
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.wait()
        for stream in (process.stdout, process.stderr):
            stream.close()


@pytest.fixture
def in_terminal(tmp_path: Path) -> Iterator[Callable[..., Screen]]:
    """Start the installed ``trms`` there, in a terminal of its own."""
    opened = []

    def start(*argv: str, **keys: Any) -> Screen:
        opened.append(Screen([str(INSTALLED), *argv], tmp_path, **keys))
        return opened[-1]

    yield start
    for screen in opened:
        screen.close()


@pytest.fixture
def misbehaving(tmp_path: Path) -> list[str]:
    """Words for controllers of that module: `own`, `deadly`, and `held` until the file ``go``."""
    options = tmp_path / "lab" / "configs" / "controller"
    for name, more in {
        "own": "how: ''     # refuse, raise, garbage, slow\nafter: 1.0  # s\n",
        "deadly": "how: bad  # or dies\n",
        "held": f"how: held\nmarker: {tmp_path / 'go'}  # file\n",
    }.items():
        text = f"# controls, or misbehaves\n_target_: misbehaving.Own\n{more}"
        _write(options / f"{name}.yaml", text)
    shutil.copy(Path(__file__).with_name("misbehaving.py"), tmp_path / "lab")
    return ["--config-dir", str(options.parent)]


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A configuration folder of a user: one option in each group, and a module beside it."""
    folder = tmp_path / "own lab" / "configs"
    for group in ("model", "plant", "observer", "controller", "ref"):
        _write(
            folder / group / "own.yaml",
            f"# the user's own {group}\n"
            "_target_: own_lab_plugins.Own\n"
            "gain: 1.5          # V/rad\n"
            "horizon: 20        # samples\n"
            "parameters: {}     # values by name\n"
            "weights:\n  alpha_v: 1.0  # 1/rad^2\n",
        )
    for name in ("sticky", "late"):
        _write(
            folder / "effect" / f"{name}.yaml",
            f"# the user's effect {name}\n{name}:\n"
            "  _target_: own_lab_plugins.Own\n  gain: 0.1  # 1\n",
        )
    _write(
        folder / "experiment" / "short.yaml",
        "# @package _global_\n# three seconds of it\n"
        "defaults:\n  - override /controller: own\nsim:\n  duration: 3.0\n",
    )
    _write(
        folder.parent / "own_lab_plugins.py",
        "from dataclasses import dataclass, field\n\n\n"
        "@dataclass(frozen=True, kw_only=True)\nclass Own:\n"
        "    gain: float = 1.0\n    horizon: int = 10\n"
        "    parameters: dict[str, float] = field(default_factory=dict)\n"
        "    weights: dict[str, float] = field(default_factory=dict)\n",
    )
    return folder


@pytest.fixture
def own(lab: Path) -> list[str]:
    """Arguments that choose the user's option in every group."""
    groups = ("model", "plant", "observer", "controller", "ref")
    return ["--config-dir", str(lab), *(f"{group}=own" for group in groups)]


def _write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
