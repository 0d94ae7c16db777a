"""The 3D view of a run: from a configuration or a log's own words to what goes into a log."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.core.scene import Scene
from trms_cli.models.model import Model
from trms_cli.models.rig_shape import rig_shape
from trms_cli.recordings.foxglove.messages import SceneEncoder
from trms_cli.recordings.foxglove.scene_log import SceneLog, Sources, find_sources
from trms_cli.recordings.foxglove.types import encoded_topics
from trms_cli.recordings.topics import PARAMETERS_ATTACHMENT, EncodedTopic, Topic

if TYPE_CHECKING:
    from trms_cli.plants.plant import PlantRun
    from trms_cli.recordings.for_model import RecordedRun
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.recordings.run_log import RunLog

#: What is said of a log that has no angle.
NO_ATTITUDE = "neither pitch nor yaw is in the log: a motor or a propeller alone has no attitude"


class RunScene:
    """The 3D view of one run.

    ``config``: its ``sim.scene_every`` decides how often, or whether at all. ``plant``: its
    parameters, where it has some, tell the body's lengths; the model's otherwise. Raises
    ConfigurationError when ``sim.scene_every`` is no whole number.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        topics: Sequence[Topic],
        model: Model,
        plant: PlantRun | RecordedRun,
    ) -> None:
        from trms_cli.composition.plain_values import whole_number

        self._every = whole_number(config["sim"]["scene_every"], "sim.scene_every")
        self._sources: Sources | None = None
        if self._every:
            limits = {
                signal.name: float(high)
                for signal, high in zip(plant.inputs, plant.input_limits[1], strict=True)
                if 0 < high < float("inf")
            }
            fields = {topic.name: topic.field_names for topic in topics}
            self._sources = find_sources(fields, limits)
        parameters = getattr(plant, "parameters", None) or model.parameters
        self._lengths = {p.name: float(p.value) for p in parameters}

    def topics(self) -> list[EncodedTopic]:
        """What the log gains; nothing where there is no attitude, or no view is wanted."""
        return encoded_topics() if self._sources is not None else []

    def sink(self, log: RunLog) -> RunLog | SceneLog:
        """What a run's history writes to: the log, or the log with the view."""
        if self._sources is None:
            return log
        encoder = encoder_of(rig_shape(self._lengths), self._sources)
        return SceneLog(log, encoder, self._sources, self._every)


def encoder_of(scene: Scene, sources: Sources) -> SceneEncoder:
    """The encoder of a rig's scene, with the ghosts that a log tells of."""
    return SceneEncoder(scene, sources.ghosts, scene.assumed)


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

    from trms_cli.core.yaml_data import load_yaml

    try:
        document = load_yaml(log.attachments.get(PARAMETERS_ATTACHMENT, b"").decode()) or {}
        parameters = document.get("plant") or document.get("model") or {}
        return {name: float(parameter["value"]) for name, parameter in parameters.items()}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"its {PARAMETERS_ATTACHMENT} is not as trms writes it ({error})", where=str(log.path)
        ) from error


def _limits(log: LoggedRun) -> dict[str, float]:
    """Largest commands, as the run said; for a recording the largest that occur."""
    limits: dict[str, float] = {}
    commands = log.tables.get("/command")
    if commands is not None:
        for name, column in commands.columns.items():
            magnitudes = np.abs(np.asarray(column, dtype=float))
            if np.isfinite(magnitudes).any():
                limits[name] = float(np.nanmax(magnitudes))
    run_limits: Any = json.loads(log.run.get("limits", "{}"))
    if isinstance(run_limits, Mapping):
        for name, bounds in run_limits.items():
            if name in limits and bounds[1] and np.isfinite(bounds[1]):
                limits[name] = float(bounds[1])
    return limits
