"""Faults at the wire: every run lands within its envelope, and a program that would not is seen."""

from pathlib import Path

import numpy as np
import pytest

from experiments.rig import faults
from trms_cli.plants.envelope import EnvelopeWatch
from trms_cli.plants.link import served_rig
from trms_cli.plants.link.served_rig import ServedRig
from trms_cli.simulation.command_gate import CommandGate
from trms_cli.simulation.rig_life import RigLife

SEEDS = range(70_000, 70_040)


def violations(folder: Path) -> list[str]:
    with np.errstate(all="ignore"):
        verdicts = [faults.run_virtual(seed, folder) for seed in SEEDS]
    return [words for verdict in verdicts for words in verdict.violations]


def test_every_run_lands_within_its_envelope(tmp_path: Path) -> None:
    assert violations(tmp_path) == []


def test_a_run_repeats_with_its_seed(tmp_path: Path) -> None:
    seed = SEEDS[3]
    assert faults.run_virtual(seed, tmp_path) == faults.run_virtual(seed, tmp_path)


def never(*_: object) -> None:
    """In the place of what should have been done."""


@pytest.mark.parametrize(
    ("owner", "name", "replacement", "words"),
    [
        (RigLife, "land", never, "the last command that was sent"),
        (RigLife, "close", never, "closed 0 times"),
        (EnvelopeWatch, "limited", lambda self, u, previous, tell: u, "outside the envelope"),
        (CommandGate, "applied", lambda self, c, previous: np.asarray(c.u), "no number"),
        (served_rig, "is_newer", lambda sequence, than: True, "after newer ones"),
    ],
)
def test_a_program_that_leaves_something_out_is_seen(
    owner: object,
    name: str,
    replacement: object,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(owner, name, replacement)
    assert any(words in text for text in violations(tmp_path))


def test_a_rig_without_a_watchdog_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begin = ServedRig.__init__

    def patient(self: ServedRig, *arguments: object) -> None:
        begin(self, *arguments)  # type: ignore[arg-type]
        self._longest_watchdog = 0.0
        self.watchdog = 1e9

    monkeypatch.setattr(ServedRig, "__init__", patient)
    monkeypatch.setattr(
        "trms_cli.plants.link.linked_rig.LinkedRun._check_welcome", lambda *arguments: None
    )
    assert any("not landed" in text for text in violations(tmp_path))


@pytest.mark.slow
def test_in_real_time_too(tmp_path: Path) -> None:
    verdicts = [faults.run_real(seed, tmp_path) for seed in range(80_000, 80_008)]
    assert [words for verdict in verdicts for words in verdict.violations] == []
