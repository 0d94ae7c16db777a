"""Sweeps: the status.json of each job, and the plan beside them."""

import json
from collections.abc import Iterator
from pathlib import Path

_PLAN = (
    b"hydra:\n  overrides: {task: ['a=1,2', 'b=range(3)']}\n  sweeper: {_target_: BasicSweeper}\n"
)


def seeds(folder: Path) -> Iterator[bytes]:
    """What jobs write; the first byte tells a plan from a status."""
    status = {
        "schema": "trms.status/1",
        "job": 1,
        "pid": 1,
        "state": "failed",
        "overrides": ["controller=pid", "seed=1"],
        "choices": {"controller": "pid", "effect": ["a", "b"]},
        "objective": 0.5,
        "error": {"problem": "no", "where": "seed", "remedy": "another"},
    }
    yield b"s" + json.dumps(status).encode()
    yield b"s" + json.dumps(status | {"state": "done", "error": None}).encode()
    yield b"p" + _PLAN


def read(data: bytes, folder: Path) -> None:
    """The row of the index and the state of the sweep."""
    from trms_cli.runs.entry import read_status
    from trms_cli.runs.index import FileStamp, LogReading, RunIndex
    from trms_cli.sweeps.outcome import SweepFollower

    job = folder / "sweep" / "0"
    job.mkdir(parents=True, exist_ok=True)
    status, plan = job / "status.json", job.parent / "multirun.yaml"
    (status if data[:1] == b"s" else plan).write_bytes(data[1:])
    if not status.exists():
        status.write_bytes(b'{"schema": "trms.status/1", "state": "done"}')
    entry = read_status(status)
    if entry is not None:
        with RunIndex(None) as index:
            index.put([LogReading(str(status), FileStamp(0, len(data)), entry)])
    sweep = SweepFollower(job.parent).now()
    sweep.has_ended, sweep.best, sweep.failures, sweep.left_s  # noqa: B018
