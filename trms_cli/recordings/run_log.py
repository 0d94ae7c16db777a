"""Writes a run's MCAP log: one file a run, readable whatever happens to the run.

The loop only appends tuples to a list; they become JSON and MCAP records in :meth:`flush`,
which the loop calls once a simulated second. A flush ends the MCAP chunk, because a reader
of a killed run's file gets whole chunks only. Messages are JSON with JSON schemas; the log
time is the run's time in nanoseconds from zero.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from itertools import chain, starmap
from pathlib import Path
from types import FrameType
from typing import Any, Literal, Self

import msgspec
import numpy as np

from trms_cli import __version__
from trms_cli.core.errors import RecordingError
from trms_cli.core.whole_file import BINARY, NO_ROOM, explain_os_error
from trms_cli.recordings.chunk_writer import ChunkWriter, Messages
from trms_cli.recordings.topics import (
    EVENT_TOPIC,
    RUN_METADATA,
    SCORE_METADATA,
    EncodedTopic,
    Topic,
)


class AppendStream:
    """Collects bytes for a new file and hands them to the operating system on :meth:`flush`.

    A step that fails half-way (full disk) is cut off again, so that the file always ends where the
    last good step ended. What a flush has passed to the system outlives SIGKILL of this process; it
    is not forced to the platters, a power cut may still lose it.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | BINARY, 0o666)
        self._pending = bytearray()
        self._size = 0

    def write(self, data: bytes) -> int:
        """Collect ``data``; nothing reaches the file yet."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Return the position in the file [bytes] at which the next data will stand."""
        return self._size + len(self._pending)

    def flush(self) -> None:
        """Write what is collected; on failure restore the file's end and raise OSError."""
        data = memoryview(bytes(self._pending))
        self._pending.clear()
        written = 0
        try:
            while written < len(data):
                written += os.write(self._descriptor, data[written:])
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            raise
        self._size += written

    def close(self) -> None:
        """Close the file; what was not flushed is dropped."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


#: ``landed``: the rig had to be landed before the end
Outcome = Literal["completed", "interrupted", "landed", "failed"]

RUN_SCHEMA = "trms.run/1"
LIBRARY = f"trms {__version__}"

#: A loop that never flushes still does not fill the memory.
_MAX_BUFFERED_ROWS = 100_000


class RunLog:
    """An open log. Also a context manager: it closes with the outcome of its block.

    ``path``: file to create, with its folders; never an existing one. ``topics``: what will be
    written; /event is added when it is missing. A message of an encoded topic is one value: its
    JSON as bytes. ``run_metadata``: goes into the ``trms.run`` record: command, seed, versions, git
    revision, … ``attachments``: media type and content by file name: the resolved config, the
    parameters. ``publish_time``: what messages carry as such: the wall clock (simulated runs), or
    the log time itself (recordings of a rig). ``every``: topics of which each so many-th row of
    :meth:`write_rows` is kept, from the first on; 0 for none.

    Raises RecordingError when the file exists or cannot be created, and from any later write that
    fails. A failed write leaves everything up to the last flush readable.
    """

    def __init__(
        self,
        path: Path | str,
        topics: Sequence[Topic | EncodedTopic],
        run_metadata: Mapping[str, str],
        attachments: Mapping[str, tuple[str, bytes]] | None = None,
        *,
        publish_time: Literal["wall", "log"] = "wall",
        every: Mapping[str, int] | None = None,
    ) -> None:
        self.path = Path(path)
        self._every = dict(every or {})
        self._passed = dict.fromkeys(self._every, 0)  # rows of these so far
        self.safe_until_s: float | None = None  # run time up to which the file holds all
        self._wall_clock = publish_time == "wall"
        self._buffered = 0  # rows
        self._last_time_ns = 0
        self._run = {
            "schema": RUN_SCHEMA,
            "start": _now(),
            **{str(key): str(value) for key, value in run_metadata.items()},
        }
        self._is_closed = False
        self._stream = self._create()
        self._writer = ChunkWriter(self._stream, LIBRARY)
        # All of this before any sample, so that a killed run still tells what it was.
        self._writer.add_metadata(RUN_METADATA, self._run)
        now = time.time_ns()
        for name, (media_type, data) in (attachments or {}).items():
            self._writer.add_attachment(name, media_type, data, now)
        self._channels = {topic.name: self._register(topic) for topic in topics}
        if EVENT_TOPIC.name not in self._channels:
            self._channels[EVENT_TOPIC.name] = self._register(EVENT_TOPIC)
        self._flush_stream()

    def write(self, topic: str, time_ns: int, values: Sequence[Any] | np.ndarray) -> None:
        """Log one message at a run time [ns]; it is kept until :meth:`flush`.

        ``values``: in the order of the topic's fields; a field of kind "array" takes a (k,) array.
        """
        self._append(self._channel(topic), time_ns, values)

    def writer(self, topic: str) -> Callable[[int, Sequence[Any]], None]:
        """Return :meth:`write` for one topic: what a loop calls several times a step."""
        return partial(self._append, self._channel(topic))

    def write_rows(
        self,
        times_ns: Sequence[int],
        wall_ns: Sequence[int],
        rows: Mapping[str, Sequence[Sequence[Any]] | np.ndarray],
    ) -> None:
        """Log rows of several topics at the same run times; they are kept until :meth:`flush`.

        ``times_ns``, ``wall_ns``: n each, run time and wall clock. ``rows``: n rows of each topic,
        (n, fields) where all are numbers.
        """
        published = wall_ns if self._wall_clock else times_ns
        for topic, values in rows.items():
            channel, kept = self._channel(topic), self._kept(topic, len(times_ns))
            new = values[kept]
            plain = new.tolist() if isinstance(new, np.ndarray) else new
            channel.pending.append((times_ns[kept], published[kept], plain))
            self._note(len(times_ns))

    def _kept(self, topic: str, count: int) -> slice:
        """Which of the next rows of a topic are kept."""
        every = self._every.get(topic, 1)
        if every == 1:
            return slice(None)
        passed = self._passed[topic]
        self._passed[topic] = passed + count
        return slice(-passed % every, None, every) if every else slice(0)

    def _append(self, channel: _Channel, time_ns: int, values: Sequence[Any] | np.ndarray) -> None:
        if channel.has_arrays:
            values = [v.tolist() if isinstance(v, np.ndarray) else v for v in values]
        elif type(values) is np.ndarray:
            values = values.tolist()
        wall = time.time_ns() if self._wall_clock else time_ns
        channel.pending.append(((time_ns,), (wall,), (tuple(values),)))
        self._note(1)

    def _note(self, count: int) -> None:
        """Count the rows that came, and make sure that they do not fill the memory."""
        self._buffered += count
        if self._buffered >= _MAX_BUFFERED_ROWS:
            self.flush()

    def _channel(self, topic: str) -> _Channel:
        try:
            return self._channels[topic]
        except KeyError:
            raise KeyError(f"no topic {topic!r} in this log: {', '.join(self._channels)}") from None

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = float("nan")
    ) -> None:
        """Log that something happened at run time ``time_ns`` [ns]."""
        self.write(EVENT_TOPIC.name, time_ns, (kind, source, message, value))

    def flush(self) -> None:
        """Pass everything so far to the operating system; a killed process keeps it."""
        if self._is_closed or not self._buffered:
            return
        with _DeferredInterrupt():  # Ctrl-C amid a record would spoil the chunk
            self._buffered = 0
            messages = [channel.take() for channel in self._channels.values()]
            self._writer.add_chunk(messages)
            last = max(max(group.log_times, default=0) for group in messages)
            self._last_time_ns = max(self._last_time_ns, last)
            self._flush_stream()
            self.safe_until_s = self._last_time_ns * 1e-9

    def close(self, outcome: Outcome, score: Mapping[str, Any] | None = None) -> None:
        """Finish the file; a second call does nothing.

        ``outcome``: how the run ended. ``score``: becomes the ``trms.score`` record; each value is
        written as JSON text.
        """
        if self._is_closed:
            return
        self.flush()
        with _DeferredInterrupt():
            end = {"end": _now(), "outcome": outcome, "last_time_s": f"{self._last_time_ns / 1e9}"}
            self._writer.add_metadata(RUN_METADATA, {**self._run, **end})
            if score is not None:
                texts = {str(key): _encode(value).decode() for key, value in score.items()}
                self._writer.add_metadata(SCORE_METADATA, texts)
            self._writer.finish()
            self._flush_stream()
            self._is_closed = True
            self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close("completed")
            return
        try:
            self.close("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
        except RecordingError as second:
            # The run's own failure matters more; it is already on its way up.
            error.add_note(str(second))

    def _create(self) -> AppendStream:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            return AppendStream(self.path)
        except FileExistsError as error:
            if self.path.parent.is_dir():
                raise RecordingError(
                    "there is a log of this name already; nothing is overwritten unasked",
                    where=str(self.path),
                    remedy="give another out=FOLDER, or move the old log away",
                ) from error
            raise explain_os_error(error, self.path, "give another out=FOLDER") from error
        except OSError as error:
            remedy = "" if error.errno in NO_ROOM else "give a folder of your own: out=FOLDER"
            raise explain_os_error(error, self.path, remedy) from error

    def _register(self, topic: Topic | EncodedTopic) -> _Channel:
        if isinstance(topic, EncodedTopic):  # its messages are JSON already
            number = self._writer.add_channel(topic.name, topic.schema_name, topic.schema)
            return _Channel(number, False, _encoded)
        schema = json.dumps(topic.json_schema(), ensure_ascii=False).encode()
        number = self._writer.add_channel(topic.name, topic.schema_name, schema)
        return _Channel(number, any(f.kind == "array" for f in topic.fields), _encoder(topic))

    def _flush_stream(self) -> None:
        """Hand on what is written; after a failure close, and say what is safe."""
        try:
            self._stream.flush()
        except OSError as error:
            raise self._abandon(error) from error

    def _abandon(self, error: OSError) -> RecordingError:
        self._is_closed = True
        self._stream.close()
        if self.safe_until_s is None:
            consequence = "nothing of the run is in the log"
        else:
            consequence = f"the log is safe up to {self.safe_until_s:.3f} s of the run"
        explained = explain_os_error(error, self.path)
        explained.problem = f"{explained.problem}; {consequence}"
        return explained


@dataclass(slots=True)
class _Channel:
    """A topic's MCAP channel, what makes JSON of its rows, and those that are not written yet."""

    id: int
    has_arrays: bool
    encode: Callable[[Sequence[Sequence[Any]]], list[bytes]]
    #: Run times and publish times, ns, and the rows of these; in one piece, so that Ctrl-C comes
    #: before all or after all
    pending: list[tuple[Sequence[int], Sequence[int], Sequence[Sequence[Any]]]] = field(
        default_factory=list
    )

    def take(self) -> Messages:
        """The rows so far as messages; none of them is left, whether or not they can be encoded."""
        pending, self.pending = self.pending, []
        times = chain.from_iterable(piece[0] for piece in pending)
        published = chain.from_iterable(piece[1] for piece in pending)
        rows = list(chain.from_iterable(piece[2] for piece in pending))
        return Messages(self.id, list(times), list(published), self.encode(rows))


