"""Small files that would fill the memory, or end the process, are refused in little of both.

Each is read by a process of its own that may have 2 GiB of address space, as the program would
read it; the answer is a sentence and exit code 2, within some seconds of processor time.
"""

import json
import os
import resource
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

_MEMORY = 2 * 2**30  # bytes of address space
_PATIENCE = 60  # s of processor time for all the files of a reader

_READERS = {
    "log": "from trms_cli.recordings.log_reader import read_log as read",
    "tail": "from trms_cli.recordings.log_reader import LogTail\n"
    "def read(path):\n"
    "    tail = LogTail(path)\n"
    "    while tail.read() is not None: pass\n"
    "    if tail.problems: raise RecordingError(tail.problems[0])",
    "head": "from trms_cli.runs.entry import read_entry as read",
    "csv": "from trms_cli.recordings.csv_recording import read_csv as read",
    "signal": "from trms_cli.references.from_csv import read_columns\n"
    "def read(path): read_columns(Path(path), 'alpha_v')",
    "mat": "from trms_cli.recordings.mat_recording import read_mat as read",
    "model": "from trms_cli.effects.model_file import load_model as read",
    "network": "from trms_cli.models.narx_file import narx\ndef read(path): narx(network=path)",
    "yaml": "from trms_cli.composition.catalogue import read_yaml\n"
    "def read(path): read_yaml(Path(path))",
    "baseline": "from trms_cli.scoring.baseline import read_baseline\n"
    "def read(path): read_baseline(Path(path))",
}
_PROGRAM = """
import sys, time
from pathlib import Path
from trms_cli.core.errors import RecordingError, TrmsError
{reader}
for path in sys.argv[1:]:
    begin = time.process_time()
    try:
        read(path)
        answer = "read"
    except TrmsError as error:
        answer = f"{{error.exit_code}} {{str(error)[:300]!r}}"
    except BaseException as error:
        answer = f"{{type(error).__name__}} {{str(error)[:300]!r}}"
    print(Path(path).stem, round(time.process_time() - begin, 1), answer, flush=True)
"""


def _limited() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (_PATIENCE, _PATIENCE + 5))


