"""The columns that a filter asks about: what a table of its answer shows beside the usual ones."""

from __future__ import annotations

import ast

from trms_cli.runs.column_sql import column_sql
from trms_cli.runs.filter_language import dotted
from trms_cli.runs.filter_words import parsed


def names_in(text: str) -> list[str]:
    """Columns and keys of a filter, as they were typed, each once.

    Raises FilterError if it is no expression.
    """
    if not text.strip():
        return []
    found: dict[str, None] = {}
    waiting: list[ast.AST] = [parsed(text)]
    while waiting:
        node = waiting.pop(0)
        name = dotted(node) if isinstance(node, ast.expr) else None
        if name is None:
            waiting.extend(ast.iter_child_nodes(node))
        elif column_sql(name, None) is not None:
            found[name] = None
    return list(found)
