"""The frames that go to a rig and come back, byte by byte; docs/rig-frames.md is their contract.

All numbers are little-endian::

    offset  bytes  what
    0       4      "TRMS"
    4       1      version of the frames: 1
    5       1      kind, see :class:`Kind`
    6       2      n, how many numbers follow the head, at most 64
    8       4      sequence number; an answer has that of what it answers
    12      4      session, drawn by the computer when it connects
    16      8      time of the sender's clock, µs, from any moment
    24      4      sequence number of the last command that was applied (of the rig)
    28      4      status of the rig, see :class:`RigStatus`
    32      4 n    numbers, IEEE 754 of 32 bits
    32+4n   4      CRC-32 of all before (that of zlib, Ethernet and PNG)
"""

from __future__ import annotations

import enum
import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from trms_cli.core.errors import ConfigurationError

MAGIC = b"TRMS"
VERSION = 1
MOST_NUMBERS = 64
_HEAD = struct.Struct("<4sBBHIIQII")
_CRC = struct.Struct("<I")
_LEAST = _HEAD.size + _CRC.size
#: Sequence numbers begin anew after this many.
SEQUENCE_RANGE = 2**32


class Kind(enum.IntEnum):
    """What a frame is for; even ones are answers of the rig."""

    HELLO = 1  #: Numbers: sample time (s), watchdog (s), number of commands, of readings
    WELCOME = 2  #: Numbers: the rig's watchdog (s), its number of commands, of readings
    READ = 3  #: Asks for a reading; no numbers
    READING = 4  #: Numbers: the channels, in the order of the wiring
    COMMAND = 5  #: Numbers: the commands; not answered
    ARM = 7  #: From now on commands act; answered by a READING
    DISARM = 9  #: Safe command at once, commands no longer act; answered by a READING


class RigStatus(enum.IntFlag):
    """Bits of a rig's status."""

    ARMED = 1
    WATCHDOG = 2  #: No command came in time since it was armed: the safe command acts
    EMERGENCY = 4  #: Somebody pressed the emergency stop
    FAULT = 8  #: The rig's own electronics report a fault


class BadFrame(ConfigurationError):
    """Bytes that are no frame of this version."""


@dataclass(frozen=True)
class Frame:
    """One message."""

    kind: int  #: See :class:`Kind`; of another version of the frames perhaps none of them
    sequence: int
    session: int
    time: int = 0  #: µs of the sender's clock
    applied: int = 0  #: Sequence number of the last command that was applied
    status: int = 0  #: See :class:`RigStatus`
    numbers: tuple[float, ...] = ()  #: In the units of the wiring

    def encode(self) -> bytes:
        """As it goes over the wire."""
        head = _HEAD.pack(
            MAGIC,
            VERSION,
            self.kind,
            len(self.numbers),
            self.sequence,
            self.session,
            self.time,
            self.applied,
            self.status,
        )
        body = head + struct.pack(f"<{len(self.numbers)}f", *self.numbers)
        return body + _CRC.pack(zlib.crc32(body))


def decode(data: bytes) -> Frame:
    """A frame from one datagram.

    Raises BadFrame for what is none: another magic or version, a length or a checksum that is
    wrong.
    """
    if len(data) < _LEAST or data[:4] != MAGIC:
        raise BadFrame(f"{len(data)} bytes that are no frame: {data[:8].hex(' ')} …")
    if data[4] != VERSION:
        raise BadFrame(
            f"a frame of version {data[4]}, this program speaks version {VERSION}",
            remedy="use the same version of the frames on both sides (docs/rig-frames.md)",
        )
    _, _, kind, count, sequence, session, time, applied, status = _HEAD.unpack_from(data)
    length = _length(count)
    if count > MOST_NUMBERS or len(data) != length:
        raise BadFrame(f"a frame of {len(data)} bytes that says it has {count} numbers")
    if zlib.crc32(data[:-4]) != _CRC.unpack_from(data, length - 4)[0]:
        raise BadFrame("a frame whose checksum is wrong")
    numbers = struct.unpack_from(f"<{count}f", data, _HEAD.size)
    return Frame(kind, sequence, session, time, applied, status, numbers)


def _length(count: int) -> int:
    return _HEAD.size + 4 * count + _CRC.size


class FrameStream:
    """Takes bytes of a serial line as they come, and gives whole frames, also after lost bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.lost_bytes = 0  #: That belonged to no frame
        self.refusal = ""  #: Why the last whole candidate was no frame

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Each frame that is complete with these bytes, encoded."""
        buffer = self._buffer
        buffer += data
        while True:
            begin = buffer.find(MAGIC)
            if begin < 0:
                keep = _tail_that_may_begin(buffer)
                self._drop(len(buffer) - keep)
                return
            self._drop(begin)
            if len(buffer) < _HEAD.size:
                return
            count = int.from_bytes(buffer[6:8], "little")
            length = _length(count)
            if count > MOST_NUMBERS:
                self._drop(1)  # four bytes that happen to look like a beginning
                continue
            if len(buffer) < length:
                return
            candidate = bytes(buffer[:length])
            try:
                decode(candidate)
            except BadFrame as error:
                self.refusal = error.problem
                self._drop(1)
                continue
            del buffer[:length]
            yield candidate

    def _drop(self, count: int) -> None:
        self.lost_bytes += count
        del self._buffer[:count]


def _tail_that_may_begin(buffer: bytearray) -> int:
    """How many bytes at the end may be the first of a frame."""
    return next((n for n in (3, 2, 1) if buffer.endswith(MAGIC[:n])), 0)


def is_newer(sequence: int, than: int) -> bool:
    """Whether a sequence number comes after another one, also where they begin anew."""
    return 0 < (sequence - than) % SEQUENCE_RANGE < SEQUENCE_RANGE // 2


def all_finite(numbers: Sequence[float]) -> bool:
    """Whether no number is infinite or none at all."""
    return all(map(math.isfinite, numbers))
