"""The structure of a MAT file, walked through before a reader is let at it.

SciPy's reader trusts what a file says of itself: a damaged type number ends the process, a
compressed variable of a kilobyte unpacks to gigabytes, and an empty text may claim any length. The
walk follows the format (MathWorks, "MAT-File Level 5 File Format") and touches no value. It tells
which variables hold nothing but numbers, text, cells and structs; others (objects, functions,
sparse matrices) are left to nobody.
"""

import math
import struct
import zlib
from dataclasses import dataclass

from trms_cli.core.data_file import MEBIBYTE, largest

#: Of a file, and of what it unpacks to.
USUAL_MOST = 128 * MEBIBYTE
_HEADER = 128  # bytes: text, version, byte order
_MATRIX, _COMPRESSED = 14, 15
_INT8, _INT32, _UINT32, _UTF8 = 1, 5, 6, 16
_NUMBERS = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13})
_TEXTS = frozenset({1, 2, 3, 4, 16, 17, 18})
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMERIC = range(6, 16)
_COMPLEX = 0x800
_DEEPEST = 16
_MOST_DIMENSIONS = 32
_MOST_EMPTY = 1_000_000  # elements of an array that takes no bytes


class MalformedFile(ValueError):
    """The file is not of the format, or claims more than it holds."""


class _NotPlain(Exception):
    """A variable of a kind that is no data of a recording."""


@dataclass(frozen=True)
class _Element:
    """One tagged part: its type, and where its bytes begin and end."""

    kind: int
    begin: int
    end: int


@dataclass(frozen=True)
class _Header:
    """What a matrix says before its values."""

    kind: int
    is_complex: bool
    count: int
    name: str
    end: int  # of the header


def is_level_5(data: bytes) -> bool:
    """Whether the file is of level 5 (MATLAB 5 to 7.2), and not of level 4 or HDF5."""
    return len(data) >= _HEADER and 0 not in data[:4] and 1 in (data[124], data[125])


def plain_variables(data: bytes) -> list[str]:
    """Walk through a file of level 5.

    Returns names of the variables that hold numbers, text, cells and structs alone. Raises
    Malformed if a part does not lie inside of what it is a part of, is of no known type, or claims
    more elements than there are bytes.
    """
    order = "<" if data[126:128] == b"IM" else ">"
    names: list[str] = []
    room = largest(USUAL_MOST)
    position = _HEADER
    while position < len(data):
        tag = _full_tag(data, position, len(data), order)
        position = tag.end
        body, element = data, tag
        if tag.kind == _COMPRESSED:
            body = _unpacked(data[tag.begin : tag.end], room)
            room -= len(body)
            element = _full_tag(body, 0, len(body), order)
        if element.kind != _MATRIX:
            raise MalformedFile(f"a part of the type {element.kind} where a variable belongs")
        walk = _Walk(body, order)
        header = walk.header(element)
        try:
            walk.values(header, element, 0)
        except _NotPlain:
            continue
        names.append(header.name)
    return names


def _unpacked(data: bytes, room: int) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(data, room + 1)
    except zlib.error as error:
        raise MalformedFile(f"a compressed variable is damaged ({error})") from error
    if len(content) > room:
        raise MalformedFile(f"it unpacks to more than {largest(USUAL_MOST) / MEBIBYTE:,.0f} MiB")
    return content


def _full_tag(data: bytes, at: int, end: int, order: str) -> _Element:
    if end - at < 8:
        raise MalformedFile("it ends in the middle of a variable")
    kind, size = struct.unpack_from(f"{order}II", data, at)
    if size > end - at - 8:
        raise MalformedFile("a variable is longer than the file")
    return _Element(kind, at + 8, at + 8 + size)


