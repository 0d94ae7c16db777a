"""Small logs and recordings that the tests of this room share."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trms_cli.recordings.recording import Recording
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic, standard_topics

SAMPLE_NS = 10_000_000
CONFIG = b"seed: 3\nsim:\n  duration: 1.0\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where a log or a recording goes."""
    return tmp_path / "run.mcap"


@pytest.fixture
def topics() -> list[Topic]:
    """Topics of a small run with everything that a run can have."""
    angles = [Field("alpha_v", "rad", "pitch angle"), Field("alpha_h", "rad", "yaw angle")]
    return standard_topics(
        references=angles,
        inputs=[Field("u_v", "V", "main rotor command"), Field("u_h", "V")],
        outputs=angles,
        states=[Field("omega_h", "rad/s"), Field("alpha_h", "rad")],
        estimates=[Field("omega_h", "rad/s"), Field("alpha_h", "rad")],
        prediction=True,
    )


@pytest.fixture
def write_run(topics: list[Topic]) -> Callable[..., Path]:
    """Write a run of `samples` samples at 100 Hz, flushed each second."""

    def write(path: Path, samples: int = 250, *, close: bool = True) -> Path:
        log = RunLog(
            path,
            topics,
            {"command": "trms run", "seed": "3"},
            {"config.yaml": ("application/yaml", CONFIG)},
        )
        for k in range(samples):
            write_sample(log, k)
            if k % 100 == 99:
                log.flush()
        if close:
            log.close("completed", {"rmse": {"alpha_h": 0.5}, "complete": True})
        else:
            log.flush()
        return path

    return write


def write_sample(log: RunLog, k: int) -> None:
    """Write sample k on every topic; each value tells topic and sample."""
    t = k * SAMPLE_NS
    log.write("/reference", t, (0.3, -0.5))
    log.write("/command", t, np.array([1.0 + k, -1.0]))
    log.write("/measurement", t, [0.1 * k, float("nan") if k % 2 else 0.0])
    log.write("/plant/state", t, (float(k), 2.0))
    log.write("/estimate", t, tuple(float(i) for i in range(10)))
    log.write(
        "/controller",
        t,
        (1e-4, 2e-5, 3e-5, 3, "optimal", 1.5, 0.0, 1e-9, False, k == 7, "", "normal", "", 0.0),
    )
    if k % 10 == 0:
        horizon = np.arange(4) * 0.1
        log.write("/prediction", t, [horizon, *(horizon * i for i in range(5))])
    if k == 5:
        log.event(t, "saturation", "u_v", "begun", 2.5)
        log.event(t, "note", "person", "pushed the beam")


@pytest.fixture
def recording() -> Recording:
    """A recording of four rows with a gap and a missing sample."""
    return Recording(
        time=np.array([0.0, 0.02, 0.04, 0.1]),
        channels={
            "u_v": np.array([1.0, 1.5, 2.0, 2.5]),
            "alpha_v": np.array([0.1, np.nan, 0.3, 0.4]),
            "r_v": np.array([0.2, 0.2, 0.2, -0.2]),
        },
        units={"u_v": "V", "alpha_v": "rad", "r_v": "rad"},
        metadata={"rig": "bench", "loop": "open"},
    )