def _answers(reader: str, paths: list[Path]) -> list[str]:
    """What the reader says of each file, in a process of its own with little memory."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM.format(reader=_READERS[reader]), *map(str, paths)],
        preexec_fn=_limited,
        env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{done.returncode} after\n{done.stdout}{done.stderr[-2000:]}"
    return done.stdout.splitlines()


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def _log(*records: bytes) -> bytes:
    return b"\x89MCAP0\r\n" + _record(1, _text(b"") + _text(b"trms 1")) + b"".join(records)


def _chunk(data: bytes, size: int, compression: bytes) -> bytes:
    head = struct.pack("<QQQI", 0, 1, size, 0) + _text(compression)
    return _record(6, head + struct.pack("<Q", len(data)) + data)


def _channel(schema: bytes) -> bytes:
    body = struct.pack("<H", 1) + _text(b"/measurement") + _text(b"jsonschema") + _text(schema)
    link = struct.pack("<HH", 1, 1) + _text(b"/measurement") + _text(b"json") + _text(b"")
    return _record(3, body) + _record(4, link)


def _messages(message: bytes, count: int) -> bytes:
    return b"".join(_record(5, struct.pack("<HIQQ", 1, 0, i, i) + message) for i in range(count))


def _zeros(packer: Any) -> bytes:
    """2.5 GiB of them."""
    block = bytes(2**22)
    return b"".join(packer.compress(block) for _ in range(640)) + packer.flush()


def _lz4_log(claimed: int) -> bytes:
    import lz4.frame

    packer = lz4.frame.LZ4FrameCompressor()
    return _log(_chunk(packer.begin() + _zeros(packer), claimed, b"lz4"))


def _zstd_log(claimed: int) -> bytes:
    import zstandard

    return _log(_chunk(_zeros(zstandard.ZstdCompressor(level=3).compressobj()), claimed, b"zstd"))


def _wide_log() -> bytes:
    columns = {f"c{i}": {"type": "number"} for i in range(20_000)}
    return _log(_channel(json.dumps({"properties": columns}).encode()), _messages(b"{}", 20_000))


def _many_messages() -> bytes:
    import zstandard

    data = _messages(b"{}", 200_000)
    packed = _chunk(zstandard.ZstdCompressor().compress(data), len(data), b"zstd")
    return _log(_PITCH, *[packed] * 40)


def _nested(depth: int) -> bytes:
    return b"[" * depth + b"]" * depth


def _mat(*variables: bytes) -> bytes:
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + b"".join(variables)


def _matrix(kind: int, sizes: tuple[int, ...], *parts: bytes, name: bytes = b"t") -> bytes:
    def part(code: int, body: bytes) -> bytes:
        return struct.pack("<II", code, len(body)) + body + bytes(-len(body) % 8)

    body = part(6, struct.pack("<II", kind, 0)) + part(5, struct.pack(f"<{len(sizes)}i", *sizes))
    body += part(1, name) + b"".join(parts)
    return struct.pack("<II", 14, len(body)) + body


def _packed(variable: bytes) -> bytes:
    data = zlib.compress(variable, 9)
    return struct.pack("<II", 15, len(data)) + data


def _mat_of_zeros() -> bytes:
    packer = zlib.compressobj(9)
    values = 2**32 - 256
    head = _matrix(6, (1, values // 8))
    size = struct.pack("<II", 14, values + len(head))
    head = size + head[8:] + struct.pack("<II", 9, values)
    data = packer.compress(head) + _zeros(packer)
    return _mat(struct.pack("<II", 15, len(data)) + data)


def _aliases(width: int, depth: int) -> bytes:
    lines = ["name: &a0 [x, x, x, x]"]
    for i in range(1, depth):
        lines.append(f"k{i}: &a{i} [{', '.join([f'*a{i - 1}'] * width)}]")
    return "\n".join(lines).encode()


def _nested_cells(depth: int) -> bytes:
    inner = _matrix(6, (1, 1), struct.pack("<II", 9, 8) + bytes(8), name=b"")
    for _ in range(depth):
        inner = _matrix(1, (1, 1), inner, name=b"")
    return inner


_HEAD = b"t[s],u_v[V],alpha_v[rad]\n"
_PITCH = _channel(b'{"properties": {"alpha_v": {"type": "number"}}}')
_DEEP_CONFIGURATION = (
    struct.pack("<QQ", 0, 0) + _text(b"config.yaml") + _text(b"")
    + struct.pack("<Q", 200_000) + _nested(100_000) + bytes(4)
)  # fmt: skip
_HOSTILE: dict[str, dict[str, Callable[[], bytes]]] = {
    "log": {
        "a chunk of lz4 that unpacks to 2.5 GiB and says so": lambda: _lz4_log(2**32),
        "a chunk of lz4 that unpacks to 2.5 GiB and claims 1 KiB": lambda: _lz4_log(1024),
        "a chunk of zstd that unpacks to 2.5 GiB and says so": lambda: _zstd_log(2**32),
        "a chunk of zstd that unpacks to 2.5 GiB and claims 1 KiB": lambda: _zstd_log(1024),
        "a schema of 20 000 columns for 20 000 empty messages": _wide_log,
        "eight million messages in 40 chunks": _many_messages,
        "messages that nest 100 000 deep": lambda: _log(
            _PITCH, _messages(b'{"alpha_v": ' + _nested(100_000) + b"}", 3)
        ),
        "a record that claims 2^63 bytes": lambda: _log() + struct.pack("<BQ", 6, 2**63) + b"xx",
    },
    "tail": {
        "a chunk that unpacks to 2.5 GiB, while it is written": lambda: _zstd_log(2**32),
        "a schema of 20 000 columns, while it is written": _wide_log,
        "a schema that nests 100 000 deep": lambda: _log(_channel(_nested(100_000))),
    },
    "head": {
        "a configuration that nests 100 000 deep": lambda: _log(
            _record(12, _text(b"trms.run") + _text(b"")), _record(9, _DEEP_CONFIGURATION)
        ),
    },
    "csv": {
        "one line of 60 MB": lambda: b"t[s]," + b"u_v[V]," * 9_000_000,
        "a million columns": lambda: b",".join(b"d_%d[N]" % i for i in range(1_000_000)),
        "a row of 30 million cells": lambda: _HEAD + b"0,0,0\n" + b"," * 30_000_000,
        "sixty million empty lines": lambda: _HEAD + b"\n" * 60_000_000,
        "sixteen million short rows": lambda: _HEAD + b"1,,\n" * 16_000_000,
        "a number of a million digits": lambda: _HEAD + b"0,0,0\n1," + b"9" * 1_000_000 + b",0\n",
    },
    "signal": {
        "a signal of 30 million cells": lambda: b"t[s],alpha_v[rad]\n" + b"," * 30_000_000,
        "a signal with one cell of 1 MB": lambda: b"t[s],alpha_v[rad]\n0," + b"1" * 1_000_000,
    },
    "mat": {
        "a compressed variable of 2.5 GiB of 4": _mat_of_zeros,
        "a type that is none": lambda: _mat(
            _matrix(6, (1, 3), struct.pack("<II", 63, 24) + bytes(24))
        ),
        "a text of two thousand million letters in no bytes": lambda: _mat(
            _matrix(4, (1, 2**31 - 1), struct.pack("<II", 16, 0))
        ),
        "a cell array of 2^40 elements": lambda: _mat(_matrix(1, (2**20, 2**20))),
        "cells in cells in cells": lambda: _mat(_nested_cells(3000)),
        "a compressed text of 2^31 letters": lambda: _mat(
            _packed(_matrix(4, (2**15, 2**16), struct.pack("<II", 1, 0)))
        ),
    },
    "yaml": {
        "aliases that unfold to 9^20 values": lambda: _aliases(9, 20),
        "a YAML that nests 100 000 deep": lambda: _nested(100_000),
        "an alias inside of itself": lambda: b"a: &a [*a]",
        "a YAML of 40 MiB": lambda: b"a: " + b"x" * (40 * 2**20),
    },
    "model": {
        "a model with such aliases": lambda: _aliases(9, 20),
        "a model that nests 100 000 deep": lambda: b"- " * 100_000 + b"x",
        "a whole number of 100 000 digits": lambda: b"name: " + b"9" * 100_000,
    },
    "network": {"a network with such aliases": lambda: _aliases(9, 20)},
    "baseline": {
        "a baseline that nests 100 000 deep": lambda: _nested(100_000),
        "a baseline with a number of 100 000 digits": lambda: b"9" * 100_000,
    },
}


#: A log that is damaged is read as far as it goes.
_READ_ALL_THE_SAME = {
    "a record that claims 2^63 bytes",
    "a chunk of lz4 that unpacks to 2.5 GiB and claims 1 KiB",
    "a chunk of zstd that unpacks to 2.5 GiB and claims 1 KiB",
}
_LONG = ("mat", "log")  # ten seconds and more
_SLOWEST = 15.0  # s of processor time for a file, on a machine that does other things too


@pytest.mark.parametrize(
    "reader", [pytest.param(r, marks=pytest.mark.slow) if r in _LONG else r for r in _READERS]
)
def test_hostile_files_are_refused_in_bounded_memory(reader: str, tmp_path: Path) -> None:
    cases = _HOSTILE[reader]
    suffix = {"csv": ".csv", "signal": ".csv", "mat": ".mat", "log": ".mcap"}.get(reader, ".yaml")
    paths = []
    for number, content in enumerate(cases.values()):
        paths.append(tmp_path / f"{number}{suffix}")
        paths[-1].write_bytes(content())
    answers = _answers(reader, paths)
    assert len(answers) == len(cases)
    for what, answer in zip(cases, answers, strict=True):
        _, seconds, words = answer.split(" ", 2)
        expected = "read" if what in _READ_ALL_THE_SAME else "2 "
        assert words.startswith(expected), f"{what}: {words}"
        assert float(seconds) < _SLOWEST, f"{what}: {seconds} s"


def test_a_larger_file_is_read_where_the_user_says_so(tmp_path: Path) -> None:
    from trms_cli.core.errors import TrmsError
    from trms_cli.recordings.csv_recording import read_csv

    rows = (f"{i * 0.01:.6f},0.5000,{i % 7:.9f}\n" for i in range(40_000))
    path = tmp_path / "long.csv"
    path.write_text(_HEAD.decode() + "".join(rows))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRMS_LARGEST_FILE", "1")
        with pytest.raises(TrmsError, match="TRMS_LARGEST_FILE=2"):
            read_csv(path)
        patch.setenv("TRMS_LARGEST_FILE", "2")
        assert len(read_csv(path)) == 40_000
        patch.setenv("TRMS_LARGEST_FILE", "plenty")
        with pytest.raises(TrmsError, match="a number of MiB"):
            read_csv(path)
