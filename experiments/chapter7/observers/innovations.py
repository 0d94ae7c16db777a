"""Every observer over recordings of real rigs, whose truth nobody knows.

What can be told there is the innovation, one sample ahead, and the free prediction from the
estimate, seconds ahead (:mod:`.free_prediction`).
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from experiments.chapter7.observers.free_prediction import free_errors
from experiments.chapter7.observers.study import FreePrediction, Study


def replay_all(study: Study, folder: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """Innovation figures by recording, observer and channel; of the recordings that are there.

    A channel that is a state has ``free``: the RMSE of the free prediction by horizon (s).
    """
    innovations = {}
    for name, recording in study.recordings.items():
        file = folder / recording.file
        if not file.is_file():
            continue
        innovations[name] = {
            observer: _replay(
                [
                    *(f"plant.file='{file}'", *recording.run, f"observer={observer}"),
                    *recording.observers.get(observer, []),
                ],
                study.free_prediction,
            )
            for observer in study.observers
        }
    return innovations


def _replay(overrides: list[str], free: FreePrediction) -> dict[str, Any]:
    """The channels of ``innovations.json`` of a run of ``trms run plant=replay``."""
    from trms_cli.commands import run
    from trms_cli.composition.composer import compose
    from trms_cli.core.plugins import build
    from trms_cli.library.tasks.replay import INNOVATIONS_NAME
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.runs.run_folder import LOG_NAME

    with tempfile.TemporaryDirectory(prefix="trms-observers-") as scratch, _silence():
        out = Path(scratch) / "run"
        composition = compose(["plant=replay", *overrides, "picture=false", f"out='{out}'"])
        run.perform(composition)
        document = json.loads((out / INNOVATIONS_NAME).read_text(encoding="utf-8"))
        tables = read_log(out / LOG_NAME).tables
    channels: dict[str, Any] = document["channels"]
    estimate, measurement = tables["/estimate"], tables["/measurement"]
    series = {
        name: np.asarray(column, dtype=float)
        for topic in ("/estimate", "/command")
        for name, column in tables[topic].columns.items()
    }
    for name, column in measurement.columns.items():
        series[f"y_{name}"] = np.asarray(column, dtype=float)
    errors = free_errors(
        build(composition.config["model"], "model"),
        float(np.median(np.diff(estimate.time))),
        series,
        list(channels),
        free.horizons,
        free.every,
        free.begin,
    )
    return {name: {**of, "free": errors.get(name, {})} for name, of in channels.items()}


@contextlib.contextmanager
def _silence() -> Any:
    """What the runs say is said by the tables."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
