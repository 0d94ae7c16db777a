"""Baselines and scores as JSON, and the comparison with one."""

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

_SCORE: dict[str, Any] = {
    "schema": "trms.score/1",
    "log": "run.mcap",
    "complete": True,
    "duration_s": 10.0,
    "channels": {"alpha_v": {"rmse": 0.1, "iae": 1.0, "overshoot_percent": None, "unit": "rad"}},
    "inputs": {"u_v": {"effort": 3.0, "total_variation": 1.0, "unit": "V"}},
    "estimate": {"rmse": {"alpha_v": 0.01}, "prediction_rmse": {}, "units": {"alpha_v": "rad"}},
    "solver": {"iterations_mean": 1.0, "failures": 0},
    "constraint_violations": {"u_v": {"samples": 0, "worst": 0.0, "unit": "V"}},
}


def seeds(folder: Path) -> Iterator[bytes]:
    """A score and a baseline."""
    yield json.dumps(_SCORE).encode()
    tolerances = {"rmse": {"absolute": 0.1, "relative": 0.2}, "channels.alpha_v.iae": 0.5}
    baseline = {"schema": "trms.baseline/1", "reason": "x", "tolerances": tolerances}
    yield json.dumps(baseline | {"score": _SCORE}).encode()


def read(data: bytes, folder: Path) -> None:
    """A score held against the baseline, and the file as a run that is compared with others."""
    from trms_cli.core.errors import TrmsError
    from trms_cli.scoring.baseline import compare, read_baseline
    from trms_cli.scoring.comparison.runs import gather

    path = folder / "baseline.json"
    path.write_bytes(data)
    with suppress(TrmsError):
        gather([path])
    compare(_SCORE, read_baseline(path))
