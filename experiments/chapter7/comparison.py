"""Figures of a run against those that are expected."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Deviation:
    """A figure that is not what was expected."""

    key: str  #: Run and figure
    expected: float | None  #: None where there is none
    now: float | None  #: None where there is none


def deviations(
    expected: Mapping[str, Any], now: Mapping[str, Any], tolerances: Mapping[str, float]
) -> Iterator[Deviation]:
    """What deviates by more than its tolerance, or is not there any more.

    ``expected``, ``now``: figures by run, nested; only figures named in ``tolerances`` are looked
    at.
    """
    for key, value, was in _figures(expected, now):
        name = key.rpartition(".")[2]
        if name not in tolerances:
            continue
        if value is None or was is None:
            if value is not was:
                yield Deviation(key, was, value)
        elif not abs(value - was) <= tolerances[name]:
            yield Deviation(key, was, value)


def _figures(
    expected: Mapping[str, Any], now: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, float | None, float | None]]:
    """Name, present and expected value of every figure that was expected."""
    for name, was in expected.items():
        value = now.get(name)
        if isinstance(was, Mapping):
            inner = value if isinstance(value, Mapping) else {}
            yield from _figures(was, inner, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value, was
