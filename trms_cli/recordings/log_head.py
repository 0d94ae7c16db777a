"""What a log says of its run, without the samples.

An index of thousands of runs asks each log for its name, its configuration and its score. These
stand in records of their own: the chunks of samples, 99 % of a file, are stepped over unread, so
that a log of any length takes about a millisecond. Their checksums are therefore not looked at;
:func:`trms_cli.recordings.log_reader.read_log` does that.
"""

import os
import struct
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from trms_cli.core.data_file import json_or_none, unreadable
from trms_cli.core.errors import RecordingError
from trms_cli.recordings.topics import CONFIG_ATTACHMENT, RUN_METADATA, SCORE_METADATA

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_LENGTH = struct.Struct("<I")  # of a text or a map, bytes
_HEADER, _FOOTER, _ATTACHMENT, _METADATA = 0x01, 0x02, 0x09, 0x0C  # https://mcap.dev/spec
#: Records of a run's own words are a few kilobytes; what is longer was not written by a run.
_LONGEST = 16 * 2**20  # bytes
#: Buffer: a chunk's index is read in one go, and little is read twice after a step over a chunk.
_BUFFER = 8192


@dataclass(frozen=True)
class LogHead:
    """The words of a log."""

    path: Path
    #: The file has its end. False for a run that was killed, or that is still running.
    finished: bool
    of_trms: bool  #: Written by this program, not by another one that writes MCAP
    run: dict[str, str]  #: The last ``trms.run`` record
    #: dict of str to anything, or None; the last ``trms.score`` record; None for a run that was not
    #: scored
    score: dict[str, Any] | None
    config: str  #: The resolved configuration as YAML; empty when the log has none


@dataclass
class _Words:
    library: str = ""
    finished: bool = False
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    config: bytes = b""


def read_log_head(path: Path | str) -> LogHead:
    """Read what a log says of its run.

    Raises RecordingError when the file cannot be read, is no MCAP file, or a record of its words is
    damaged.
    """
    path = Path(path)
    words = _Words()
    try:
        with path.open("rb", buffering=_BUFFER) as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                empty = path.stat().st_size < len(_MAGIC)
                what = "the file is empty, or cut off in its first bytes"
                raise RecordingError(what if empty else "it is no MCAP file", where=str(path))
            _walk(file, os.fstat(file.fileno()).st_size, words)
    except OSError as error:
        raise unreadable(error, path) from error
    score = words.metadata.get(SCORE_METADATA)
    return LogHead(
        path=path,
        finished=words.finished,
        of_trms=RUN_METADATA in words.metadata or words.library.startswith("trms"),
        run=words.metadata.get(RUN_METADATA, {}),
        score=None if score is None else {key: json_or_none(text) for key, text in score.items()},
        config=words.config.decode(errors="replace"),
    )


def _walk(file: BinaryIO, size: int, words: _Words) -> None:
    """Take the records of words up to the last whole record."""
    position = len(_MAGIC)
    while position + _RECORD.size <= size:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return
        opcode, length = _RECORD.unpack(head)
        position += _RECORD.size
        if length > size - position:
            return
        if opcode == _FOOTER:
            file.seek(-len(_MAGIC), os.SEEK_END)
            words.finished = file.read() == _MAGIC
            return
        if opcode in (_HEADER, _METADATA, _ATTACHMENT) and length <= _LONGEST:
            _take(opcode, file.read(length), words, Path(file.name))
        else:
            file.seek(length, os.SEEK_CUR)
        position += length


def _take(opcode: int, body: bytes, words: _Words, path: Path) -> None:
    from mcap.data_stream import ReadDataStream
    from mcap.records import Attachment, Header

    stream = ReadDataStream(BytesIO(body))
    try:
        if opcode == _HEADER:
            words.library = Header.read(stream).library
        elif opcode == _METADATA:
            name, values = _metadata(body)
            words.metadata[name] = values
        else:
            attachment = Attachment.read(stream)
            if attachment.name == CONFIG_ATTACHMENT:
                words.config = attachment.data
    except Exception as error:  # damage shows as any error of the decoders
        raise RecordingError(f"a record of it is damaged ({error})", where=str(path)) from error


def _metadata(body: bytes) -> tuple[str, dict[str, str]]:
    """A metadata record: its name, and its texts by their names.

    In a fifth of the time of the library's own, which is most of what an index waits for.
    """
    name, position = _text(body, 0)
    (length,) = _LENGTH.unpack_from(body, position)
    position += _LENGTH.size
    end = position + length
    values = {}
    while position < end:
        key, position = _text(body, position)
        values[key], position = _text(body, position)
    return name, values


def _text(body: bytes, position: int) -> tuple[str, int]:
    """A text that stands at a position behind its length, and where it ends."""
    (length,) = _LENGTH.unpack_from(body, position)
    begin = position + _LENGTH.size
    end = begin + length
    if end > len(body):
        raise ValueError("a text is longer than its record")
    return body[begin:end].decode(), end
