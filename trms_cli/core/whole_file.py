"""Files that come into being whole or not at all, and the words for a disk that says no."""

import contextlib
import errno
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from trms_cli.core.errors import RecordingError

#: For `os.open`: bytes as they are; Windows would put a carriage return before each line's end.
BINARY = getattr(os, "O_BINARY", 0)


def replace_whole(path: Path, content: bytes) -> None:
    """Write a file, in place of what is there.

    Another program sees the old content or the new, never a half; a failure or Ctrl-C leaves the
    old behind and nothing beside it. Of several that write at once the last one counts.

    Raises OSError if the disk does not take it.
    """
    # A name of its own for each writer, short whatever `path` is called, and made here: a link
    # that somebody has laid there is not followed.
    draft = path.with_name(f".{secrets.token_hex(8)}.part")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | BINARY
    with os.fdopen(os.open(draft, flags, 0o666), "wb") as file:
        try:
            file.write(content)
            file.flush()
            os.replace(draft, path)
        except BaseException:
            draft.unlink(missing_ok=True)
            raise


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
        import tempfile  # slow to import, and hardly a start of the program writes

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
