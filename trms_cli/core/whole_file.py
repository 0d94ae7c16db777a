"""Files that come into being whole or not at all."""

import os
import secrets
from pathlib import Path


def replace_whole(path: Path, content: bytes) -> None:
    """Write a file, in place of what is there.

    Another program sees the old content or the new, never a half; a failure or Ctrl-C leaves the
    old behind and nothing beside it. Of several that write at once the last one counts.

    Raises OSError if the disk does not take it.
    """
    # A name of its own for each writer, short whatever `path` is called, and made here: a link
    # that somebody has laid there is not followed.
    draft = path.with_name(f".{secrets.token_hex(8)}.part")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0)
    with os.fdopen(os.open(draft, flags, 0o666), "wb") as file:
        try:
            file.write(content)
            file.flush()
            os.replace(draft, path)
        except BaseException:
            draft.unlink(missing_ok=True)
            raise
