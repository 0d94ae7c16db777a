"""Two runs side by side: every figure of both, and what they were given differently."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from trms_cli.scoring.comparison.compared_run import ComparedRun
from trms_cli.scoring.comparison.coordinates import differences
from trms_cli.scoring.figures import Group, entries

_GROUPS: tuple[Group, ...] = ("channels", "inputs", "solver", "run")


@dataclass(frozen=True, kw_only=True)
class PairRow:
    """A figure of both runs; all are better when small."""

    key: str  #: ``channels.alpha_v.rmse``
    label: str  #: In words, with the channel
    unit: str
    one: float | None  #: in the row's unit
    other: float | None  #: in the row's unit

    @property
    def change(self) -> float | None:
        """(other − one)/one; None where it says nothing."""
        if self.one is None or self.other is None or abs(self.one) < 1e-12:
            return None
        return (self.other - self.one) / abs(self.one)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two runs."""

    one: ComparedRun
    other: ComparedRun
    #: Keys of the configuration that differ, with both values
    settings: tuple[tuple[str, str, str], ...]
    rows: tuple[PairRow, ...]


def pair(one: ComparedRun, other: ComparedRun) -> Pair:
    """Put two runs side by side."""
    chosen = [
        (key, one.coordinates.get(key, "–"), other.coordinates.get(key, "–"))
        for key in dict.fromkeys([*one.coordinates, *other.coordinates])
        if one.coordinates.get(key) != other.coordinates.get(key)
    ]
    # keys below an option that differs follow from the option
    below = tuple(f"{key}." for key, _, _ in chosen if "." not in key)
    named = {key for key, _, _ in chosen}
    settings = [
        row
        for row in differences(one.config, other.config)
        if row[0] not in named and not row[0].startswith(below)
    ]
    return Pair(one=one, other=other, settings=(*chosen, *settings), rows=tuple(_rows(one, other)))


def _rows(one: ComparedRun, other: ComparedRun) -> Iterator[PairRow]:
    """The figures of both that are better when small, where one of them has one."""
    left, right = ({e.key: e for e in entries(run.score or {}, *_GROUPS)} for run in (one, other))
    for key in dict.fromkeys([*left, *right]):
        entry = left.get(key) or right[key]
        values = [side[key].value if key in side else None for side in (left, right)]
        of_all = entry.figure.group in ("solver", "run")
        if of_all:
            values = [None if value is None else float(value) for value in values]
        if entry.figure.better == "less" and (of_all or any(v is not None for v in values)):
            unit = entry.unit or (right[key].unit if key in right else "")
            yield PairRow(key=key, label=entry.label, unit=unit, one=values[0], other=values[1])
