"""Formulas between dollars as MathML, which browsers set themselves.

Sphinx's own ways fetch MathJax from elsewhere, or need a TeX on the machine that builds. Docutils
has a translator of the TeX that the pages use.
"""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.writers.html5_polyglot import HTMLTranslator


def write(translator: Any, formula: nodes.math | nodes.math_block) -> None:
    """Write a formula of a page, in its line or in one of its own."""
    translator.math_output, translator.math_options = "mathml", ""
    HTMLTranslator.visit_math(translator, formula)
