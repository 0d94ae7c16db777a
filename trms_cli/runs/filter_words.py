"""From the text of a filter to its syntax tree.

A filter is written as a Python expression, and Python's own parser reads it; nothing of it is
ever run. Two words are added that Python has not: ``like`` and ``contains``, with ``not`` before
them if wanted. Each is put to the parser as an operator that filters have no other use for, of
the same length, so that positions stay those of the text.
"""

from __future__ import annotations

import ast
import io
import keyword
import tokenize
import warnings

from trms_cli.runs.filter_errors import FilterError

LONGEST = 4000  # characters
#: The operators that stand for the words; typed as such they are refused.
LIKE, NOT_LIKE, CONTAINS, NOT_CONTAINS = ast.MatMult, ast.FloorDiv, ast.Mod, ast.Pow
_WORDS = {"like": "@", "not like": "//", "contains": "%", "not contains": "**"}
_HINTS = {
    "=": "two signs compare: ==",
    "&": "write `and`",
    "|": "write `or`",
    "!": "write `not`",
    "~": "write `not`",
    "<>": "write !=",
    ":=": "two signs compare: ==",
}
_GENERAL = "compare columns with values: controller == 'newton_mpc' and rmse_yaw < 0.05"


def parsed(text: str) -> ast.expr:
    """The syntax tree of a filter; positions (``col_offset``) are bytes of its UTF-8.

    Raises FilterError if it is no expression, or too long.
    """
    if len(text) > LONGEST:
        raise FilterError(
            f"it is {len(text)} characters long, and {LONGEST} are read", text, LONGEST
        )
    flat = "".join(" " if c in "\r\n\t\f\v" else c for c in text)
    if not flat.isprintable():
        position = next(i for i, c in enumerate(flat) if not c.isprintable())
        raise FilterError("there is a character that cannot be printed", text, position)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd escapes in texts, told to programmers
            return ast.parse(_with_operators(flat).strip(" "), mode="eval").body
    except SyntaxError as error:
        lead = len(flat) - len(flat.lstrip(" "))
        position = lead + (error.offset - 1 if error.offset else len(flat.strip(" ")))
        raise FilterError(*_explained(flat, position, error)) from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise FilterError(f"it cannot be read ({error})", text, 0, _GENERAL) from None


def character(text: str, offset: int) -> int:
    """The character of the filter as it was typed at an offset of its tree, in bytes."""
    bare = text.lstrip(" \r\n\t\f\v")
    return len(text) - len(bare) + len(bare.encode()[:offset].decode(errors="ignore"))


def _with_operators(text: str) -> str:
    """Put the operators in the place of the words, where a word stands behind a value."""
    tokens = _tokens(text)
    found = list(text)
    for i, token in enumerate(tokens):
        if token.type == tokenize.OP and token.string in _WORDS.values():
            raise FilterError(
                f"{token.string} is not understood in a filter",
                text,
                token.start[1],
                "there are + - * / and comparisons, and the words like and contains",
            )
        if token.string not in ("like", "contains") or i == 0 or i + 1 == len(tokens):
            continue
        first, word = i, token.string
        if tokens[i - 1].string == "not":
            first, word = i - 1, f"not {word}"
        if first > 0 and _ends_a_value(tokens[first - 1]):
            begin, end = tokens[first].start[1], token.end[1]
            found[begin:end] = _WORDS[word].center(end - begin)
    return "".join(found)


def _ends_a_value(token: tokenize.TokenInfo) -> bool:
    if token.type == tokenize.NAME:
        return not keyword.iskeyword(token.string) or token.string in ("None", "True", "False")
    return token.type in (tokenize.STRING, tokenize.NUMBER) or token.string in (")", "]")


def _tokens(text: str) -> list[tokenize.TokenInfo]:
    """As far as they can be told apart; the parser says what is wrong with the rest."""
    found = []
    try:
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.string and token.start[0] == 1 and not token.string.isspace():
                found.append(token)
    except (tokenize.TokenError, SyntaxError):
        pass
    return found


def _explained(text: str, position: int, error: SyntaxError) -> tuple[str, str, int, str]:
    for sign, hint in _HINTS.items():
        around = text[max(position - 1, 0) : position + 2]
        lonely = sign in around and not any(f"{c}=" in around for c in "=!<>" if sign == "=")
        if lonely:
            place = text.index(sign, max(position - 1, 0))
            return f"{sign} is not understood in a filter", text, place, hint
    return f"it is no expression ({error.msg})", text, position, _GENERAL
