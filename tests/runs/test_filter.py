"""Filters mean what the same expression means to Python, and nothing that they hold is run."""

from __future__ import annotations

import fnmatch
import math
import operator
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.runs.columns import COLUMNS, Sql
from trms_cli.runs.entry import IndexEntry
from trms_cli.runs.filter import FilterError, names_in, translate_filter
from trms_cli.runs.index import FileStamp, LogReading, RunIndex

NUMBERS = ("rmse_alpha_h", "rmse_alpha_v", "duration")
WHOLES = ("seed", "failures")
TEXTS = ("controller", "effects")


class Missing:
    """What a run does not have, by the rules of the language."""

    def __eq__(self, other: object) -> bool:
        return other is None or isinstance(other, Missing)

    def __hash__(self) -> int:
        return 0

    def never(self, other: object) -> bool:
        return False

    __lt__ = __le__ = __gt__ = __ge__ = __contains__ = never

    def same(self, other: object = None) -> Missing:
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = same
    __truediv__ = __rtruediv__ = __neg__ = __pos__ = same


def with_missing(operation: Callable[[float, float], float]) -> Callable[[Any, Any], Any]:
    """An operation by the rules of the language: what has no value is missing."""

    def result(one: Any, other: Any) -> Any:
        if isinstance(other, Missing) or (operation is operator.truediv and other == 0):
            return Missing()
        value = operation(float(one), float(other))
        return Missing() if math.isnan(value) else Number(value)

    return result


class Number(float):
    """A number whose arithmetic is that of the language."""

    __add__, __sub__ = with_missing(operator.add), with_missing(operator.sub)
    __mul__, __truediv__ = with_missing(operator.mul), with_missing(operator.truediv)

    def __neg__(self) -> Any:
        return Number(-float(self))


finite = st.floats(-100, 100) | st.sampled_from([0.0, 0.5, 1.0, -1.0])
words = st.text("ab'\"%_*?[]\\é ;-", max_size=4)
rows = st.fixed_dictionaries(
    {name: st.none() | finite for name in NUMBERS}
    | {name: st.none() | st.integers(-3, 3) for name in WHOLES}
    | {name: st.none() | words for name in TEXTS}
    | {"complete": st.none() | st.booleans()}
)


def number_parts(depth: int) -> st.SearchStrategy[str]:
    leaf = st.sampled_from([*NUMBERS, *WHOLES]) | finite.map(lambda x: f"N({x!r})")
    if depth == 0:
        return leaf
    inner = number_parts(depth - 1)
    joined = st.tuples(inner, st.sampled_from("+-*/"), inner).map(
        lambda p: f"({p[0]} {p[1]} {p[2]})"
    )
    return leaf | joined | inner.map(lambda part: f"(-{part})")


def conditions(depth: int) -> st.SearchStrategy[str]:
    number, text = number_parts(2), st.sampled_from(TEXTS) | words.map(repr)
    order = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
    several = st.lists(words.map(repr), min_size=1, max_size=3).map(lambda w: f"({', '.join(w)},)")
    leaf = (
        st.tuples(number, order, number).map(" ".join)
        | st.tuples(number, order, number, order, number).map(" ".join)
        | st.tuples(text, order, text).map(" ".join)
        | st.tuples(st.sampled_from(TEXTS), st.sampled_from(["in", "not in"]), several).map(
            " ".join
        )
        | st.tuples(words.map(repr), st.sampled_from(["in", "not in"]), st.sampled_from(TEXTS)).map(
            " ".join
        )
        | st.tuples(
            st.sampled_from([*NUMBERS, *TEXTS]), st.sampled_from(["is", "is not", "==", "!="])
        ).map(lambda p: f"{p[0]} {p[1]} None")
        | st.just("complete")
    )
    if depth == 0:
        return leaf
    inner = conditions(depth - 1)
    return (
        leaf
        | inner.map(lambda part: f"not ({part})")
        | st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(lambda p: f"({' '.join(p)})")
    )


def by_python(text: str, row: dict[str, Any]) -> bool:
    """The same expression evaluated by Python over the row's values."""
    values: dict[str, Any] = {"N": Number}
    for name, value in row.items():
        if name == "complete":
            values[name] = value is True
        elif value is None:
            values[name] = Missing()
        else:
            values[name] = Number(value) if name in (*NUMBERS, *WHOLES) else value
    text = text.replace("is not None", "!= None").replace("is None", "== None")
    return bool(eval(text, {"__builtins__": {}}, values))


