"""Flags stay whole: a browser would break a line behind each dash, also behind the first."""

from __future__ import annotations

from docutils import nodes
from sphinx.application import Sphinx

#: Letters of a word that a line of a phone, or a cell of a table there, has room for.
_FITS = 20


def keep_whole(app: Sphinx, page: nodes.document) -> None:
    """Mark code with dashes whose words all fit; longer ones have to break somewhere."""
    for code in page.findall(nodes.literal):
        words = code.astext().split()
        if any("-" in word for word in words) and max(map(len, words)) <= _FITS:
            code["classes"].append("whole")
