"""The schemas of JSON documents and logs that the program writes, found in its code."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import trms_cli

from .pages import code, plain, table

_SCHEMA = re.compile(r"\btrms\.[a-z_]+/\d+")
_PACKAGE = Path(trms_cli.__file__).parent


def schemas() -> dict[str, dict[str, str]]:
    """Schema name → the modules whose code (not prose) has it → what each module is for."""
    found: dict[str, dict[str, str]] = {}
    for file in sorted(_PACKAGE.rglob("*.py")):
        source = file.read_text(encoding="utf-8")
        if "trms." not in source:
            continue
        tree = ast.parse(source)
        about = (ast.get_docstring(tree) or "").partition("\n\n")[0].replace("\n", " ")
        module = ".".join(file.relative_to(_PACKAGE.parent).with_suffix("").parts)
        for node in ast.walk(tree):
            value = node.value if isinstance(node, ast.Constant) else None
            if isinstance(value, str) and _SCHEMA.fullmatch(value):
                found.setdefault(value, {})[module] = about
    return dict(sorted(found.items()))


def listing() -> str:
    """The table of schemas."""
    rows = [
        [code(name), "; ".join(code(m) for m in modules), plain(next(iter(modules.values())))]
        for name, modules in schemas().items()
    ]
    return f"\n## Schemas\n\n{table(['`schema`', 'module', 'what the module is for'], rows)}"
