"""The folder that a command writes into: new, or asked for by name and empty."""

import contextlib
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from trms_cli.core.errors import TrmsError
from trms_cli.core.whole_file import replace_whole

#: Files of a run in its folder.
LOG_NAME, SCORE_NAME, PICTURE_NAME = "run.mcap", "score.json", "run.png"


def new_folder(out: str | os.PathLike[str] | None, what: str) -> Path:
    """Make the folder of a run of the command `what`; nothing that exists is ever written over.

    Without `out` it is ``outputs/<date>/<time>-<what>`` under the working directory, with a number
    behind it when two start in one second. Of several processes that are given one folder at once,
    one gets it. Raises TrmsError if the folder holds something already, if another process is
    writing into it, or if it cannot be made or written to.
    """
    try:
        if out is None:
            return _dated(what)
        folder = Path(out).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        if not hold(folder):
            raise in_use(folder)
        # Asked once nobody else can begin to write into it.
        if any(folder.iterdir()):
            let_go(folder)
            raise TrmsError(
                f"the folder {str(folder)!r} is not empty, and nothing is written over",
                where="out",
                remedy="name a new folder, or remove that one",
            )
        if not os.access(folder, os.W_OK):
            raise PermissionError(13, "Permission denied", str(folder))
    except (FileExistsError, NotADirectoryError) as error:
        place = Path(error.filename or out or "outputs")
        blocking = next((each for each in (place, *place.parents) if each.is_file()), place)
        raise TrmsError(
            f"{str(blocking)!r} is a file, and a folder is written here",
            where="out",
            remedy="name a new folder: out=FOLDER",
        ) from error
    except OSError as error:
        place = Path(error.filename or out or "outputs")
        raise TrmsError(
            f"cannot write into {str(place)!r}: {error.strerror or error}",
            where="out",
            remedy="name a folder that you can write to: out=FOLDER",
        ) from error
    return folder


def in_use(folder: Path) -> TrmsError:
    """The words for a folder that another process writes into."""
    return TrmsError(
        f"another process is writing into the folder {str(folder)!r}",
        where="out",
        remedy="name a new folder, or wait until the other has ended",
    )


@contextmanager
def removed_if_empty(folder: Path) -> Iterator[None]:
    """Leave no empty folder behind when the work inside fails."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            folder.rmdir()
        raise


def log_of(path: Path) -> Path:
    """The log that `path` is, or that lies in the run's folder that it is."""
    return path / LOG_NAME if (path / LOG_NAME).is_file() else path


def name_of(log: Path) -> str:
    """``…/first/run.mcap`` as ``first``, ``…/monday.mcap`` as ``monday``."""
    return (log.resolve().parent.name or log.stem) if log.name == LOG_NAME else log.stem


def _dated(what: str) -> Path:
    now = datetime.now()
    base = Path("outputs", now.strftime("%Y-%m-%d"), f"{now.strftime('%H-%M-%S')}-{what}")
    base.parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = base if number == 1 else base.with_name(f"{base.name}-{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
        else:
            hold(folder)
            return folder


def write_document(document: Mapping[str, Any], path: Path) -> None:
    """Write the JSON twin of what is printed.

    Raises RecordingError if the disk does not take it.
    """
    import json

    write_whole(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n", path)


def write_whole(text: str, path: Path) -> None:
    """Write a file of a command's folder, whole or not at all.

    Raises RecordingError if the disk does not take it.
    """
    from trms_cli.core.whole_file import explain_os_error

    try:
        replace_whole(path, text.encode())
    except OSError as error:
        raise explain_os_error(error, path) from error


#: A process that makes thousands of folders keeps descriptors of no more.
_MANY = 64
#: Folders that this process holds: descriptor, and the thread that took it.
_folders: dict[tuple[int, int], tuple[int, int, Path]] = {}
_guard = threading.Lock()


def hold(folder: Path) -> bool:
    """Hold a folder until the process ends or lets go of it; whether nobody else does.

    Raises OSError if it cannot be opened.
    """
    try:
        import fcntl
    except ImportError:  # not a system of this kind
        return True
    with _guard:
        _forget_written()
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        about = os.fstat(descriptor)
        key = (about.st_dev, about.st_ino)
        entry = _folders.get(key)
        if entry is not None:
            os.close(descriptor)
            return entry[1] == threading.get_ident()
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return False
        except OSError:  # no locks here
            os.close(descriptor)
            return True
        _folders[key] = descriptor, threading.get_ident(), folder
        return True


def let_go(folder: Path) -> None:
    """Let go of a folder; nothing happens where it is not held."""
    with _guard, contextlib.suppress(OSError):
        about = os.stat(folder)
        entry = _folders.pop((about.st_dev, about.st_ino), None)
        if entry is not None:
            os.close(entry[0])


def _forget_written() -> None:
    """Let go of folders that are gone or hold files, where there are many.

    One that holds a file is nobody else's any more, since only empty ones are taken.
    """
    if len(_folders) < _MANY:
        return
    for key, (descriptor, _, folder) in list(_folders.items()):
        try:
            is_needed = not any(folder.iterdir())
        except OSError:
            is_needed = False
        if not is_needed:
            os.close(descriptor)
            del _folders[key]
