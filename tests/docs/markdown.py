"""What the pages tell a person to write and to type, as data."""

import re
from dataclasses import dataclass
from pathlib import Path

_FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the words after it, its text and its line in the page."""

    language: str
    words: tuple[str, ...]
    text: str
    line: int

    @property
    def file(self) -> str | None:
        """The file that the block is, from ``file=PATH`` behind its language."""
        return next((w.removeprefix("file=") for w in self.words if w.startswith("file=")), None)

    @property
    def commands(self) -> list[str]:
        """Shell commands, each on one line, comments and empty lines left out."""
        whole = re.sub(r"\s*\\\n\s*", " ", self.text)  # a line that ends in a backslash goes on
        lines = (re.sub(r"\s+# .*$", "", line).strip() for line in whole.splitlines())
        return [line for line in lines if line and not line.startswith("#")]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(m[1], tuple(m[2].split()), m[3], text.count("\n", 0, m.start()) + 1)
        for m in _FENCE.finditer(text)
    ]
