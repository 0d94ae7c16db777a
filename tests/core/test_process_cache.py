"""What a process keeps: found by content, bounded, and never in the way. What is kept in files:
found again bit for bit, by all its inputs.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from trms_cli.core import process_cache
from trms_cli.core.process_cache import MOST_RESULTS, cached_result, call_memoised, forget
from trms_cli.models.newtonian import Newtonian

_calls: list[Any] = []


@pytest.fixture(autouse=True)
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "cache" / "functions"))
    forget()
    _calls.clear()
    yield
    forget()


@dataclass
class Weights:
    """A mutable thing that a result follows from."""

    values: dict[str, float]


def total(weights: Weights) -> float:
    _calls.append(weights)
    return sum(weights.values.values())


def plain(value: Any) -> list[Any]:
    _calls.append(value)
    return [value]


def test_equal_content_is_computed_once_and_an_object_that_was_changed_is_another_input() -> None:
    assert plain(1) is not call_memoised(plain, 1)
    _calls.clear()
    assert call_memoised(plain, {"a": 0.1}) is call_memoised(plain, {"a": 0.1})
    assert call_memoised(plain, np.arange(3.0)) is call_memoised(plain, np.arange(3.0))
    assert len(_calls) == 2
    _calls.clear()
    weights = Weights({"a": 1.0, "b": 2.0})
    assert call_memoised(total, weights) == 3.0
    weights.values["b"] = 5.0
    assert call_memoised(total, weights) == 6.0
    weights.values["b"] = 2.0
    assert call_memoised(total, weights) == 3.0
    assert len(_calls) == 2


@pytest.mark.parametrize(
    ("one", "other"),
    [(1, 1.0), (0.0, -0.0), ((1, 2), [1, 2]), ("1", 1), (np.float32(1), np.float64(1))],
)
def test_what_is_only_equal_in_value_is_told_apart(one: Any, other: Any) -> None:
    assert call_memoised(plain, one) is not call_memoised(plain, other)


def test_functions_of_equal_inputs_and_casadi_functions_are_told_apart_by_what_they_are() -> None:
    assert call_memoised(total, Weights({})) == 0
    assert call_memoised(plain, Weights({})) == [Weights({})]
    x = ca.SX.sym("x")
    one, other = (ca.Function("f", [x], [k * x]) for k in (2, 3))
    assert call_memoised(plain, one) is call_memoised(plain, ca.Function(one))
    assert call_memoised(plain, one) is not call_memoised(plain, other)


def test_a_class_defined_anew_and_a_model_with_parameters_assigned_are_other_inputs() -> None:
    def defined(factor: float) -> Any:
        space: dict[str, Any] = {"__name__": "notebook"}
        exec(f"class Cell:\n    def of(self):\n        return {factor}", space)
        return space["Cell"]()

    found = [call_memoised(_what_a_cell_says, defined(factor)) for factor in (1.0, 2.0)]
    assert found == [1.0, 2.0]
    model = Newtonian()
    before = call_memoised(_coupling, model)
    assert call_memoised(_coupling, Newtonian()) == before and len(_calls) == 1
    model.parameters = model.parameters.replaced({"k_g": 0.05})
    assert call_memoised(_coupling, model) == 0.05 != before
    model.parameters = Newtonian().parameters
    assert call_memoised(_coupling, model) == before


def _what_a_cell_says(cell: Any) -> float:
    return float(cell.of())


def test_inputs_without_a_content_are_computed_each_time() -> None:
    closing_over = 1.0

    def closure() -> float:
        return closing_over

    x = ca.SX.sym("x")
    for value in (closure, x, (i for i in range(3))):
        assert call_memoised(plain, value) is not call_memoised(plain, value)
    assert not process_cache._kept


def _inverse(value: float) -> float:
    return 1.0 / value


def test_what_is_raised_is_not_kept_nor_in_files() -> None:
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            call_memoised(_inverse, 0.0)
        with pytest.raises(ZeroDivisionError):
            cached_result(__file__, [1], int, lambda: 1 // 0)
    assert not process_cache._kept
    assert cached_result(__file__, [1], int, lambda: 5) == 5


def test_the_longest_unused_goes_first() -> None:
    first = call_memoised(plain, "first")
    for i in range(MOST_RESULTS):
        call_memoised(plain, i)
        assert call_memoised(plain, "first") is first
    assert len(process_cache._kept) == MOST_RESULTS
    assert call_memoised(plain, 0) is not None and _calls.count(0) == 2  # it had gone


def _coupling(model: Newtonian) -> float:
    _calls.append(model)
    return model.parameters["k_g"].value


def test_equal_inputs_and_code_find_the_same_bits(tmp_path: Path) -> None:
    calls = []

    def compute() -> list[float]:
        calls.append(1)
        return [1 / 3, 2.0**-1074, 1e300]

    inputs = [np.arange(3.0), 0.1, "axis"]
    first = cached_result(__file__, inputs, list[float], compute)
    again = cached_result(__file__, inputs, list[float], compute)
    assert again == first == [1 / 3, 2.0**-1074, 1e300]
    assert len(calls) == 1
    assert len(list((tmp_path / "cache" / "results").iterdir())) == 1
    x = np.arange(3.0)
    for n, other in enumerate(([x, 0.1], [x + 1, 0.1], [x, 0.2], [x])):
        assert cached_result(__file__, other, int, lambda n=n: n) == n
    code = tmp_path / "code.py"
    code.write_text("first")
    assert cached_result(str(code), [1], int, lambda: 1) == 1
    code.write_text("second")
    assert cached_result(str(code), [1], int, lambda: 2) == 2


def test_damaged_or_unwritable_cache_costs_time_only(tmp_path, monkeypatch) -> None:
    assert cached_result(__file__, [1], int, lambda: 1) == 1
    for file in (tmp_path / "cache" / "results").iterdir():
        file.write_text("{")
    assert cached_result(__file__, [1], int, lambda: 1) == 1
    blocked = tmp_path / "a_file"
    blocked.write_text("")
    monkeypatch.setenv("TRMS_CACHE", str(blocked / "functions"))
    assert cached_result(__file__, [1], int, lambda: 1) == 1
