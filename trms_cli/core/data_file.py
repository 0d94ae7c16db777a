"""Files of data, read only up to a size: a file that is larger is told, not waited for."""

import difflib
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError
from trms_cli.core.invocation import program

#: Raises (or lowers) what is read of recordings and logs, in MiB.
ENVIRONMENT = "TRMS_LARGEST_FILE"
MEBIBYTE = 2**20
#: JSON of ours: a report's largest document has some 10 MiB.
LARGEST_DOCUMENT = 64 * MEBIBYTE
#: Endings of recordings and logs.
RECORDINGS = (".csv", ".mat", ".mcap")


def largest(usual: int) -> int:
    """The most bytes that are read of a file: `usual`, unless the environment says otherwise.

    Raises ConfigurationError if the environment holds no number.
    """
    text = os.environ.get(ENVIRONMENT, "").strip()
    if not text:
        return usual
    try:
        mebibytes = float(text)
        if not 0 < mebibytes < 2**24:
            raise ValueError(text)
    except ValueError:
        raise ConfigurationError(
            f"{text!r} given", where=ENVIRONMENT, remedy="give a number of MiB, as 512"
        ) from None
    return round(mebibytes * MEBIBYTE)


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a file.

    ``most``: bytes; :func:`largest` for what a user may raise. Raises OSError if it cannot be read.
    Raises RecordingError if it is larger.
    """
    with path.open("rb") as file:
        about = os.fstat(file.fileno())
        # What is no plain file (a pipe, a device) does not tell its size.
        room = min(about.st_size, most) if stat.S_ISREG(about.st_mode) else most
        data = file.read(room + 1)
    if len(data) > most:
        size = max(path.stat().st_size, len(data))
        raise RecordingError(too_large(size, most), where=str(path), remedy=how_to_raise(size))
    return data


def recorded_bytes(path: Path, usual: int) -> bytes:
    """The content of a user's file, of up to :func:`largest` bytes.

    Raises RecordingError if there is none, it cannot be read, or is larger.
    """
    try:
        return read_bytes(path, largest(usual))
    except FileNotFoundError as error:
        raise absent(path) from error
    except OSError as error:
        raise unreadable(error, path) from error


def absent(path: Path, what: str = "file") -> RecordingError:
    """The words for a log or a recording that is not there, with the nearest that is."""
    close = _nearest(path)
    remedy = f"did you mean {close}? " if close else "check the path; "
    remedy += f"{program()} runs lists the runs there are"
    return RecordingError(f"there is no such {what}", where=str(path), remedy=remedy)


def _nearest(path: Path) -> str:
    """A path whose first part that does not exist is replaced by its nearest neighbour."""
    folder = next((place for place in path.parents if place.is_dir()), Path())
    name, *rest = path.relative_to(folder).parts or ("",)
    try:
        neighbours = [entry.name for entry in folder.iterdir()]
    except OSError:
        return ""
    close = difflib.get_close_matches(name, neighbours, n=1)
    return str(Path(folder, close[0], *rest)) if close else ""


def unreadable(error: OSError, path: Path) -> RecordingError:
    """The words for a file that the system does not let be read, or that is a folder."""
    if isinstance(error, IsADirectoryError):
        return RecordingError(
            "it is a folder, and there is no log of a run in it",
            where=str(path),
            remedy=f"name a log or the folder of a run; {program()} runs lists them",
        )
    return RecordingError(f"it cannot be read ({error.strerror or error})", where=str(path))


def too_large(size: int, most: int) -> str:
    """The words for a size beyond the limit."""
    return f"it holds {size / MEBIBYTE:,.1f} MiB, and {most / MEBIBYTE:,.0f} MiB are read"


def how_to_raise(size: int) -> str:
    """What to type if so much is meant."""
    mebibytes = max(1, -(-size * 5 // 4 // MEBIBYTE))
    return (
        "if the file is yours and the memory is there, raise the limit for this call (MiB): "
        f"{ENVIRONMENT}={mebibytes} trms …"
    )


def json_or_none(text: str | None) -> Any:
    """What a stranger's text holds as JSON; None if it is none."""
    try:
        return json.loads(text or "null")
    except (ValueError, RecursionError):
        return None


def read_json(path: Path, most: int = LARGEST_DOCUMENT) -> Any:
    """A document of JSON.

    Raises OSError if it cannot be read. Raises ValueError if it is no JSON, too large, or nested
    too deeply.
    """
    try:
        data = read_bytes(path, most)
        return json.loads(data.decode("utf-8-sig"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


@contextmanager
def not_as_written(where: str, what: str = "its content") -> Iterator[None]:
    """Turn any failure inside into words on a file that somebody else may have written.

    Raises RecordingError for whatever is raised inside and is no complaint of ours.
    """
    try:
        yield
    except TrmsError:
        raise
    except MemoryError as error:
        raise RecordingError(f"{what} does not fit into the memory", where=where) from error
    except Exception as error:
        raise RecordingError(
            f"{what} is not as trms writes it ({type(error).__name__}: {str(error)[:200]})",
            where=where,
        ) from error
