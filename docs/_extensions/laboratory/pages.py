"""Writing generated pages, and the Markdown that several of them share."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path


def write_pages(folder: Path, pages: Mapping[str, str]) -> None:
    """Make a folder hold these pages and no others; what is the same is not touched.

    Parameters
    ----------
    folder : Path
        Generated as a whole: a page that is no longer made is removed.
    pages : mapping of str to str
        Text by path inside the folder.
    """
    for name, text in pages.items():
        file = folder / name
        if file.is_file() and file.read_text(encoding="utf-8") == text:
            continue
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f".{file.name}.{os.getpid()}")
        part.write_text(text, encoding="utf-8")
        part.replace(file)
    for file in folder.rglob("*"):
        if file.is_file() and file.relative_to(folder).as_posix() not in pages:
            file.unlink(missing_ok=True)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; bars and line ends inside cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(_cell(cell) for cell in line)} |\n" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def code(text: str) -> str:
    """A code span; empty text stays empty."""
    if not text:
        return ""
    fence = "``" if "`" in text else "`"
    return f"{fence} {text} {fence}" if "`" in text else f"`{text}`"


def plain(text: str) -> str:
    """Text in which Markdown finds no markup but code spans."""
    parts = text.split("`")
    for i in range(0, len(parts), 2):
        for sign in "\\*_[]<>$":
            parts[i] = parts[i].replace(sign, f"\\{sign}")
    return "`".join(parts) if len(parts) % 2 else "\\`".join(parts)


def toctree(names: Sequence[str], *, caption: str = "", depth: int = 2) -> str:
    """A hidden table of contents: pages in the navigation, nothing in the text."""
    if not names:
        return ""
    options = f":caption: {caption}\n" if caption else ""
    listed = "\n".join(names)
    return f"\n```{{toctree}}\n:hidden:\n:maxdepth: {depth}\n{options}\n{listed}\n```\n"
