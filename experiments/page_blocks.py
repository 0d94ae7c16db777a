"""The parts of a page that a program wrote: between which marks they stand, and the pictures."""

from __future__ import annotations

import re
from dataclasses import dataclass

_MARKS = re.compile(
    r"<!-- (?:made: (?P<made>[^>]+?) begin"  # of the tournament
    r"|(?P<study>[^:>]+): begin"  # `page_tables.write_tables`
    r"|table (?P<table>\S+)"  # of chapter 3
    r"|derived: (?P<derived>\w+)) -->\n"  # a formula, up to the end of its fence
)
#: What a page shows, and what it only links.
_PICTURE = re.compile(r"\]\(([^)\s]+\.(?:png|svg|gif))\)")


@dataclass(frozen=True)
class Block:
    """What stands between two marks of a page."""

    name: str
    text: str  #: Without the marks
    lines: range  #: Of the page, its first line 1; without the marks'


def blocks_of(page: str) -> list[Block]:
    """The blocks of a page's text, in order.

    Raises ValueError where a block has no end.
    """
    blocks = []
    for match in _MARKS.finditer(page):
        kind = match.lastgroup
        assert kind is not None
        name = match[kind]
        end = {
            "made": f"<!-- made: {name} end -->",
            "study": f"<!-- {name}: end -->",
            "table": "<!-- end -->",
            "derived": "\n```\n",
        }[kind]
        start = match.end()
        stop = page.find(end, start)
        if stop < 0:
            raise ValueError(f"the block {name!r} has no end ({end.strip()})")
        if kind == "derived":
            stop += len(end)
        first = page.count("\n", 0, start) + 1
        text = page[start:stop]
        blocks.append(Block(name, text.strip("\n"), range(first, first + text.count("\n"))))
    return blocks


def pictures_of(page: str) -> list[str]:
    """The pictures that a page shows or links, as it names them."""
    return list(dict.fromkeys(_PICTURE.findall(page)))
