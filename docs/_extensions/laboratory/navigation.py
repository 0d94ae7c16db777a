"""The tree of pages: five parts, each a page of ``docs/`` whose tables link the others.

The order and grouping in the navigation are those of a part's page: what stands before its first
heading is directly below it; of a ``##`` group the first page is the parent of the others, so that
a part unfolds into few lines. A page of ``docs/`` that no part names yet goes under *More*, so
that it is found all the same.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from docutils import nodes

from .pages import toctree

#: The parts in their order, by page.
PARTS = ("start", "how-to", "understand", "reference", "proof")
_ROW = re.compile(r"^\|\s*\[[^\]]*\]\(([\w./-]+)\.(?:md|ipynb)\)")
#: Folders whose pages are reached from others or are no pages.
_APART = ("_", "source/", "reference/", "figures/", "example_plugin/", "templates/")


@dataclass
class Tree:
    """Pages by the page that they are below."""

    children: dict[str, list[str]] = field(default_factory=dict)
    more: list[str] = field(default_factory=list)  #: Pages that no part names

    def names(self) -> set[str]:
        """All pages below another."""
        return set[str]().union(*self.children.values())


def read_tree(docs: Path) -> Tree:
    """The navigation, as the pages of the parts stand now."""
    return _read_tree(docs, tuple((docs / f"{part}.md").stat().st_mtime_ns for part in PARTS))


@lru_cache(maxsize=1)
def _read_tree(docs: Path, changed: tuple[int, ...]) -> Tree:
    tree = Tree()
    seen: set[str] = set()
    for part in PARTS:
        parent = part
        first_of_group = False
        for line in (docs / f"{part}.md").read_text(encoding="utf-8").splitlines():
            if line.startswith("## "):
                parent, first_of_group = part, True
            row = _ROW.match(line)
            if row is None or row[1] in seen:
                continue
            name = row[1]
            if not any((docs / f"{name}{e}").is_file() for e in (".md", ".ipynb")):
                continue
            seen.add(name)
            if name.startswith("../"):  # a page elsewhere in the repository: see `sources`
                name = f"source/{name.removeprefix('../')}.md.md"
            tree.children.setdefault(parent, []).append(name)
            if first_of_group:
                parent, first_of_group = name, False
    tree.more = sorted(_all_pages(docs) - tree.names() - {"index", *PARTS})
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
        return toctree(PARTS) + toctree(tree.more, caption="More")
    return toctree([f"/{child}" for child in tree.children.get(name, [])])


def always_read(app: Any, env: Any, added: set[str], changed: set[str], removed: set[str]) -> Any:
    """Pages whose part in the tree depends on files other than their own."""
    made = {"reference/commands", "reference/configuration", "reference/python"}
    parents = {"index", "reference/formats", *made, *read_tree(Path(app.srcdir)).children}
    return [name for name in sorted(parents) if name in env.all_docs]


def mark_cards(app: Any, doctree: nodes.document) -> None:
    """On the pages of the parts the tables of pages are shown as cards."""
    if app.env.current_document.docname in ("index", *PARTS):
        for table in doctree.findall(nodes.table):
            table["classes"].append("cards")
