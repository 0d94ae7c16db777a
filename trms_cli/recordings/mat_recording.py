"""Recordings as MAT files: one vector per channel, or a struct per topic as exports have it.

In MATLAB: ``save('rec.mat', 't', 'u_v', 'u_h', 'alpha_v', 'alpha_h')``. Values are in SI
(commands in V) unless a struct ``units`` says otherwise: ``units.alpha_v = 'deg'``. Other
variables that are text become metadata; a single struct that holds all of it is opened.

A file with the structs ``measurement`` and ``command`` (and ``reference``, ``disturbance`` where
there are any) is read as the log that it was exported from: each has its own ``time`` and
``units``, and what lies on other times than the measurement's is held.

The structure of a file is walked through before a reader is let at it: SciPy's trusts what a file
says of itself: a damaged type number ends the process, a compressed variable of a kilobyte unpacks
to gigabytes, and an empty text may claim any length. The walk follows the format (MathWorks,
"MAT-File Level 5 File Format") and touches no value. It tells which variables hold nothing but
numbers, text, cells and structs; others (objects, functions, sparse matrices) are left to nobody.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core.data_file import MEBIBYTE, largest, not_as_written, recorded_bytes, unreadable
from trms_cli.core.errors import RecordingError
from trms_cli.recordings.channels import CHANNELS, Vocabulary, reference_of, to_si
from trms_cli.recordings.recording import Recording, require_channels, require_values

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import TopicTable


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


#: Structs of an exported log that are a recording.
_TOPICS = ("measurement", "command", "reference", "disturbance")
_REMEDY = "save('rec.mat', 't', 'u_v', 'u_h', 'alpha_v', 'alpha_h'), each a vector"


def read_mat(path: Path | str, vocabulary: Vocabulary | None = None) -> Recording:
    """Read a MAT recording into SI units; NaN is a missing sample.

    ``vocabulary``: of the model that it is read for; None: the file's own.
    """
    path = Path(path)
    with not_as_written(str(path)):
        return _recording(path, _variables(path), vocabulary)


def _recording(path: Path, variables: dict[str, Any], vocabulary: Vocabulary | None) -> Recording:
    if "t" not in variables and isinstance(variables.get("measurement"), dict):
        return _of_topics(path, variables, vocabulary)
    units = variables.get("units", {})
    if not isinstance(units, dict):
        raise RecordingError("'units' is not a struct", where=str(path), remedy="units.t = 's'")
    metadata = {name: value for name, value in variables.items() if isinstance(value, str)}
    where, columns = str(path), [name for name in variables if name != "units"]
    vocabulary = vocabulary or Vocabulary.declared(metadata, columns, where)
    ignored = vocabulary.left_out(columns, where)
    own = {str(vocabulary.name_of(name)): name for name in columns if name not in ignored}
    require_channels(list(own), where, vocabulary, ignored)
    time = _vector(path, own["t"], variables[own["t"]])
    time, _ = to_si(time, str(units.get(own["t"], "s")), ("s",), where=where, name=own["t"])
    _check_time(path, time, own["t"])
    del own["t"]
    channels, si_units = _channels(path, variables, units, len(time), own, vocabulary)
    require_values(channels, where, vocabulary)
    ignored = [name for name in ignored if name not in metadata]
    remarks = (f"variables not used: {', '.join(ignored)}",) if ignored else ()
    return Recording(time, channels, si_units, metadata, path, remarks, vocabulary)


def _channels(
    path: Path,
    struct: dict[str, Any],
    units: dict[str, Any],
    samples: int,
    names: Mapping[str, str],
    vocabulary: Vocabulary,
    topic: str = "",
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Vectors of a struct in SI, and their units, by name; ``samples``: as many as there are times.

    ``names``: the struct's name of each. ``topic``: the struct's name in an exported log.
    """
    columns, si_units, dot = {}, {}, f"{topic}." if topic else ""
    for own, name in names.items():
        channel = vocabulary.find(own)
        if channel is None:
            continue
        vector = _vector(path, f"{dot}{name}", struct[name])
        if len(vector) != samples:
            raise RecordingError(
                f"{dot + name!r} has {len(vector)} samples, "
                f"{f'{dot}time' if topic else 't'} has {samples}",
                where=str(path),
                remedy="give each channel a value per time, NaN where it is missing",
            )
        unit = str(units.get(name, channel.units[0] if channel.units else "1"))
        key = name if topic else own
        columns[key], si_units[key] = to_si(
            vector, unit, channel.units, where=str(path), name=f"{dot}{name}"
        )
    return columns, si_units


