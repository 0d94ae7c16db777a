"""Refuses code of third parties in tracked files: ``python .ci/borrowed_code.py [FILE ...]``.

A licence's header in a file of code, or a minified script, is a copy of what a package offers.
Prose about licences (Markdown, and LICENSE of this project) is none.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

_PROSE = {".md", ".ipynb", ".lock", ".toml"}
# written in parts, so that this file is no hit of its own
_HEADER = re.compile(
    rb"copy"
    rb"right\s*(\(c\)|\xc2\xa9|\d{4})|SP"
    rb"DX-License|licen[sc]ed un"
    rb"der the|"
    rb"permission is here"
    rb"by granted|all rights res"
    rb"erved",
    re.IGNORECASE,
)


def borrowed(name: str, content: bytes) -> str:
    """What is borrowed in a file; empty: nothing."""
    if name.endswith((".min.js", ".min.css")):
        return "a minified script: take it from its package"
    path = Path(name)
    if name == "LICENSE" or path.suffix in _PROSE:
        return ""
    if path.name.upper().startswith(("LICENSE", "LICENCE", "COPYING", "NOTICE")):
        return "a third party's licence: so does its code stand here"
    hit = None if b"\0" in content else _HEADER.search(content)
    return "" if hit is None else f"a licence's header ({hit[0].decode('utf-8', 'replace')!r})"


def main(names: list[str]) -> int:
    """Check these files, else all that are tracked; 1 if anything is borrowed."""
    if not names:
        tracked = subprocess.run(["git", "ls-files", "-z"], capture_output=True, check=True)
        names = [name for name in tracked.stdout.decode().split("\0") if name]
    hits = 0
    for name in names:
        path = Path(name)
        reason = borrowed(name, path.read_bytes()) if path.is_file() else ""
        if reason:
            print(f"{name}: {reason}")
            hits += 1
    return int(hits > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