def by_index(condition: Sql, rows: list[dict[str, Any]]) -> list[int]:
    """Positions of the rows for which the index finds a condition true."""
    looked = []
    for k, row in enumerate(rows):
        values = dict.fromkeys(COLUMNS) | row | {"log": f"/{k:03}"}
        looked.append(LogReading(values["log"], FileStamp(1, 1), IndexEntry(values["log"], values)))
    with RunIndex(None) as index:
        index.put(looked)
        columns = {"log": (COLUMNS["log"], Sql("log"))}
        found = index.select(columns, condition, Sql("log"), descending=False, limit=None)
        assert index.count(condition) == len(found)
    return [int(run["log"][1:]) for run in found]


class TestMeaning:
    """Against Python."""

    @settings(max_examples=250)
    @given(text=conditions(2), rows=st.lists(rows, min_size=1, max_size=4))
    def test_as_python_has_it(self, text, rows):
        expected = [k for k, row in enumerate(rows) if by_python(text, row)]
        typed = text.replace("N(", "(")
        assert by_index(translate_filter(typed), rows) == expected

    @settings(max_examples=150)
    @given(
        pattern=st.text("ab*?_é;'", max_size=5),
        values=st.lists(st.none() | st.text("ab_é;'[]*", max_size=5), min_size=1, max_size=5),
    )
    def test_like_is_that_of_file_names(self, pattern, values):
        rows = [{"controller": value} for value in values]
        expected = [
            k for k, v in enumerate(values) if v is not None and fnmatch.fnmatchcase(v, pattern)
        ]
        assert by_index(translate_filter(f"controller like {pattern!r}"), rows) == expected
        others = sorted(set(range(len(rows))) - set(expected))
        assert by_index(translate_filter(f"controller not like {pattern!r}"), rows) == others

    @settings(max_examples=100)
    @given(part=words, values=st.lists(st.none() | words, min_size=1, max_size=5))
    def test_contains_is_in_turned_round(self, part, values):
        rows = [{"effects": value} for value in values]
        contains = by_index(translate_filter(f"effects contains {part!r}"), rows)
        assert contains == [k for k, v in enumerate(values) if v is not None and part in v]
        assert contains == by_index(translate_filter(f"{part!r} in effects"), rows)
        others = sorted(set(range(len(rows))) - set(contains))
        assert by_index(translate_filter(f"effects not contains {part!r}"), rows) == others

    @pytest.mark.parametrize(
        ("text", "matches"),
        [
            ("", [0, 1, 2]),
            ("rmse_yaw < 0.05", [0]),
            ("0.04 <= rmse_yaw <= 0.06", [0, 1]),
            ("rmse_yaw is null", [2]),
            ("rmse_pitch == None", [0, 1, 2]),
            ("not rmse_yaw < 0.05", [1, 2]),
            ("seed in (1, 2.0)", [0, 1]),
            ("seed not in [1, 2]", [2]),
            ("seed in ()", []),
            ("complete == true and not complete == False", [0]),
            ("not complete", [1, 2]),
            ("controller like '%mpc'", [0]),
            ("effect contains 'a b'", [1]),
            ("\n controller ==\t'pid' ", [1]),
            ("seed == -1 or +seed > 2", [2]),
            ("rmse_yaw < 1e400", [0, 1]),
            ("seed < 99999999999999999999999", [0, 1, 2]),
            ("controller == 'like'", []),
        ],
    )
    def test_examples(self, text, matches):
        rows = [
            {"controller": "newton_mpc", "rmse_alpha_h": 0.04, "seed": 1, "complete": True},
            {"controller": "pid", "rmse_alpha_h": 0.06, "seed": 2, "effects": "a b+c"},
            {"seed": 3, "complete": False},
        ]
        assert by_index(translate_filter(text), rows) == matches