def _encoded(rows: Sequence[Sequence[bytes]]) -> list[bytes]:
    return [row[0] for row in rows]


def _encoder(topic: Topic) -> Callable[[Sequence[Sequence[Any]]], list[bytes]]:
    """Makes JSON of a topic's rows; numbers that are not finite become null."""
    # A struct encodes in a third of the time of a dict. Its attributes are numbered, because a
    # field may have any name.
    names = {f"f{index}": name for index, name in enumerate(topic.field_names)}
    message = msgspec.defstruct("Message", [(key, Any) for key in names], rename=names, gc=False)

    def encode(rows: Sequence[Sequence[Any]]) -> list[bytes]:
        try:
            return list(map(_encode, starmap(message, rows)))
        except TypeError:
            values = next((row for row in rows if len(row) != len(names)), None)
            if values is None:
                raise
            raise ValueError(
                f"{topic.name} takes {len(names)} values ({', '.join(topic.field_names)}), "
                f"got {len(values)}: {values!r}"
            ) from None

    return encode


def _plain(value: Any) -> Any:
    """Turn NumPy's numbers and arrays into Python's, for the encoder."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"a log takes numbers, text and arrays of numbers, not {value!r}")


_encode = msgspec.json.Encoder(enc_hook=_plain).encode


class _DeferredInterrupt:
    """Holds Ctrl-C back until the block is done, then delivers it."""

    def __enter__(self) -> None:
        self._pending_signal: tuple[int, FrameType | None] | None = None
        self._previous: Any = None
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.getsignal(signal.SIGINT)
            if self._previous is not None:
                signal.signal(signal.SIGINT, self._keep)

    def _keep(self, number: int, frame: FrameType | None) -> None:
        self._pending_signal = (number, frame)

    def __exit__(self, *_: object) -> None:
        if self._previous is None:
            return
        signal.signal(signal.SIGINT, self._previous)
        if self._pending_signal and callable(self._previous):
            self._previous(*self._pending_signal)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
