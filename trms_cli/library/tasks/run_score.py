"""The score of a run that is still in memory: its history against the limits of rig and model."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def units_of(topic: Any) -> dict[str, str]:
    """Units of a topic's fields by name."""
    return {field.name: field.unit for field in topic.fields}


def score_of(loop: Any, path: Path, *, complete: bool) -> dict[str, Any]:
    """``trms.score/1`` of a loop that has run, or of as much of it as there is."""
    from trms_cli.scoring.score import Series, score_tables

    history = loop.history
    tables = {
        topic: Series(history.times(topic), history.columns(topic), history.units[topic])
        for topic in history.fields
        if topic != "/prediction"
    }
    return score_tables(
        tables,
        limits=limits_of(loop),
        duration_s=loop.done * loop.experiment.sample_time,
        log=str(path),
        complete=complete,
    )


def limits_of(loop: Any) -> dict[str, tuple[float, float]]:
    """Of the inputs (V) and of the angles (rad), by name."""
    lower, upper = loop.plant.input_limits
    limits = {
        signal.name: (low, high)
        for signal, low, high in zip(loop.plant.inputs, lower.tolist(), upper.tolist(), strict=True)
    }
    return limits | {name: (-stop, stop) for name, stop in loop.experiment.model.stops.items()}