class TestHostile:
    """Whatever is typed is data, or an error with its place."""

    @pytest.mark.parametrize(
        "text",
        [
            "__import__('os').system('id')",
            "controller.upper() == 'PID'",
            "().__class__.__bases__",
            "[x for x in (1, 2)]",
            "(lambda: 1)() == 1",
            "controller[0] == 'p'",
            "f'{controller}' == 'pid'",
            "(x := 1) == 1",
            "seed if complete else seed",
            "seed == 1; DROP TABLE runs",
            "1 = 1 -- ",
            "seed ** 2 == 4",
            "seed % 2 == 0",
            "seed // 2 == 1",
            "seed @ 2 == 0",
            "await seed",
            "*seed",
            "controller == b'pid'",
            "seed == 1j",
            "seed == ...",
            "seed == {1: 2}",
            "controller == 3",
            "seed == 'three'",
            "complete < 3",
            "complete == 1.0",
            "seed is 3",
            "None < 3",
            "controller",
            "'pid'",
            "3",
            "a.b < c.d",
            "controller like seed",
            "seed like '1*'",
            "controller like",
            "like 'x'",
            "(((",
            "'",
            "\x00",
            "\x1b[2J",
            "seed == '\ud800'",
            "(" * 300 + "seed" + ")" * 300 + " == 1",
            "not " * 390 + "complete and seed == 'x'",
            " or ".join(["seed == 1"] * 500),
            "x" * 5000,
            "controller like '" + "*a" * 20 + "'",
            "seed == " + "9" * 3000 + " == 'x'",
            "éé == 1",
        ],
    )
    def test_what_is_refused_says_why_and_where(self, text):
        with pytest.raises(FilterError) as caught:
            translate_filter(text)
        error = caught.value
        assert 0 <= error.position <= len(text)
        assert error.problem
        _, line, mark = error.where.split("\n")
        assert mark.strip() == "^"
        assert len(line) <= 70
        assert line.isprintable()

    @settings(max_examples=300)
    @given(st.text(max_size=40) | st.text("()'\"<>=!.,and ornotseed1e*%@:", max_size=30))
    def test_any_text_is_a_filter_or_an_error_of_ours(self, text):
        try:
            condition = translate_filter(text)
        except FilterError:
            return
        by_index(condition, [{"seed": 1}])

    @settings(max_examples=100)
    @given(st.text(st.characters(exclude_categories=["Cs"]), max_size=20))
    def test_a_text_is_bound_whatever_it_holds(self, value):
        text = f"controller == {value!r}"
        rows = [{"controller": value}, {"controller": value + "x"}]
        condition = translate_filter(text)
        assert value not in condition.text or value in '(controller) IS?"'
        assert by_index(condition, rows) == [0]

    @pytest.mark.parametrize(
        "value", ["' OR 1=1 --", "'); DROP TABLE runs; --", '" OR ""="', "?", "%s", ":a", "\\'"]
    )
    def test_injection(self, value):
        rows = [{"controller": "pid"}, {"controller": value}]
        assert by_index(translate_filter(f"controller == {value!r}"), rows) == [1]
        assert by_index(translate_filter(f"controller contains {value!r}"), rows) == [1]

    @pytest.mark.parametrize("key", ["plant.a", "x.y.z", "é.ü"])
    def test_a_key_is_bound_too(self, key):
        condition = translate_filter(f"{key} == 'x'")
        assert key not in condition.text
        assert condition.values[0] == f'$."{key}"'


class TestErrors:
    @pytest.mark.parametrize(
        ("text", "position", "hint"),
        [
            ("seed == 1 and rmse_yw < 3", 14, "rmse_yaw"),
            ("controller == pid", 14, "quoted: 'pid'"),
            ("controller = 'pid'", 11, "=="),
            ("seed == 1 & seed == 2", None, ""),
            ("seed <> 1", 5, "!="),
            ("controller == 'é' and sed == 1", 22, "seed"),
            ("   sed == 1", 3, "seed"),
            ("complete == 'yes'", 12, "not complete"),
            ("controller < 3", 13, "quoted"),
        ],
    )
    def test_place_and_remedy(self, text, position, hint):
        with pytest.raises(FilterError) as caught:
            translate_filter(text)
        if position is not None:
            assert caught.value.position == position
        assert hint in caught.value.remedy

    def test_names_of_a_filter(self):
        text = "rmse_yaw < 1 and plant.prior_seed == 3 or rmse_yaw > sed"
        assert names_in(text) == ["rmse_yaw", "plant.prior_seed"]
        assert names_in("") == []
