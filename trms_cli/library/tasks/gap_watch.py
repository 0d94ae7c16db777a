"""``trms watch --gap LOG``: the gap watch over a log, finished or still growing."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from trms_cli.composition.catalogue import make_importable
from trms_cli.composition.given_object import refuse_objects
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.plugins import build
from trms_cli.gap.watch.gap_watch import GapWatch, WatchingGap
from trms_cli.library.tasks.experiment import CONFIG_DIRS_KEY
from trms_cli.models.model import Model, names
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.recordings.log_reader import LogPiece, LogTail
from trms_cli.simulation.gap_watch import GapAlarm

SCHEMA = "trms.gap_alarms/1"
_TOPICS = ("/command", "/measurement")
#: s between two questions whether a log that does not grow is still being written.
_WRITER_EVERY = 0.2


class GapReplay:
    """A gap watch that reads a log, with the model that the log says was in use.

    Raises RecordingError when the log cannot be read or holds no run with commands and
    measurements, also from :meth:`advance`; ConfigurationError when its model cannot be built.
    """

    def __init__(self, path: Path, config: GapWatch | None = None) -> None:
        self.path, self.config = path, config or GapWatch()
        self.alarms: list[GapAlarm] = []
        self.time = math.nan  #: s, of the last sample
        self.has_ended = False  #: All that there is has been read, and nothing more will come
        self.model = ""  #: Its name
        self._tail = LogTail(path, lambda topic, column: topic in _TOPICS)
        self._watch: WatchingGap | None = None
        self._begin = 0.0
        self._inputs: tuple[str, ...] = ()
        self._outputs: tuple[str, ...] = ()
        #: Rows that have come, by topic; commands wait for the measurements beside them
        self._waiting: dict[str, list[tuple[float, list[float]]]] = {name: [] for name in _TOPICS}
        self._command: np.ndarray | None = None
        self._asked = -math.inf

    @property
    def statistic(self) -> float:
        """Of the most likely change at present; NaN while it is learnt what is usual."""
        latest = None if self._watch is None else self._watch.latest
        return math.nan if latest is None else latest.statistic

    def advance(self, budget: float = math.inf) -> list[GapAlarm]:
        """Take what is new, for at most so many seconds of wall time; the alarms that it raised."""
        begin, before = monotonic(), len(self.alarms)
        while not self.has_ended and monotonic() - begin < budget:
            self._step_through()
            piece = self._tail.read(2**16)
            if piece is not None:
                self._take(piece)
            elif self._is_over():
                self._step_through()
                self._finish()
                break
            elif not self._tail.finished:
                break
        return self.alarms[before:]

    def close(self) -> None:
        """Close the log."""
        self._tail.close()

    def document(self) -> dict[str, Any]:
        """What there is to say, as JSON."""
        return {
            "schema": SCHEMA,
            "log": str(self.path),
            "model": self.model,
            "duration_s": self.time,
            "complete": self.has_ended,
            "threshold": self.config.threshold,
            "alarms": [
                {name: None if value != value else value for name, value in asdict(alarm).items()}
                for alarm in self.alarms
            ],
        }

    def _is_over(self) -> bool:
        """Whether nothing more will come; it is not asked at each look whether anybody writes."""
        if self._tail.finished:
            return True
        now = monotonic()
        if now - self._asked < _WRITER_EVERY:
            return False
        self._asked = now
        return self._tail.has_writer() is False

    def _finish(self) -> None:
        self.has_ended = True
        if self._watch is None:
            raise RecordingError(
                "the log holds no run with commands and measurements",
                where=str(self.path),
                remedy="name the log of a run: trms run, or trms run plant=replay plant.file=…",
            )

    def _take(self, piece: LogPiece) -> None:
        for topic in _TOPICS:
            table = piece.tables.get(topic)
            if table is None:
                continue
            columns = [np.asarray(column, dtype=float) for column in table.columns.values()]
            rows = np.column_stack(columns).tolist()
            self._waiting[topic] += zip(table.time.tolist(), rows, strict=True)
            if topic == "/command":
                self._inputs = tuple(table.columns)
            else:
                self._outputs = tuple(table.columns)

    def _step_through(self) -> None:
        """Watch all samples whose command and measurement are both there."""
        count = min(len(rows) for rows in self._waiting.values())
        if self._watch is None:
            if count < 2:
                return
            self._watch = self._ready()
        for time, command, measurement in self._samples(count):
            assert self._command is not None
            self.time = time
            for alarm in self._watch.step(self._command, measurement):
                self.alarms.append(self._in_log_time(alarm))
            self._command = command

    def _in_log_time(self, alarm: GapAlarm) -> GapAlarm:
        begin = self._begin
        return replace(
            alarm, time=round(alarm.time + begin, 9), since=round(alarm.since + begin, 9)
        )

    def _samples(self, count: int) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        commands, measurements = (self._waiting[topic] for topic in _TOPICS)
        assert self._command is not None
        for (_, command), (time, measurement) in zip(
            commands[:count], measurements[:count], strict=True
        ):
            u = np.array(command)
            # where none is recorded the last one is in force
            yield time, np.where(np.isfinite(u), u, self._command), np.array(measurement)
        del commands[:count], measurements[:count]

    def _ready(self) -> WatchingGap:
        """The watch, from the log's configuration and its first sample."""
        config = self._logged_config()
        make_importable(map(Path, json.loads(self._tail.run.get(CONFIG_DIRS_KEY, "[]"))))
        model = build(config.get("model"), "model")
        if not isinstance(model, Model):
            raise ConfigurationError(
                "the log names no model", where=str(self.path), remedy="name the log of a run"
            )
        self.model = model.name
        lacking = [name for name in names(model.inputs) if name not in self._inputs]
        if lacking or self._inputs != names(model.inputs):
            raise RecordingError(
                f"the log's commands are {', '.join(self._inputs)}, the model's "
                f"{', '.join(names(model.inputs))}",
                where=str(self.path),
            )
        plant = config.get("plant")
        sensors = plant.get("sensors") if isinstance(plant, Mapping) else None
        declared = Sensors() if sensors is None else build(sensors, "plant.sensors")
        (begin, first), (after, _) = self._waiting["/measurement"][:2]
        self._begin = begin
        self._command = np.array(self._waiting["/command"][0][1])
        return self.config.init(
            ObserverSetup(
                model,
                self._sample_time(config, after - begin),
                self._outputs,
                declared.declared_noise(self._outputs),
                np.array(first),
                self._command,
            )
        )

    def _sample_time(self, config: Mapping[str, Any], step: float) -> float:
        simulation = config.get("sim")
        logged = simulation.get("sample_time") if isinstance(simulation, Mapping) else None
        is_replay = "recording.file" in self._tail.run
        return float(logged) if isinstance(logged, int | float) and not is_replay else step

    def _logged_config(self) -> dict[str, Any]:
        import yaml

        from trms_cli.core.yaml_data import load_yaml

        try:
            config = load_yaml(self._tail.config)
        except yaml.YAMLError as error:
            raise RecordingError(
                f"the log's configuration is not valid YAML: {error}", where=str(self.path)
            ) from None
        if not isinstance(config, dict):
            raise RecordingError("the log has no configuration", where=str(self.path))
        refuse_objects(config.get("model"), "model", str(self.path))
        return config
