"""What the site adds to the Markdown pages, all of it made at build time.

==================  ================================================================
`navigation`        the tree of pages, read from the tables of the five parts
`sources`           a page for every source file that a page links
`commands`          a reference page a command, from its help
`configuration`     a reference page a group of options, from the YAML files
`formats`           the schemas that the code names
`flags`             what is typed with dashes, kept in one line
`formulas`          MathML for what stands between dollars
`interface`         the Python reference: protocols, base classes, library functions
`origins`           what made the tables and pictures of a page, and at which revision
==================  ================================================================

Generated pages lie in folders that git ignores; they are rewritten only when they change, so that
a second build is quick.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from . import (
    commands,
    configuration,
    flags,
    formats,
    formulas,
    interface,
    navigation,
    origins,
    sources,
)
from .pages import write_pages


def setup(app: Sphinx) -> dict[str, Any]:
    """Sphinx's entry point."""
    app.add_html_math_renderer("mathml", (formulas.write, None), (formulas.write, None))
    app.connect("builder-inited", _generate)
    app.connect("env-get-outdated", navigation.always_read)
    app.connect("source-read", _complete)
    app.connect("doctree-read", navigation.mark_cards)
    app.connect("doctree-read", flags.keep_whole)
    app.connect("autodoc-process-docstring", interface.hide_colon, priority=400)
    app.connect("autodoc-process-docstring", interface.show_colon, priority=600)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}


def _generate(app: Sphinx) -> None:
    docs = Path(app.srcdir)
    write_pages(docs / "reference" / "commands", commands.pages())
    write_pages(docs / "reference" / "configuration", configuration.pages())
    write_pages(docs / "reference" / "python", interface.pages())
    write_pages(docs / "source", sources.pages(docs))


def _complete(app: Sphinx, name: str, content: list[str]) -> None:
    """Append to a page what the site knows beyond it."""
    docs = Path(app.srcdir)
    text = sources.relink(content[0], name, docs)
    text += {
        "reference/commands": commands.listing,
        "reference/configuration": configuration.listing,
        "reference/python": interface.listing,
        "reference/formats": formats.listing,
    }.get(name, str)()
    text += origins.listing(name, docs)
    content[0] = text + navigation.toctrees(name, docs)
