"""Adds the 3D view to a log while it is written: a pose every few samples.

Stands between a run's history and its log. The loop knows nothing of it: what it logs of the
angles and commands is remembered, and every so many samples a pose is made of it. A log
that was written already gains the same poses in a copy; one that has some is given new ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core.scene import GHOSTS
from trms_cli.core.whole_file import whole_file
from trms_cli.recordings.chunk_writer import ChunkWriter, Messages
from trms_cli.recordings.foxglove import types as foxglove
from trms_cli.recordings.foxglove.messages import Attitudes, SceneEncoder, log_line
from trms_cli.recordings.run_log import LIBRARY, RunLog

if TYPE_CHECKING:
    from mcap.records import Metadata

    from trms_cli.recordings.log_reader import LoggedRun

#: Where an attitude is read, best first: a simulated rig knows it, another has measured it.
_RIG = ("/plant/state", "/measurement", "/estimate")
_GHOSTS = {"reference": "/reference", "estimate": "/estimate"}
_COMMANDS = "/command"
_YAW, _PITCH = "alpha_h", "alpha_v"

Row = Sequence[Any]


@dataclass(frozen=True)
class Sources:
    """Where in a log the attitudes and commands of a scene stand."""

    #: By prefix of the frames (``""``, ``reference_``, ``estimate_``): the topic, and the places of
    #: yaw and pitch in its rows; None for an axis that it does not have
    attitudes: Mapping[str, tuple[str, int | None, int | None]]
    #: For each arrow its command's place in a row of /command, and the command's limit
    commands: tuple[tuple[int | None, float], ...]

    @property
    def ghosts(self) -> tuple[str, ...]:
        """Whose attitudes there are beside the rig's."""
        return tuple(ghost for ghost in GHOSTS if f"{ghost}_" in self.attitudes)


def find_sources(
    fields: Mapping[str, Sequence[str]],
    limits: Mapping[str, float],
    arrows: Sequence[str] = ("u_v", "u_h"),
) -> Sources | None:
    """Where the attitudes stand in a log; None if it has none: of a motor alone, say.

    ``fields``: names of each topic's fields, in the order of its rows. ``limits``: largest command
    by name; 1 where there is none. ``arrows``: names of the commands that are shown.
    """

    def place(topic: str, name: str) -> int | None:
        names = list(fields.get(topic, ()))
        return names.index(name) if name in names else None

    def attitude(topic: str) -> tuple[str, int | None, int | None] | None:
        yaw, pitch = place(topic, _YAW), place(topic, _PITCH)
        return None if yaw is None and pitch is None else (topic, yaw, pitch)

    rig = next((source for source in map(attitude, _RIG) if source is not None), None)
    if rig is None:
        return None
    attitudes = {"": rig}
    for ghost, topic in _GHOSTS.items():
        source = attitude(topic)
        if source is not None and topic != rig[0]:
            attitudes[f"{ghost}_"] = source
    commands = tuple((place(_COMMANDS, name), limits.get(name) or 1.0) for name in arrows)
    return Sources(attitudes, commands)


class PoseMemory:
    """Attitudes as last known: a lost sample leaves the picture where it was."""

    def __init__(self, sources: Sources) -> None:
        self._sources = sources
        self._poses: dict[str, tuple[float, float]] = {}

    def take(self, rows: Mapping[str, Row]) -> tuple[Attitudes, list[float]]:
        """Attitudes by prefix, and each command over its limit, from the topics' present rows."""
        poses = self._poses
        for prefix, (topic, yaw, pitch) in self._sources.attitudes.items():
            row = rows.get(topic)
            if row is None:
                continue
            turned = 0.0 if yaw is None else row[yaw]
            raised = 0.0 if pitch is None else row[pitch]
            if not (turned - turned == 0.0 and raised - raised == 0.0):  # not finite
                before = poses.get(prefix, (0.0, 0.0))
                turned = turned if math.isfinite(turned) else before[0]
                raised = raised if math.isfinite(raised) else before[1]
            poses[prefix] = (turned, raised)
        row = rows.get(_COMMANDS)
        shares = [
            math.nan if row is None or place is None else row[place] / limit
            for place, limit in self._sources.commands
        ]
        return poses, shares


class SceneLog:
    """A log that gains poses; takes a log's place as the sink of a run's history.

    ``log``: open, with the topics of :func:`~trms_cli.recordings.foxglove.types.encoded_topics`.
    ``every``: samples from one pose to the next.
    """

    def __init__(self, log: RunLog, encoder: SceneEncoder, sources: Sources, every: int) -> None:
        self._log = log
        self._encoder = encoder
        self._every, self._remaining = every, 0
        self._watched = {topic for topic, *_ in sources.attitudes.values()} | {_COMMANDS}
        self._rig_topic = sources.attitudes[""][0]
        self._memory = PoseMemory(sources)
        self._transforms, self._bodies, self._arrows, self._lines = map(
            log.writer, foxglove.SCENE_TOPICS
        )
        self._empty = True

    def write_rows(
        self,
        times_ns: Sequence[int],
        wall_ns: Sequence[int],
        rows: Mapping[str, Sequence[Row] | np.ndarray],
    ) -> None:
        """Log rows of several topics, and poses where they have the rig's attitude."""
        self._log.write_rows(times_ns, wall_ns, rows)
        if self._rig_topic not in rows:
            return
        first, self._remaining = self._remaining, (self._remaining - len(times_ns)) % self._every
        watched = {
            topic: np.asarray(values).tolist()
            for topic, values in rows.items()
            if topic in self._watched
        }
        for k in range(first, len(times_ns), self._every):
            self._pose(times_ns[k], {topic: values[k] for topic, values in watched.items()})

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = math.nan
    ) -> None:
        """Log an event, and its line."""
        self._log.event(time_ns, kind, source, message, value)
        self._lines(time_ns, (log_line(time_ns, kind, source, message),))

    def flush(self) -> None:
        """Make everything so far safe."""
        self._log.flush()

    def _pose(self, time_ns: int, rows: Mapping[str, Row]) -> None:
        if self._empty:
            self._empty = False
            self._bodies(time_ns, (self._encoder.bodies(time_ns),))
        attitudes, shares = self._memory.take(rows)
        self._transforms(time_ns, (self._encoder.transforms(time_ns, attitudes),))
        self._arrows(time_ns, (self._encoder.commands(time_ns, shares),))


