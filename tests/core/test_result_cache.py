"""Kept results: found again bit for bit, by all their inputs, and never in the way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trms_cli.core.process_cache import cached_result


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "cache" / "functions"))


def test_second_call_finds_the_same_bits(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    "other", [[np.arange(3.0) + 1, 0.1], [np.arange(3.0), 0.2], [np.arange(3.0)]]
)
def test_other_inputs_are_another_result(other: list[object]) -> None:
    assert cached_result(__file__, [np.arange(3.0), 0.1], int, lambda: 1) == 1
    assert cached_result(__file__, other, int, lambda: 2) == 2


def test_an_edit_of_the_code_makes_the_result_anew(tmp_path: Path) -> None:
    code = tmp_path / "code.py"
    code.write_text("first")
    assert cached_result(str(code), [1], int, lambda: 1) == 1
    code.write_text("second")
    assert cached_result(str(code), [1], int, lambda: 2) == 2


def test_damaged_or_unwritable_cache_costs_time_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cached_result(__file__, [1], int, lambda: 1) == 1
    for file in (tmp_path / "cache" / "results").iterdir():
        file.write_text("{")
    assert cached_result(__file__, [1], int, lambda: 1) == 1
    blocked = tmp_path / "a_file"
    blocked.write_text("")
    monkeypatch.setenv("TRMS_CACHE", str(blocked / "functions"))
    assert cached_result(__file__, [1], int, lambda: 1) == 1


def test_failures_are_not_kept() -> None:
    def fail() -> int:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        cached_result(__file__, [1], int, fail)
    assert cached_result(__file__, [1], int, lambda: 5) == 5
