"""The installed program, and a user's own folder of plugins beside it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Program = Callable[..., subprocess.CompletedProcess[str]]
#: Packages of users that the tests write, each beside its configuration.
OWN_PACKAGES = (
    "own_lab_plugins",
    "misbehaving",
    "deadly_lab",
    "slow_plugin",
    "slowest",
    "sail_of_diagnose",
    "our_rig_of_diagnose",
)


@pytest.fixture(autouse=True)
def _allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """These packages may run; what whoever runs the tests has allowed for good does not count."""
    monkeypatch.setenv("TRMS_ALLOW", ",".join(OWN_PACKAGES))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))


@pytest.fixture(scope="session")
def executable() -> Path:
    """The console script that was installed with the package under test."""
    script = Path(sys.executable).with_name("trms")
    assert script.is_file(), "install the package first: make setup"
    return script


@pytest.fixture
def trms(executable: Path, tmp_path: Path) -> Program:
    """Run ``trms`` as a person would, in an empty folder."""

    def run(*argv: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(executable), *argv],
            cwd=tmp_path,
            env=os.environ | {"NO_COLOR": "1"} | environment,
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=120,
        )

    return run


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