_SECOND = 1_000_000_000  # ns


def scene_messages(
    log: LoggedRun, encoder: SceneEncoder, sources: Sources, every: int
) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time (ns) and JSON of the bodies, of each pose and of each event's line.

    ``sources``: places in the log's columns, in their order. ``every``: samples from one pose to
    the next.
    """
    times = log.tables[sources.attitudes[""][0]].time_ns[::every]
    rows = {
        topic: np.column_stack(list(log.tables[topic].last_values(times).values())).tolist()
        for topic in {source[0] for source in sources.attitudes.values()} | {"/command"}
        if topic in log.tables and len(log.tables[topic])
    }
    memory = PoseMemory(sources)
    for k, time_ns in enumerate(times.tolist()):
        if k == 0:
            yield foxglove.BODIES, time_ns, encoder.bodies(time_ns)
        attitudes, shares = memory.take(
            {topic: topic_rows[k] for topic, topic_rows in rows.items()}
        )
        yield foxglove.TRANSFORMS, time_ns, encoder.transforms(time_ns, attitudes)
        yield foxglove.ARROWS, time_ns, encoder.commands(time_ns, shares)
    events = log.tables.get("/event")
    if events is not None:
        fields = (events.columns[name] for name in ("kind", "source", "message"))
        for time_ns, *words in zip(events.time_ns.tolist(), *fields, strict=True):
            yield foxglove.LOG_LINES, time_ns, log_line(time_ns, *(word or "" for word in words))


def write_with_scene(
    log: LoggedRun,
    encoder: SceneEncoder,
    sources: Sources,
    every: int,
    path: Path,
    *,
    force: bool = False,
) -> int:
    """Copy a log and add the 3D view; the number of poses. The file appears when it is whole.

    Messages, metadata and attachments are those of the log, byte for byte, as far as it is intact.

    Raises RecordingError when the file exists and ``force`` is not given, or cannot be written.
    """
    added = list(scene_messages(log, encoder, sources, every))
    with whole_file(path, force=force) as temporary, temporary.open("wb") as file:
        writer = ChunkWriter(file, LIBRARY)
        pending, last_words = _copy_words(log.path, writer)
        numbers = {
            topic.name: writer.add_channel(topic.name, topic.schema_name, topic.schema)
            for topic in foxglove.encoded_topics()
        }
        pending += [(numbers[topic], time_ns, time_ns, data) for topic, time_ns, data in added]
        pending.sort(key=lambda message: message[1])
        _write_chunks(writer, pending)
        for metadata in last_words:
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()
    return sum(topic == foxglove.TRANSFORMS for topic, _, _ in added)


_Pending = list[tuple[int, int, int, bytes]]


def _copy_words(path: Path, writer: ChunkWriter) -> tuple[_Pending, list[Metadata]]:
    """Copy attachments, channels and the metadata before the samples; samples, and the rest."""
    from mcap.records import Attachment, Channel, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader

    pending: _Pending = []
    schemas: dict[int, Schema] = {}
    numbers: dict[int, int] = {}
    last_words: list[Metadata] = []
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=False).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    if record.id not in numbers and record.topic not in foxglove.SCENE_TOPICS:
                        schema = schemas[record.schema_id]
                        numbers[record.id] = writer.add_channel(
                            record.topic, schema.name, schema.data
                        )
                elif isinstance(record, Message):
                    if record.channel_id in numbers:
                        number = numbers[record.channel_id]
                        times = record.log_time, record.publish_time
                        pending.append((number, *times, record.data))
                elif isinstance(record, Attachment):
                    writer.add_attachment(
                        record.name, record.media_type, record.data, record.create_time
                    )
                elif isinstance(record, Metadata):
                    if pending:
                        last_words.append(record)
                    else:
                        writer.add_metadata(record.name, record.metadata)
        except Exception:  # the log of a run that died ends in the middle of a record
            if not pending:
                raise
    return pending, last_words


def _write_chunks(writer: ChunkWriter, messages: _Pending) -> None:
    """One chunk a second of the run, as a run writes them."""
    start = 0
    for k, message in enumerate(messages):
        if message[1] - messages[start][1] >= _SECOND:
            writer.add_chunk(_by_channel(messages[start:k]))
            start = k
    writer.add_chunk(_by_channel(messages[start:]))


def _by_channel(messages: _Pending) -> list[Messages]:
    groups: dict[int, list[tuple[int, int, bytes]]] = {}
    for channel, log_time, publish_time, data in messages:
        groups.setdefault(channel, []).append((log_time, publish_time, data))
    return [Messages(channel, *zip(*group, strict=True)) for channel, group in groups.items()]
