"""What a chunk of a log holds, unpacked only as far as there is room for it.

A chunk of a few kilobytes can unpack to gigabytes. So it is unpacked to the size that it claims and
not further, and the chunks of one log together to no more than a limit.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

from trms_cli.core.data_file import MEBIBYTE, largest

if TYPE_CHECKING:
    from mcap.records import Chunk

#: Messages of one log that are kept, and what one chunk unpacks to, however small the file is.
USUAL_MOST = 256 * MEBIBYTE
#: A long run has a large log, which unpacks to some four times its size.
_UNPACKED_TO_FILE = 8
#: All chunks of a log together, of which one is in the memory at a time.
_TOGETHER = 16
#: Numbers in the tables of one log, 8 bytes each. A table of a run is as long as its messages say,
#: but a schema may name any number of columns, and the messages leave them out.
_USUAL_MOST_CELLS = 32 * MEBIBYTE
#: Memory that a compressor may ask for beside the content.
_WINDOW = 64 * MEBIBYTE


class TooMuch(ValueError):
    """There is no room for what a log would unpack to."""


def most_kept(size: int = 0) -> int:
    """Bytes of messages that are kept of a log in a file of `size` bytes."""
    return max(largest(USUAL_MOST), _UNPACKED_TO_FILE * size)


def most_unpacked(size: int = 0) -> int:
    """Bytes that all chunks of such a log may unpack to, one after another."""
    return _TOGETHER * most_kept(size)


def most_cells(size: int = 0) -> int:
    """Numbers that the tables of such a log may hold."""
    return max(_USUAL_MOST_CELLS, most_kept(size) // 8)


def content_of(chunk: Chunk, room: int) -> bytes:
    """The records of a chunk.

    Parameters
    ----------
    chunk : Chunk
    room : int
        Bytes that it may have.

    Raises
    ------
    TooMuch
        If it claims more.
    ValueError
        If it is not what it claims: of another size, damaged, of an unknown compression. The
        checksum is the caller's.
    """
    size = chunk.uncompressed_size
    if size > min(room, most_kept()):
        raise TooMuch(f"it unpacks to more than {min(room, most_kept()) / MEBIBYTE:,.0f} MiB")
    if chunk.compression == "zstd":
        data = _unpacked_zstd(chunk.data, size)
    elif chunk.compression == "lz4":
        data = _unpacked_lz4(chunk.data, size)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"the compression {chunk.compression!r} is not known")
    if len(data) != size:
        raise ValueError(f"a chunk is not of the size that it claims ({size} bytes)")
    return data


def _unpacked_zstd(data: bytes, size: int) -> bytes:
    import zstandard

    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
    with unpacker.stream_reader(data) as stream:
        return bytes(stream.read(size + 1))


def _unpacked_lz4(data: bytes, size: int) -> bytes:
    from importlib import import_module

    unpacker: Any = import_module("lz4.frame").LZ4FrameDecompressor()
    return bytes(unpacker.decompress(data, max_length=size + 1))


def is_damaged(chunk: Chunk, data: bytes) -> bool:
    """Whether the content does not fit its checksum; a chunk without one is taken as it is."""
    return bool(chunk.uncompressed_crc) and zlib.crc32(data) != chunk.uncompressed_crc