def _of_topics(path: Path, content: dict[str, Any], vocabulary: Vocabulary | None) -> Recording:
    """Read the layout of ``trms export --format mat``."""
    # imported here: a log's reader is not needed for vectors
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.recordings.mcap_recording import OWN_PREFIX, recording_of

    tables = {f"/{name}": _table(path, name, content[name]) for name in _TOPICS if name in content}
    run = content.get("run", {})
    metadata = {str(k): str(v) for k, v in run.items()} if isinstance(run, dict) else {}
    # a name in MATLAB has no dot
    mangled = OWN_PREFIX.replace(".", "_")
    metadata = {
        OWN_PREFIX + key.removeprefix(mangled) if key.startswith(mangled) else key: text
        for key, text in metadata.items()
    }
    complete = bool(content.get("complete", True))
    problems = () if complete else ("the run that it was exported from did not end",)
    log = LoggedRun(
        path, complete, metadata.get("outcome", "died"), tables, metadata, {}, {}, problems
    )
    recording = recording_of(log, vocabulary)
    require_channels(["t", *recording.channels], str(path), recording.vocabulary)
    require_values(recording.channels, str(path), recording.vocabulary)
    return recording


def _table(path: Path, topic: str, struct: Any) -> TopicTable:
    from trms_cli.recordings.log_reader import TopicTable

    if not isinstance(struct, dict) or "time" not in struct:
        raise RecordingError(
            f"{topic!r} is not a struct with a time",
            where=str(path),
            remedy=f"{topic}.time and the channels beside it, as trms export writes them",
        )
    units = struct.get("units", {})
    if not isinstance(units, dict):
        raise RecordingError(f"'{topic}.units' is not a struct", where=str(path), remedy=_REMEDY)
    time = _vector(path, f"{topic}.time", struct["time"])
    _check_time(path, time, f"{topic}.time")
    names = {
        reference_of(name) if topic == "reference" else name: name
        for name, values in struct.items()
        if name not in ("time", "units") and (name in CHANNELS or not isinstance(values, str))
    }
    own = Vocabulary.of_roles(dict.fromkeys(names, topic))
    columns, si_units = _channels(path, struct, units, len(time), names, own, topic)
    # to the nanosecond, as logs have it
    return TopicTable(time, np.round(time * 1e9).astype(np.int64), columns, si_units)


def _variables(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    data = recorded_bytes(path, USUAL_MOST)
    try:
        names = plain_variables(data) if is_level_5(data) else None
        content = loadmat(BytesIO(data), simplify_cells=True, variable_names=names)
    except OSError as error:
        raise unreadable(error, path) from error
    except MemoryError as error:
        raise RecordingError("it does not fit into the memory", where=str(path)) from error
    except NotImplementedError as error:
        raise RecordingError(
            "this is a MATLAB 7.3 file (HDF5)", where=str(path), remedy="save(..., '-v7')"
        ) from error
    except Exception as error:  # scipy's reader fails in many ways on files of another kind
        raise RecordingError(
            f"it cannot be read as a MAT file ({error})", where=str(path), remedy="save(..., '-v7')"
        ) from error
    variables = {name: value for name, value in content.items() if not name.startswith("__")}
    if len(variables) == 1 and isinstance(only := next(iter(variables.values())), dict):
        return only
    return variables


def _vector(path: Path, name: str, value: Any) -> np.ndarray:
    array = np.atleast_1d(np.squeeze(np.asarray(value)))
    if array.ndim != 1 or array.dtype.kind not in "fiub":
        raise RecordingError(
            f"{name!r} is not a vector of numbers (shape {array.shape})",
            where=str(path),
            remedy=_REMEDY,
        )
    vector = array.astype(float)
    infinite = np.flatnonzero(np.isinf(vector))
    if len(infinite):
        raise RecordingError(
            f"{name}({infinite[0] + 1}) is not finite",
            where=str(path),
            remedy="put NaN where a sample is missing",
        )
    return vector


def _check_time(path: Path, time: np.ndarray, name: str = "t") -> None:
    if len(time) < 2:
        raise RecordingError(
            "there is a single sample", where=str(path), remedy="a recording needs two or more"
        )
    wrong = np.flatnonzero(~(np.diff(time) > 0))
    if len(wrong):
        index = int(wrong[0]) + 1
        raise RecordingError(
            f"time does not rise at {name}({index + 1}): {time[index]:.9g} s after "
            f"{time[index - 1]:.9g} s",
            where=str(path),
            remedy="sort the samples and keep one per time; NaN is no time",
        )
