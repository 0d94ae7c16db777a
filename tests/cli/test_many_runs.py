"""Many runs in one process, as a sweep's worker makes them: each as if it were the only one."""

import copy
import gc
import json
import os
import subprocess
import sys
import tracemalloc
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from trms_cli.commands.run import perform
from trms_cli.composition.composer import Composition, compose
from trms_cli.core import process_cache

#: Fields of /controller that tell of the wall clock.
_WALL_CLOCK = ("solve_time_s", "linearise_time_s", "qp_time_s", "deadline_missed")
_SHORT = ("controller=pid", "sim.duration=2", "picture=false")
#: What a sweep varies: the rig, what it has beside the model, the model itself, the observer.
_RUNS: dict[str, tuple[str, ...]] = {
    "plain": (),
    "drawn": ("plant.prior_seed=3", "seed=1"),
    "friction": ("effect=yaw_coulomb_friction", "effect.yaw_coulomb_friction.torque=0.004"),
    "more friction": ("effect=yaw_coulomb_friction", "effect.yaw_coulomb_friction.torque=0.02"),
    "model": ("model.parameters.l_m=0.25",),
    "observer": ("observer=ekf", "observer.process_noise.rotor=5"),
    "channels": ("plant.sensors.channels=[alpha_v,alpha_h]",),
}


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("TRMS_RUNS", "off")


def content(log: Path) -> list[tuple[str, int, bytes]]:
    """All messages but what the wall clock had a part in: topic, time (ns), data."""
    found = []
    with log.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            data = message.data
            if channel.topic == "/controller":
                row = json.loads(data)
                data = json.dumps({k: v for k, v in row.items() if k not in _WALL_CLOCK}).encode()
            found.append((channel.topic, message.log_time, data))
    return found


def run_in(folder: Path, *words: str) -> list[tuple[str, int, bytes]]:
    perform(compose([*_SHORT, *words, f"out={folder}"]))
    return content(folder / "run.mcap")


@pytest.mark.slow
def test_a_run_does_not_depend_on_those_before_it(tmp_path: Path) -> None:
    process_cache.forget()
    first = {name: run_in(tmp_path / name, *words) for name, words in _RUNS.items()}
    again = {
        name: run_in(tmp_path / f"{name} again", *words) for name, words in reversed(_RUNS.items())
    }
    assert first == again
    assert len({json.dumps([str(row) for row in rows]) for rows in first.values()}) == len(_RUNS)
    words = [*_SHORT, *_RUNS["friction"], "out=alone"]
    subprocess.run(
        [sys.executable, "-m", "trms_cli", "run", *words],
        cwd=tmp_path,
        check=True,
        capture_output=True,
    )
    assert content(tmp_path / "alone" / "run.mcap") == first["friction"]


def test_a_rig_that_differs_in_numbers_shares_its_equations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_in(tmp_path / "first")

    def built_again(*_: Any) -> None:
        raise AssertionError("equations were built again")

    monkeypatch.setattr("trms_cli.models.newtonian.Newtonian.beam", built_again)
    run_in(tmp_path / "drawn", "plant.prior_seed=7", "seed=7")
    run_in(tmp_path / "changed", "plant.parameters.k_g=0.05", "ref=sine")


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_runs(tmp_path: Path) -> None:
    base = compose([*_SHORT, "sim.duration=0.4"])

    def make(numbers: range) -> None:
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            for number in numbers:
                perform(_varied(base, tmp_path / str(number), number))

    make(range(4))
    tracemalloc.start()
    try:
        make(range(4, 8))
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        make(range(8, 24))
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # A history that stayed would be more than ten thousand bytes a run. What stays is what is known
    # of the last folders (their number is bounded), and some words of CasADi's.
    assert after - before < 16 * 4096
    assert len(process_cache._kept) <= process_cache.MOST_RESULTS


def _varied(base: Composition, folder: Path, number: int) -> Composition:
    """The same composition for another draw of the rig, as a sweep varies it."""
    config = copy.deepcopy(base.config)
    config["seed"] = config["plant"]["prior_seed"] = number
    config["out"] = str(folder)
    return replace(base, config=config)
