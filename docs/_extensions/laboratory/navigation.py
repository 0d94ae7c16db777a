"""The tree of pages, read from ``docs/index.md``.

A ``##`` section of the index is a part of the navigation, with the pages it links in their order.
In a ``###`` section the first page is the parent of the others. A page of ``docs/`` that the index
does not name yet goes under *More*, so that it is found all the same.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from docutils import nodes

from .pages import toctree

_HEADING = re.compile(r"^(##+)\s+(.*?)\s*$")
_LINK = re.compile(r"\]\(([\w./-]+)\.(?:md|ipynb)(?:#[\w-]*)?\)")
#: Folders whose pages are reached from others or are no pages.
_APART = ("_", "source/", "reference/", "figures/", "example_plugin/", "templates/")


@dataclass
class Part:
    """A section of the index: its heading, its pages, and the pages under some of them."""

    heading: str
    pages: list[str] = field(default_factory=list)


@dataclass
class Tree:
    """What the index says."""

    parts: list[Part] = field(default_factory=list)
    children: dict[str, list[str]] = field(default_factory=dict)

    def names(self) -> set[str]:
        """All pages in it."""
        found = {page for part in self.parts for page in part.pages}
        return found.union(*self.children.values())


def read_tree(docs: Path) -> Tree:
    """The navigation, with what the index does not name under *More*."""
    return _read_tree(docs, (docs / "index.md").stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _read_tree(docs: Path, changed: int) -> Tree:
    tree = Tree()
    parent: str | None = None
    nested = False
    seen: set[str] = set()
    for line in (docs / "index.md").read_text(encoding="utf-8").splitlines():
        heading = _HEADING.match(line)
        if heading:
            nested, parent = len(heading[1]) > 2, None
            if not nested:
                tree.parts.append(Part(heading[2]))
            continue
        for name in _LINK.findall(line) if tree.parts else ():
            if name in seen or not any((docs / f"{name}{e}").is_file() for e in (".md", ".ipynb")):
                continue
            seen.add(name)
            if name.startswith("../"):  # a page elsewhere in the repository: see `sources`
                name = f"source/{name.removeprefix('../')}.md.md"
            if nested and parent is not None:
                tree.children.setdefault(parent, []).append(name)
            else:
                tree.parts[-1].pages.append(name)
                parent = name
    more = sorted(_all_pages(docs) - tree.names() - {"index"})
    if more:
        tree.parts.append(Part("More", more))
    return tree


def _all_pages(docs: Path) -> set[str]:
    folders = (docs, *(folder for folder in docs.iterdir() if folder.is_dir()))
    found = [file for folder in folders for e in ("md", "ipynb") for file in folder.glob(f"*.{e}")]
    names = {file.relative_to(docs).with_suffix("").as_posix() for file in found}
    return {name for name in names if not name.startswith(_APART) and "/." not in name}


def toctrees(name: str, docs: Path) -> str:
    """The hidden tables of contents that belong to a page."""
    tree = read_tree(docs)
    if name == "index":
        return "".join(toctree(part.pages, caption=part.heading) for part in tree.parts)
    return toctree(tree.children.get(name, []))


def always_read(app: Any, env: Any, added: set[str], changed: set[str], removed: set[str]) -> Any:
    """Pages whose part in the tree depends on files other than their own."""
    made = {"reference/commands", "reference/configuration", "reference/python"}
    parents = {"index", "reference/formats", *made, *read_tree(Path(app.srcdir)).children}
    return [name for name in sorted(parents) if name in env.all_docs]


def mark_cards(app: Any, doctree: nodes.document) -> None:
    """On the front page the tables of pages are shown as cards."""
    if app.env.current_document.docname == "index":
        for table in doctree.findall(nodes.table):
            table["classes"].append("cards")
