"""Filters: an expression over columns, as SQL with bound values.

    controller == 'newton_mpc' and rmse_yaw < 0.05
    not complete or failures > 0
    controller in ('pid', 'lqr') and effects contains 'friction'
    0.1 < rmse_yaw / rmse_pitch <= 2 and plant.prior_seed == 3
    settling_time_yaw is None and controller like '*mpc'

What a filter says is data. It is read into a syntax tree (:mod:`~trms_cli.runs.filter`) of
which only the kinds of nodes below are taken; columns are looked up among those there are, and
every value that was typed is bound as a parameter. There are no calls, subscripts or methods.

A filter is true or false of every run. A figure that a run does not have (None) satisfies no
``<``, ``<=``, ``>``, ``>=``, ``in``, ``like`` or ``contains``; it equals only None. Arithmetic with
it gives None, as division by zero does.
"""

import ast
import io
import keyword
import tokenize
import warnings
from collections.abc import Collection
from dataclasses import dataclass
from typing import NoReturn

from trms_cli.core.errors import ConfigurationError
from trms_cli.runs.columns import Kind, Sql, column_sql, nearest

_SHOWN = 64  # characters of a filter on one line


class FilterError(ConfigurationError):
    """A filter of runs cannot be used; the trouble begins at a character of it, from 0."""

    def __init__(self, problem: str, filter: str, position: int, remedy: str = "") -> None:
        super().__init__(problem, where=_pointed(filter, position), remedy=remedy)
        #: Character at which the trouble begins, from 0.
        self.position = position