@dataclass(frozen=True)
class _Walk:
    """Through one variable."""

    data: bytes
    order: str

    def element(self, at: int, end: int) -> tuple[_Element, int]:
        """A part, which may be of the short form, and where the next one begins."""
        if end - at < 8:
            raise MalformedFile("a part is cut off")
        word, size = struct.unpack_from(f"{self.order}II", self.data, at)
        if word >> 16:  # up to four bytes inside of the tag
            if word >> 16 > 4:
                raise MalformedFile("a short part of more than four bytes")
            return _Element(word & 0xFFFF, at + 4, at + 4 + (word >> 16)), at + 8
        part = _full_tag(self.data, at, end, self.order)
        padded = size if part.kind == _MATRIX else -(-size // 8) * 8
        return part, min(at + 8 + padded, end)

    def header(self, matrix: _Element) -> _Header:
        flags, at = self.element(matrix.begin, matrix.end)
        if flags.kind != _UINT32 or flags.end - flags.begin != 8:
            raise MalformedFile("a variable without its kind")
        (word,) = struct.unpack_from(f"{self.order}I", self.data, flags.begin)
        kind = word & 0xFF
        if kind == 17:  # opaque: names of classes follow, no dimensions
            name, at = self.element(at, matrix.end)
            return _Header(kind, False, 0, self._text(name), at)
        dimensions, at = self.element(at, matrix.end)
        sizes = self._integers(dimensions)
        if not 2 <= len(sizes) <= _MOST_DIMENSIONS or min(sizes) < 0:
            raise MalformedFile(f"a variable of the dimensions {sizes[:_MOST_DIMENSIONS]}")
        name, at = self.element(at, matrix.end)
        if name.kind not in (_INT8, _UTF8):
            raise MalformedFile("a variable without a name")
        return _Header(kind, bool(word & _COMPLEX), math.prod(sizes), self._text(name), at)

    def values(self, header: _Header, matrix: _Element, depth: int) -> None:
        if depth > _DEEPEST:
            raise MalformedFile(f"cells or structs nest deeper than {_DEEPEST} levels")
        at, end = header.end, matrix.end
        if header.kind in _NUMERIC:
            for _ in range(1 + header.is_complex):
                part, at = self.element(at, end)
                self._require(part, _NUMBERS, header.count)
        elif header.kind == _CHAR:
            part, at = self.element(at, end)
            self._require(part, _TEXTS, header.count)
        elif header.kind == _CELL:
            self._matrices(header.count, at, end, depth)
        elif header.kind == _STRUCT:
            length, at = self.element(at, end)
            lengths = self._integers(length)
            names, at = self.element(at, end)
            if len(lengths) != 1 or not 0 < lengths[0] <= 256 or names.kind != _INT8:
                raise MalformedFile("a struct without names")
            fields = (names.end - names.begin) // lengths[0]
            if not fields and header.count > _MOST_EMPTY:
                raise MalformedFile(f"an empty struct of {header.count} elements")
            self._matrices(header.count * fields, at, end, depth)
        else:
            raise _NotPlain

    def _matrices(self, count: int, at: int, end: int, depth: int) -> None:
        if count * 8 > end - at:
            raise MalformedFile(f"{count} elements in {end - at} bytes")
        for _ in range(count):
            inner, at = self.element(at, end)
            if inner.kind != _MATRIX:
                raise MalformedFile(f"a part of the type {inner.kind} where a matrix belongs")
            if inner.end > inner.begin:  # an empty one is a tag alone
                self.values(self.header(inner), inner, depth + 1)

    def _require(self, part: _Element, kinds: frozenset[int], count: int) -> None:
        size = part.end - part.begin
        if part.kind not in kinds:
            raise MalformedFile(f"values of the type {part.kind}")
        if count > (size or _MOST_EMPTY):
            raise MalformedFile(f"{count} elements in {size} bytes")

    def _integers(self, part: _Element) -> tuple[int, ...]:
        size = part.end - part.begin
        if part.kind not in (_INT32, _UINT32) or size % 4 or size > 4 * _MOST_DIMENSIONS:
            raise MalformedFile("a list of sizes that is none")
        return struct.unpack_from(f"{self.order}{size // 4}i", self.data, part.begin)

    def _text(self, part: _Element) -> str:
        return self.data[part.begin : part.end].decode("latin-1").rstrip("\0")
