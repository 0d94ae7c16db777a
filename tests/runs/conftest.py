"""Logs of runs with figures of one's choice, in a folder with an index of its own."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, standard_topics

WriteRun = Callable[..., Path]

_ANGLES = [Field("alpha_v", "rad"), Field("alpha_h", "rad")]
_TOPICS = standard_topics(
    references=_ANGLES,
    inputs=[Field("u_v", "V"), Field("u_h", "V")],
    outputs=_ANGLES,
    states=_ANGLES,
    estimates=_ANGLES,
)
CONFIG = b"sim:\n  duration: 6\n  sample_time: 0.02\nseed: 0\n"


def score(**changes: Any) -> dict[str, Any]:
    """A ``trms.score/1`` of two channels with the figures that index and filters are tried on."""
    channel = {"rmse": 0.1, "iae": 1.0, "settling_time_s": None, "steps": 1, "unit": "rad"}
    document: dict[str, Any] = {
        "schema": "trms.score/1",
        "duration_s": 6.0,
        "channels": {"alpha_v": dict(channel), "alpha_h": dict(channel)},
        "inputs": {"u_v": {"effort": 2.0, "total_variation": 3.0, "saturation_share": 0.25}},
        "estimate": {"nees_mean": 4.0, "rmse": {"omega_h": 0.5}},
        "solver": {"time_ms": {"median": 0.1, "p99": 0.2, "max": 0.3}, "failures": 0},
        "constraint_violations": {"u_v": {"samples": 2, "worst": 0.1}},
        "degraded": None,
    }
    for channel_name in ("alpha_v", "alpha_h"):
        if f"rmse_{channel_name}" in changes:
            document["channels"][channel_name]["rmse"] = changes.pop(f"rmse_{channel_name}")
    return document | changes


@pytest.fixture(autouse=True)
def index_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The index lies beside the runs, and the working folder is that of the runs."""
    folder = tmp_path / "index"
    monkeypatch.setenv("TRMS_RUNS", str(folder))
    runs = tmp_path / "runs"
    runs.mkdir()
    monkeypatch.chdir(runs)
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """The folder of the runs, which is the working folder."""
    return (tmp_path / "runs").resolve()


@pytest.fixture
def write_run(runs: Path) -> WriteRun:
    """Writes the log of a run and returns its path."""

    def write(
        name: str = "one",
        *,
        choices: dict[str, Any] | None = None,
        overrides: list[str] | None = None,
        ending: str | None = "completed",
        scored: dict[str, Any] | None = None,
        samples: int = 0,
        old: bool = False,
        config: bytes = CONFIG,
        **run: str,
    ) -> Path:
        usual = {"controller": "pid", "ref": "square", "effect": [], "fault": []}
        words = {
            "seed": "0",
            "choices": json.dumps(usual | (choices or {})),
            "overrides": json.dumps(overrides or []),
            "versions": json.dumps({"trms": "0.1.0"}),
        }
        if old:  # before logs had these
            del words["choices"], words["versions"]
        log = RunLog(
            runs / name / "run.mcap",
            _TOPICS,
            words | run,
            {"config.yaml": ("application/yaml", config)},
        )
        for k in range(samples):
            for topic in ("/reference", "/command", "/measurement"):
                log.write(topic, k * 20_000_000, [0.1, 0.2])
        log.flush()
        if ending is None:  # killed: what was flushed is all there is
            return log.path
        log.close(ending, score() if scored is None else scored)
        return log.path

    return write
