"""Results that take a while and depend on nothing but their inputs, kept between runs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from trms_cli.core.compilation import cache_folder
from trms_cli.core.whole_file import replace_whole

T = TypeVar("T")


def cached_result(
    source: str, inputs: Iterable[object], kind: type[T], compute: Callable[[], T]
) -> T:
    """The result of a pure computation, from the user's cache folder when it is there.

    ``source``: file of the code that computes (``__file__``): an edit of it makes the result anew.
    ``inputs``: all that the result depends on: arrays, numbers, text. ``kind``: of the result; a
    type that msgspec reads and writes as JSON. Numbers keep every bit. ``compute``: without
    arguments. What it raises is not kept.
    """
    digest = hashlib.sha256(Path(source).read_bytes())
    for value in inputs:
        data = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
        digest.update(len(data).to_bytes(8, "little") + data)
    file = cache_folder().parent / "results" / f"{Path(source).stem}_{digest.hexdigest()[:32]}.json"
    try:
        return msgspec.json.decode(file.read_bytes(), type=kind)
    except (OSError, msgspec.MsgspecError):
        result = compute()
        _keep(file, msgspec.json.encode(result))
        return result


def _keep(file: Path, content: bytes) -> None:
    """Write whole or not at all; a cache that cannot be written is no error."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        replace_whole(file, content)
    except OSError:
        return
