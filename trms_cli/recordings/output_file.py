"""Files that are written whole or not at all, and the words for a disk that says no."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.core.errors import RecordingError

if TYPE_CHECKING:
    import pyarrow

#: Failures that mean "no room": full disk, quota, file size limit.
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def explain_os_error(error: OSError, path: Path, remedy: str = "") -> RecordingError:
    """Turn a failure to write into a message that says what to do."""
    reason = error.strerror or str(error)
    if error.errno in NO_ROOM:
        problem = f"there is no room to write it ({reason})"
        remedy = remedy or "free space, or write to another disk"
    elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        problem = f"the folder {path.parent} does not let you write ({reason})"
        remedy = remedy or "choose a folder of your own"
    elif error.errno in (errno.ENOTDIR, errno.EEXIST):
        problem = f"a part of the folder's path is a file ({reason})"
        remedy = remedy or "choose another folder"
    else:
        problem = f"it cannot be written ({reason})"
    return RecordingError(problem, where=str(path), remedy=remedy)


def refuse_overwrite(path: Path, remedy: str) -> None:
    """Raise when there is something at ``path`` already."""
    if path.exists() or path.is_symlink():
        what = "a folder" if path.is_dir() else "a file"
        raise RecordingError(
            f"there is {what} of this name already; nothing is overwritten unasked",
            where=str(path),
            remedy=remedy,
        )


@contextlib.contextmanager
def whole_file(path: Path, *, force: bool = False, option: str = "--out") -> Iterator[Path]:
    """Give a temporary path that becomes ``path`` when the block ends well.

    Another program sees the old file or the new one, never a half; a failure or Ctrl-C
    leaves nothing behind. ``force`` allows an existing file to be replaced. ``option``: the one
    that names the file, for who has to name another.
    """
    folder = path.parent
    try:
        if not force:
            refuse_overwrite(path, f"give another name with {option}, or --force to replace it")
        elif path.is_dir():
            refuse_overwrite(path, f"give the name of a file with {option}")
        folder.mkdir(parents=True, exist_ok=True)
        # A folder of its own: writers that refuse to overwrite can then create the file.
        with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=folder) as scratch:
            temporary = Path(scratch) / path.name
            yield temporary
            if force:
                os.replace(temporary, path)
            else:
                _move_without_overwriting(temporary, path, option)
    except OSError as error:
        raise explain_os_error(error, path, f"choose another place with {option}") from error


def _move_without_overwriting(source: Path, target: Path, option: str) -> None:
    """Rename, but fail when ``target`` has come into being meanwhile."""
    try:
        os.link(source, target)
    except FileExistsError:
        refuse_overwrite(target, f"give another name with {option}, or --force to replace it")
        raise
    except OSError:  # a file system without hard links
        refuse_overwrite(target, f"give another name with {option}, or --force to replace it")
        os.replace(source, target)


def arrow_table(
    rows: Sequence[Mapping[str, Any]], kinds: Mapping[str, type | None], units: Mapping[str, str]
) -> pyarrow.Table:
    """Rows as columns, each of one type, with its unit in its metadata.

    ``rows``: None for what a row does not have. ``kinds``: the columns in their order: ``float``,
    ``int``, ``bool``, ``str``, or None for values that may be of several types (numbers if all are
    numbers, else text). ``units``: by column; "" or absent for what has none.
    """
    import pyarrow as pa

    types = {float: pa.float64(), int: pa.int64(), bool: pa.bool_(), str: pa.string()}
    fields, arrays = [], []
    for name, kind in kinds.items():
        values = [row.get(name) for row in rows]
        if kind is None:
            kind, values = _one_type(values)
        fields.append(pa.field(name, types[kind], metadata={"unit": units.get(name, "")}))
        arrays.append(pa.array(values, types[kind]))
    return pa.table(arrays, schema=pa.schema(fields))


def write_parquet(table: pyarrow.Table, path: Path, *, force: bool = False) -> None:
    """Write a table; the file appears when it is whole.

    Raises RecordingError if there is such a file already and not ``force``, or the disk does not
    take it.
    """
    import pyarrow.parquet as pq

    with whole_file(path, force=force) as temporary:
        pq.write_table(table, temporary)


def _one_type(values: Sequence[Any]) -> tuple[type, list[Any]]:
    present = [value for value in values if value is not None]
    if all(isinstance(value, (int, float)) for value in present):
        return float, [None if value is None else float(value) for value in values]
    return str, [None if value is None else str(value) for value in values]
