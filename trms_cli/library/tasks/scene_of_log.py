"""The 3D view of a log on disk: which body, from the log's own parameters, and which angles."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.library.tasks.scene import NO_ATTITUDE, encoder_of
from trms_cli.models.rig_shape import rig_shape
from trms_cli.recordings.foxglove.messages import SceneEncoder
from trms_cli.recordings.foxglove.scene_log import Sources, find_sources
from trms_cli.recordings.log_reader import LoggedRun

_PARAMETERS = "parameters.yaml"


@dataclass(frozen=True)
class SceneOfLog:
    """What is needed to show a log."""

    encoder: SceneEncoder
    sources: Sources
    interval: float  #: Between two samples, s

    def every(self, seconds: float) -> int:
        """Samples in about so many seconds, at least one."""
        return max(1, round(seconds / self.interval)) if self.interval > 0 else 1


def scene_of_log(log: LoggedRun) -> SceneOfLog:
    """The body and the sources of a log's poses.

    Raises RecordingError for a log without an angle.
    """
    fields = {topic: list(table.columns) for topic, table in log.tables.items() if len(table)}
    sources = find_sources(fields, _limits(log))
    if sources is None:
        raise RecordingError(
            f"there is no 3D view of this log: {NO_ATTITUDE}",
            where=str(log.path),
            remedy="a log of a rig that pitches or yaws has one",
        )
    time = log.tables[sources.attitudes[""][0]].time
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return SceneOfLog(encoder_of(rig_shape(_lengths(log)), sources), sources, interval)


def _lengths(log: LoggedRun) -> dict[str, float]:
    """Parameters of the rig, else of the model, by name; empty for an imported recording."""
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        told = yaml.load(log.attachments.get(_PARAMETERS, b"").decode(), Loader=loader) or {}
        chosen = told.get("plant") or told.get("model") or {}
        return {name: float(parameter["value"]) for name, parameter in chosen.items()}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"its {_PARAMETERS} is not as trms writes it ({error})", where=str(log.path)
        ) from error


def _limits(log: LoggedRun) -> dict[str, float]:
    """Largest commands, as the run said; for a recording the largest that occur."""
    limits: dict[str, float] = {}
    commands = log.tables.get("/command")
    if commands is not None:
        for name, column in commands.columns.items():
            known = np.abs(np.asarray(column, dtype=float))
            if np.isfinite(known).any():
                limits[name] = float(np.nanmax(known))
    told: Any = json.loads(log.run.get("limits", "{}"))
    if isinstance(told, Mapping):
        for name, bounds in told.items():
            if name in limits and bounds[1] and np.isfinite(bounds[1]):
                limits[name] = float(bounds[1])
    return limits
