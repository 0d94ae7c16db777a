"""Numbers and tables as C."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt


def number(value: float) -> str:
    """A double that C reads back to the same bits."""
    value = float(value)
    if math.isinf(value):
        return "HUGE_VAL" if value > 0 else "-HUGE_VAL"
    return repr(value)


def numbers(values: npt.ArrayLike, indent: str = "    ") -> str:
    """A braced initialiser; 0 for an array without elements, which C does not have."""
    return _braced([number(value) for value in np.asarray(values, float).ravel()], indent)


def whole_table(name: str, values: Iterable[int]) -> str:
    """``static const int NAME[] = {…};``"""
    items = [str(int(value)) for value in values] or ["0"]
    return f"static const int {name}[{len(items)}] = {_braced(items)};"


def table(name: str, values: npt.ArrayLike) -> str:
    """``static const double NAME[] = {…};``"""
    size = max(1, np.asarray(values).size)
    return f"static const double {name}[{size}] = {numbers(values)};"


def text(words: str) -> str:
    """Words that may stand in a C comment: ASCII, and nothing that ends it."""
    plain = words.translate(_ASCII).replace("*/", "* /")
    return plain.encode("ascii", "replace").decode()


_ASCII = str.maketrans(
    {
        "α": "alpha",
        "ω": "omega",
        "√": "sqrt",
        "×": "x",
        "µ": "u",
        "′": "'",
        "²": "^2",
        "·": "*",
        "–": "-",
        "—": "-",
        "…": "...",
        "°": "deg",
    }
)


def _braced(items: Sequence[str], indent: str = "    ") -> str:
    items = list(items) or ["0"]
    line = "{" + ", ".join(items) + "}"
    if len(line) <= 80:
        return line
    lines, present = [], ""
    for item in items:
        if present and len(present) + len(item) > 84:
            lines.append(present.rstrip())
            present = ""
        present += f"{item}, "
    lines.append(present.rstrip(" ,"))
    return "{\n" + "\n".join(f"{indent}{line}" for line in lines) + "}"
