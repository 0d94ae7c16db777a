"""Results that depend on nothing but their inputs, kept while the process lives, or on the disk.

A process that makes many runs, as a sweep's worker does, needs the same equations, gains and
filters again and again: most of a run's configuration is that of the run before. They are found
by the *content* of what they follow from, never by which object it is, so that a model whose
parameters were assigned anew is another model, and a run is the same whatever ran before it.

What is kept is shared: nobody may change it. What takes long is kept between processes
(:func:`cached_result`).
"""

import hashlib
import io
import pickle
from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

import casadi as ca
import msgspec
import numpy as np

from trms_cli.core.compilation import cache_folder
from trms_cli.core.whole_file import replace_whole

P = ParamSpec("P")
T = TypeVar("T")

#: Results kept at a time; the longest unused go. A run with equations of its own adds about ten, a
#: diagnosis five for each of its forty suspects, which the next one of the process takes over.
MOST_RESULTS = 1024


@dataclass(frozen=True)
class _Kept:
    """A result, and the objects that its key names by their place in memory."""

    result: Any
    #: Held, so that no other object takes their place as long as the key is there
    references: tuple[object, ...]


_kept: OrderedDict[bytes, _Kept] = OrderedDict()
_lock = Lock()


def call_memoised(compute: Callable[P, T], *inputs: P.args, **options: P.kwargs) -> T:
    """``compute(*inputs, **options)``, or what it gave for equal inputs before.

    ``compute``: a function of a module, pure: its result follows from its arguments alone. What it
    raises is not kept. ``*inputs``, ``**options``: plain data, arrays, dataclasses, models:
    whatever can be pickled. With an input that cannot (one that holds a closure, or CasADi
    symbols), it is computed each time. The result is shared with others, and to be read only.
    """
    content = _content((compute, inputs, options))
    if content is None:
        return compute(*inputs, **options)
    key, named = content
    with _lock:
        entry = _kept.get(key)
        if entry is not None:
            _kept.move_to_end(key)
            return entry.result
    result = compute(*inputs, **options)
    with _lock:
        _kept[key] = _Kept(result, named)
        while len(_kept) > MOST_RESULTS:
            _kept.popitem(last=False)
    return result


def forget() -> None:
    """Drop all that is kept, as a fresh process has it."""
    with _lock:
        _kept.clear()


def _content(value: object) -> tuple[bytes, tuple[object, ...]] | None:
    """A digest of all that a value holds, and the objects named in it; None where it has none."""
    stream = io.BytesIO()
    pickler = _ContentPickler(stream)
    try:
        pickler.dump(value)
    except Exception:
        # Whatever an object has against being pickled: it costs time, never the run.
        return None
    return hashlib.sha256(stream.getbuffer()).digest(), tuple(pickler.references)


class _ContentPickler(pickle.Pickler):
    """Writes what values hold; what can never change is named by its place in memory.

    These are classes and functions of modules, which a notebook may define anew under the same
    name, and CasADi's functions, whose content is long and never changes.
    """

    def __init__(self, stream: io.BytesIO) -> None:
        super().__init__(stream, protocol=5)
        self.references: list[object] = []

    # Not persistent_id: that is asked for each number and each word as well, ten times as often.
    def reducer_override(self, value: Any) -> Any:
        """A name for what is not written out, NotImplemented for all else."""
        if value is _named:
            return NotImplemented
        if isinstance(value, type):
            self.references.append(value)
            return _named, ("class", id(value))
        if isinstance(value, ca.Function):
            self.references.append(value)
            return _named, ("casadi", hash(value))  # the same for each handle of one function
        if isinstance(value, FunctionType):
            if value.__closure__ is not None:
                raise pickle.PicklingError(f"{value.__qualname__} holds what may change")
            self.references.append(value)
            return _named, ("function", id(value))
        return NotImplemented


def _named(kind: str, number: int) -> None:
    """Stands in the content for what is named: nobody unpickles it."""


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
        with suppress(OSError):  # a cache that cannot be written is no error
            file.parent.mkdir(parents=True, exist_ok=True)
            replace_whole(file, msgspec.json.encode(result))
        return result