def _pointed(filter: str, position: int) -> str:
    """The part of the filter around a position, with a mark under it."""
    position = min(max(position, 0), len(filter))
    begin = max(0, min(position - _SHOWN // 2, len(filter) - _SHOWN))
    part = filter[begin : begin + _SHOWN]
    head, tail = "…" if begin else "", "…" if begin + _SHOWN < len(filter) else ""
    printable = "".join(c if c.isprintable() else " " for c in part)
    mark = " " * (position - begin + len(head)) + "^"
    return f"the filter, character {position + 1}\n  {head}{printable}{tail}\n  {mark}"


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


def parse_filter(text: str) -> ast.expr:
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
    characters = list(text)
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
            characters[begin:end] = _WORDS[word].center(end - begin)
    return "".join(characters)


def _ends_a_value(token: tokenize.TokenInfo) -> bool:
    if token.type == tokenize.NAME:
        return not keyword.iskeyword(token.string) or token.string in ("None", "True", "False")
    return token.type in (tokenize.STRING, tokenize.NUMBER) or token.string in (")", "]")


def _tokens(text: str) -> list[tokenize.TokenInfo]:
    """As far as they can be told apart; the parser says what is wrong with the rest."""
    tokens = []
    try:
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.string and token.start[0] == 1 and not token.string.isspace():
                tokens.append(token)
    except (tokenize.TokenError, SyntaxError):
        pass
    return tokens


def _explained(text: str, position: int, error: SyntaxError) -> tuple[str, str, int, str]:
    for sign, hint in _HINTS.items():
        around = text[max(position - 1, 0) : position + 2]
        lonely = sign in around and not any(f"{c}=" in around for c in "=!<>" if sign == "=")
        if lonely:
            place = text.index(sign, max(position - 1, 0))
            return f"{sign} is not understood in a filter", text, place, hint
    return f"it is no expression ({error.msg})", text, position, _GENERAL


_ORDER = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}
_ARITHMETIC = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_MOST_NODES = 400
_LONGEST_PATTERN = 200  # a pattern of many stars takes long to be found wanting
_MOST_STARS = 8
_CONSTANTS = {"null": None, "none": None, "true": True, "false": False}


@dataclass(frozen=True)
class _Value:
    """A side of a comparison; ``kind`` None is that of None itself."""

    sql: Sql
    kind: Kind | None
    node: ast.expr


def translate_filter(text: str, extra: Collection[str] | None = ()) -> Sql:
    """A filter (empty: all runs) as an SQL condition that is 1 or 0 for each run.

    `extra`: figures that some runs have beside the columns (:meth:`RunIndex.more_names`); None: not
    known yet, whatever is named as a figure is. Raises FilterError if it is no filter, with the
    place and what to type instead.
    """
    if not text.strip():
        return Sql("1")
    tree = parse_filter(text)
    nodes = sum(1 for _ in ast.walk(tree))
    if nodes > _MOST_NODES:
        raise FilterError(f"it has {nodes} parts, and {_MOST_NODES} are read", text, 0)
    try:
        return _Translation(text, extra).condition(tree)
    except RecursionError:
        raise FilterError("it is nested too deeply", text, 0) from None


class _Translation:
    """One filter on its way to SQL."""

    def __init__(self, text: str, extra: Collection[str] | None) -> None:
        self._text, self._extra = text, extra

    def condition(self, node: ast.expr) -> Sql:
        """A node that is true or false."""
        if isinstance(node, ast.BoolOp):
            word = " AND " if isinstance(node.op, ast.And) else " OR "
            return _join([self.condition(value) for value in node.values], word)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return _negated(self.condition(node.operand))
        if isinstance(node, ast.Compare):
            return self._comparison(node)
        if isinstance(node, ast.BinOp) and isinstance(
            node.op, LIKE | NOT_LIKE | CONTAINS | NOT_CONTAINS
        ):
            return self._match(node)
        value = self._value(node)
        if value.kind == "truth":
            return Sql(f"({value.sql.text} IS 1)", value.sql.values)
        self._refuse(
            f"{self._source_text(node)} is neither true nor false",
            node,
            "compare it: with == != < <= > >=, in, like or contains",
        )

    def _comparison(self, node: ast.Compare) -> Sql:
        parts, left = [], node.left
        for operator, right in zip(node.ops, node.comparators, strict=True):
            parts.append(self._compared(left, operator, right))
            left = right
        return _join(parts, " AND ")

    def _compared(self, left: ast.expr, operator: ast.cmpop, right: ast.expr) -> Sql:
        if isinstance(operator, ast.In | ast.NotIn):
            condition = self._membership(left, right)
            return condition if isinstance(operator, ast.In) else _negated(condition)
        a, b = self._value(left), self._value(right, beside=left)
        if type(operator) in _ORDER:
            return self._order(a, _ORDER[type(operator)], b)
        word = "IS NOT" if isinstance(operator, ast.NotEq | ast.IsNot) else "IS"
        if isinstance(operator, ast.Is | ast.IsNot) and None not in (a.kind, b.kind):
            self._refuse("`is` goes with None", right, "write == or !=")
        self._require_same_kind(a, b)
        return Sql(f"({a.sql.text} {word} {b.sql.text})", a.sql.values + b.sql.values)

    def _order(self, a: _Value, sign: str, b: _Value) -> Sql:
        for side in (a, b):
            if side.kind in (None, "truth"):
                self._refuse(
                    f"{self._source_text(side.node)} is neither less nor more than anything",
                    side.node,
                    "compare it with == or !=",
                )
        if a.kind == b.kind == "any":
            self._refuse(
                "it is not known whether these keys are numbers or texts",
                b.node,
                "compare a key that was typed with a value or a column",
            )
        self._require_same_kind(a, b)
        text = f"coalesce({a.sql.text} {sign} {b.sql.text}, 0)"
        values = a.sql.values + b.sql.values
        for side, other in ((a, b), (b, a)):
            if side.kind == "any":  # the database would order texts behind all numbers
                kinds = "('text')" if other.kind == "text" else "('integer', 'real')"
                text = f"({text} AND typeof({side.sql.text}) IN {kinds})"
                values += side.sql.values
        return Sql(f"({text})", values)

    def _membership(self, left: ast.expr, right: ast.expr) -> Sql:
        if isinstance(right, ast.Tuple | ast.List | ast.Set):
            a = self._value(left)
            parts = []
            for element in right.elts:
                b = self._value(element, beside=left)
                self._require_same_kind(a, b)
                parts.append(Sql(f"{a.sql.text} IS {b.sql.text}", a.sql.values + b.sql.values))
            return _join(parts, " OR ") if parts else Sql("0")
        return self._contained(self._value(left), self._value(right))

    def _contained(self, part: _Value, whole: _Value) -> Sql:
        for side in (part, whole):
            if side.kind not in ("text", "any"):
                self._refuse(
                    f"{self._source_text(side.node)} is no text",
                    side.node,
                    "a text contains a text: effects contains 'friction'; one of several values: "
                    "seed in (1, 2, 3)",
                )
        text = f"coalesce(instr({whole.sql.text}, {part.sql.text}) > 0, 0)"
        values = whole.sql.values + part.sql.values
        for side in (part, whole):
            if side.kind == "any":
                text = f"({text} AND typeof({side.sql.text}) = 'text')"
                values += side.sql.values
        return Sql(f"({text})", values)

    def _match(self, node: ast.BinOp) -> Sql:
        if isinstance(node.op, CONTAINS | NOT_CONTAINS):
            condition = self._contained(
                self._value(node.right, beside=node.left), self._value(node.left)
            )
        else:
            condition = self._like(node)
        return _negated(condition) if isinstance(node.op, NOT_LIKE | NOT_CONTAINS) else condition

    def _like(self, node: ast.BinOp) -> Sql:
        value, pattern = self._value(node.left), node.right
        if value.kind not in ("text", "any"):
            self._refuse(
                f"{self._source_text(node.left)} is no text", node.left, "like goes with text"
            )
        if not (isinstance(pattern, ast.Constant) and isinstance(pattern.value, str)):
            self._refuse("like takes a text", pattern, "controller like '*mpc'")
        glob = pattern.value.replace("%", "*").replace("[", "[[]")
        if len(glob) > _LONGEST_PATTERN or glob.count("*") > _MOST_STARS:
            self._refuse("the pattern is too long, or has too many stars", pattern)
        text = f"(coalesce({value.sql.text} GLOB ?, 0) AND typeof({value.sql.text}) = 'text')"
        return Sql(text, (*value.sql.values, glob, *value.sql.values))

    def _value(self, node: ast.expr, beside: ast.expr | None = None) -> _Value:
        """A node that is a number, a text, a truth value or None."""
        if isinstance(node, ast.Constant):
            return self._constant(node, node.value)
        if isinstance(node, ast.Name | ast.Attribute):
            return self._column(node, beside)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            operand = self._number(node.operand)
            sign = "-" if isinstance(node.op, ast.USub) else "+"
            return _Value(Sql(f"({sign} {operand.text})", operand.values), "number", node)
        if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            a, b = self._number(node.left), self._number(node.right)
            sign = _ARITHMETIC[type(node.op)]
            return _Value(Sql(f"({a.text} {sign} {b.text})", a.values + b.values), "number", node)
        if isinstance(node, ast.BoolOp | ast.Compare) or (
            isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
        ):
            self._refuse(
                "a condition is not compared with anything", node, "join conditions by and, or, not"
            )
        self._refuse(
            f"{self._source_text(node)} is not understood in a filter",
            node,
            "there are columns, numbers, 'texts', None, + - * /, comparisons, in, like, contains, "
            "and, or, not and brackets; nothing is called",
        )

    def _constant(self, node: ast.expr, value: object) -> _Value:
        if value is None:
            return _Value(Sql("NULL"), None, node)
        if isinstance(value, bool):
            return _Value(Sql("1" if value else "0"), "truth", node)
        if isinstance(value, int) and abs(value) < 2**63:
            return _Value(Sql("?", (value,)), "whole", node)
        if isinstance(value, int | float):
            number = float(value) if abs(value) < 1e300 else float("inf") * (1 if value > 0 else -1)
            return _Value(Sql("?", (number,)), "number", node)
        if isinstance(value, str) and not any("\ud800" <= c <= "\udfff" for c in value):
            return _Value(Sql("?", (value,)), "text", node)
        self._refuse(f"{self._source_text(node)} is no value of a column", node)

    def _column(self, node: ast.Name | ast.Attribute, beside: ast.expr | None) -> _Value:
        name = dotted_name(node)
        if name is None:
            self._refuse(f"{self._source_text(node)} is no column", node)
        if name.lower() in _CONSTANTS:
            return self._constant(node, _CONSTANTS[name.lower()])
        entry = column_sql(name, self._extra)
        if entry is None:
            remedy = nearest(name, self._extra)
            if beside is not None and self._is_text(beside):
                remedy = f"a text is quoted: '{name}'; or {remedy}"
            self._refuse(f"there is no column {name!r}", node, remedy)
        column, sql = entry
        return _Value(sql, column.kind, node)

    def _is_text(self, node: ast.expr) -> bool:
        name = dotted_name(node)
        entry = None if name is None else column_sql(name, self._extra)
        return entry is not None and entry[0].kind == "text"

    def _number(self, node: ast.expr) -> Sql:
        value = self._value(node)
        if value.kind == "any":
            text = value.sql.text
            sql = f"CASE WHEN typeof({text}) IN ('integer', 'real') THEN CAST({text} AS REAL) END"
            return Sql(f"({sql})", value.sql.values * 2)
        if value.kind not in ("number", "whole"):
            self._refuse(
                f"{self._source_text(node)} is no number", node, "numbers can be reckoned with"
            )
        return Sql(f"CAST({value.sql.text} AS REAL)", value.sql.values)

    def _require_same_kind(self, a: _Value, b: _Value) -> None:
        kinds = {"number" if v.kind == "whole" else v.kind for v in (a, b)} - {None, "any"}
        if len(kinds) < 2:
            return
        words = {"text": "a text", "number": "a number", "truth": "true or false"}
        said = [f"{self._source_text(v.node)} is {words[_broad(v.kind)]}" for v in (a, b)]
        remedy = "compare like with like"
        if "truth" in kinds:
            remedy = "write it alone (complete), or with not (not complete)"
        elif isinstance(b.node, ast.Constant):
            remedy = "a text is quoted, a number is not"
        self._refuse(", ".join(said), b.node, remedy)

    def _source_text(self, node: ast.expr) -> str:
        """A node as it was typed, in short."""
        begin = character(self._text, node.col_offset)
        end = character(self._text, node.end_col_offset or node.col_offset)
        typed = self._text[begin:end]
        return typed if len(typed) <= 40 else f"{typed[:37]}…"

    def _refuse(self, problem: str, node: ast.expr, remedy: str = "") -> NoReturn:
        raise FilterError(problem, self._text, character(self._text, node.col_offset), remedy)


def _broad(kind: Kind | None) -> str:
    return "number" if kind in ("number", "whole") else str(kind)


def dotted_name(node: ast.expr) -> str | None:
    """``plant.prior_seed`` of a chain of attributes."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join(reversed([*parts, node.id])) if isinstance(node, ast.Name) else None


def _negated(condition: Sql) -> Sql:
    return Sql(f"(NOT {condition.text})", condition.values)


def _join(parts: list[Sql], word: str) -> Sql:
    values = tuple(value for part in parts for value in part.values)
    return Sql(f"({word.join(part.text for part in parts)})", values)


def names_in(text: str) -> list[str]:
    """Columns and keys of a filter, as they were typed, each once.

    Raises FilterError if it is no expression.
    """
    if not text.strip():
        return []
    names: dict[str, None] = {}
    waiting: list[ast.AST] = [parse_filter(text)]
    while waiting:
        node = waiting.pop(0)
        name = dotted_name(node) if isinstance(node, ast.expr) else None
        if name is None:
            waiting.extend(ast.iter_child_nodes(node))
        elif column_sql(name, None) is not None:
            names[name] = None
    return list(names)
