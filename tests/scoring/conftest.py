"""A made-up run of second-order responses, in memory and as a log."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, standard_topics
from trms_cli.scoring.score import Series, score_tables

LIMITS = {"u_v": (-2.5, 2.5), "u_h": (-2.5, 2.5), "alpha_v": (-0.9, 0.6)}
_ANGLES = [Field("alpha_v", "rad"), Field("alpha_h", "rad")]
_STATES = [Field("alpha_h", "rad"), Field("alpha_v", "rad")]
_INPUTS = [Field("u_v", "V"), Field("u_h", "V")]
_TOPICS = standard_topics(
    references=_ANGLES, inputs=_INPUTS, outputs=_ANGLES, states=_STATES, estimates=_STATES
)
UNITS = {topic.name: {field.name: field.unit for field in topic.fields} for topic in _TOPICS}


def second_order(time: np.ndarray, damping: float, frequency: float) -> np.ndarray:
    """Unit step response at time ≥ 0, 0 before."""
    root = math.sqrt(1 - damping**2)
    after = np.maximum(time, 0.0)
    phase = frequency * root * after
    decay = np.exp(-damping * frequency * after)
    return 1 - decay * (np.cos(phase) + damping / root * np.sin(phase))


def response_tables(frequency: float = 2.0) -> dict[str, Series]:
    """Tables by topic of a run of 40 s whose responses to a square have a ``frequency``."""
    rng = np.random.default_rng(0)
    time = np.arange(4000) / 100
    wave = np.where(np.floor(time / 10 + 1e-9) % 2 == 0, 1.0, -1.0)
    edges = zip((0.0, 10.0, 20.0, 30.0), (1, -2, 2, -2), strict=True)
    unit = sum(jump * second_order(time - edge, 0.6, frequency) for edge, jump in edges)
    angles = unit[:, None] * [0.3, 0.5]
    noise = rng.normal(0, 0.002, (time.size, 2))
    spread = rng.normal(0, 0.01, (time.size, 2))
    estimate: dict[str, Any] = {
        "alpha_h": angles[:, 1] + spread[:, 0],
        "alpha_v": angles[:, 0] + spread[:, 1],
    }
    for name in ("alpha_h", "alpha_v"):
        estimate[f"sd_{name}"] = np.full(time.size, 0.01)
    for index, name in enumerate(("alpha_v", "alpha_h")):
        estimate[f"predicted_{name}"] = angles[:, index]
        estimate[f"innovation_{name}"] = noise[:, index]
        estimate[f"innovation_sd_{name}"] = np.full(time.size, 0.002)
    solve_time = np.full(time.size, 1e-4)
    solve_time[17] = 5e-3
    tables = {
        "/reference": Series(time, {"alpha_v": 0.3 * wave, "alpha_h": 0.5 * wave}),
        "/command": Series(
            time,
            {"u_v": np.clip(3 * wave * np.exp(-(time % 10)), -2.5, 2.5), "u_h": 0.5 * wave},
        ),
        "/measurement": Series(
            time, {"alpha_v": angles[:, 0] + noise[:, 0], "alpha_h": angles[:, 1] + noise[:, 1]}
        ),
        "/plant/state": Series(time, {"alpha_h": angles[:, 1], "alpha_v": angles[:, 0]}),
        "/estimate": Series(time, estimate),
        "/controller": Series(
            time,
            {
                "solve_time_s": solve_time,
                "iterations": np.full(time.size, 2.0),
                "status": np.where(solve_time > 1e-3, "failed", "ok").astype(object),
                "objective": np.full(time.size, 0.1),
                "fallback": (solve_time > 1e-3).astype(float),
                "deadline_missed": (solve_time > 1e-3).astype(float),
                "mode": np.full(time.size, "normal", dtype=object),
                "reasons": np.full(time.size, "", dtype=object),
            },
        ),
    }
    return {name: replace(table, units=UNITS[name]) for name, table in tables.items()}


@pytest.fixture(scope="session")
def score() -> dict[str, Any]:
    """The score of such a run."""
    return score_tables(response_tables(), limits=LIMITS, duration_s=40.0, log="run.mcap")


@pytest.fixture
def make_log(tmp_path: Path) -> Callable[..., Path]:
    """Writes such a run as a log and returns its path."""

    def make(name: str = "run.mcap", *, killed: bool = False, frequency: float = 2.0) -> Path:
        tables = response_tables(frequency)
        log = RunLog(tmp_path / name, _TOPICS, {"limits": json.dumps(LIMITS)})
        fields = {topic.name: topic.field_names for topic in _TOPICS if topic.name in tables}
        nothing = {"message": ""}
        for index, time in enumerate(tables["/command"].time):
            for topic, names in fields.items():
                columns = tables[topic].columns
                row = [columns[n][index] if n in columns else nothing.get(n, np.nan) for n in names]
                log.write(topic, round(time * 1e9), row)
            if index % 100 == 99:
                log.flush()
        if not killed:
            log.close("completed")
        return log.path

    return make
