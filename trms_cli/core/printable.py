"""Text from a file that is shown on a terminal: signs that steer the terminal are shown, not sent.

A name in a stranger's log may hold an escape sequence, which can move the cursor, change what was
printed before, or write to the clipboard.
"""

import sys
from typing import Any

#: Control characters but the tab and the line end (C0, DEL, C1), and those that turn the direction.
_STEERING = {
    code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0)) if code not in (9, 10)
} | {code: f"\\u{code:04x}" for code in (*range(0x202A, 0x202F), *range(0x2066, 0x206A))}


def printable(text: str) -> str:
    """The text with such signs written out, as ``\\x1b``."""
    return text.translate(_STEERING)


def print_json(document: Any, *, allow_nan: bool = True) -> None:
    """Print a document as JSON, as ``--json`` asks for."""
    sys.stdout.write(f"{_json_text(document, allow_nan=allow_nan)}\n")


def _json_text(document: Any, *, allow_nan: bool) -> str:
    """As ``json.dumps`` indents it, which takes ten times as long for a large one."""
    import json

    import msgspec

    try:
        compact = json.dumps(document, ensure_ascii=False, allow_nan=False)
    except ValueError:
        if not allow_nan:
            raise
        return json.dumps(document, indent=2, ensure_ascii=False)
    # the name of a file may hold what is no text
    content = msgspec.json.format(compact.encode("utf-8", "surrogatepass"), indent=2)
    return content.decode("utf-8", "surrogatepass")


def short_repr(value: object) -> str:
    """How Python writes a value, at most 60 characters of it."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
