"""What the pages tell a person to write and to type, as data."""

import re
from dataclasses import dataclass
from pathlib import Path

#: Why commands of a page are not typed by a test: the word behind ``by-hand=``.
REASONS = {
    "setup": "sets up or changes a machine: clone, install, build an image, source a shell",
    "study": "a study, a benchmark or a target of make: minutes to hours, with tests of its own",
    "minutes": "takes minutes to hours; that it composes is tested",
    "yours": "needs what only the reader has: a recording, a package, a run of before, hardware",
    "live": "goes on until somebody stops it, or moves a rig",
    "cluster": "needs several machines",
    "part": "a part of a file, not a program",
}
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
    def by_hand(self) -> str | None:
        """Why it is left to the reader, empty where none is given; None where a test types it."""
        marks = [word for word in self.words if word.partition("=")[0] == "by-hand"]
        return marks[0].partition("=")[2] if marks else None

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
