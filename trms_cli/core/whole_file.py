"""Files that come into being whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def replace_whole(path: Path, content: bytes) -> None:
    """Write a file, in place of what is there.

    Another program sees the old content or the new, never a half; a failure or Ctrl-C leaves the
    old behind and nothing beside it.

    Parameters
    ----------
    path : Path
    content : bytes

    Raises
    ------
    OSError
        If the disk does not take it.
    """
    draft = path.with_name(f".{path.name}")
    try:
        draft.write_bytes(content)
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
