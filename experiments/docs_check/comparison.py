"""What moved between two versions of a table, and of a picture."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: A number as the pages write one: signs and exponents of print, too.
_NUMBER = re.compile(r"[-−+]?\d+(?:\.\d+)?(?:[eE][-−+]?\d+)?")
_RULE = re.compile(r"^\|[\s:|-]+\|$")
#: Edge of a tile, pixels, and the least difference of its mean luminance that is one, of 255.
_TILE, _LUMINANCE = 8, 8.0


@dataclass(frozen=True)
class Change:
    """A cell or a line that moved by more than it may."""

    where: str  #: Page and table, or the picture
    row: str
    old: str
    new: str

    def __str__(self) -> str:
        row = f", {self.row}" if self.row else ""
        return f"{self.where}{row}: {self.old or 'nothing'} → {self.new or 'nothing'}"


@dataclass(frozen=True)
class _Row:
    """A line of a block: its cells, and which of them tell times."""

    label: str
    heads: tuple[str, ...]
    cells: tuple[str, ...]
    timed: tuple[bool, ...]

    @property
    def skeleton(self) -> tuple[str, ...]:
        """The words without numbers; times are words alike."""
        return tuple(
            "time" if timed else _NUMBER.sub("#", cell)
            for cell, timed in zip(self.cells, self.timed, strict=True)
        )


def compare_blocks(
    old: str,
    new: str,
    where: str,
    tolerance: float,
    times: Sequence[str] = (),
    digits: float = 1.0,
) -> list[Change]:
    """The changes from an old block to a new one.

    Parameters
    ----------
    tolerance : float
        Share of a number by which it may move, beside its last digit.
    times : sequence of str
        Cells, columns, rows and lines with such words are not compared.
    digits : float
        By how many of its last digit a number may move.
    """
    before, after = list(_rows(old, times)), list(_rows(new, times))
    matcher = difflib.SequenceMatcher(
        a=[row.skeleton for row in before], b=[row.skeleton for row in after], autojunk=False
    )
    changes: list[Change] = []
    for kind, i, i_end, j, j_end in matcher.get_opcodes():
        if kind == "equal":
            for first, second in zip(before[i:i_end], after[j:j_end], strict=True):
                changes += _moved(first, second, where, tolerance, digits)
        elif i_end - i == j_end - j:
            for first, second in zip(before[i:i_end], after[j:j_end], strict=True):
                changes += _other_words(first, second, where, tolerance, digits)
        else:
            changes += [
                Change(where, row.label, " | ".join(row.cells), "") for row in before[i:i_end]
            ]
            changes += [
                Change(where, row.label, "", " | ".join(row.cells)) for row in after[j:j_end]
            ]
    return changes


def _rows(text: str, times: Sequence[str]) -> Iterator[_Row]:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    heads: tuple[str, ...] = ()
    for i, line in enumerate(lines):
        if not line.startswith("|"):
            heads = ()
            timed = any(word in line for word in times)
            yield _Row("", ("",), (line,), (timed,))
            continue
        if _RULE.match(line):
            continue
        cells = tuple(cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
        if i + 1 < len(lines) and _RULE.match(lines[i + 1]):
            heads = cells
            yield _Row("head", cells, cells, (False,) * len(cells))
            continue
        if len(heads) != len(cells):
            heads = ("",) * len(cells)
        label = " ".join(cell for cell in cells[:2] if cell == cells[0] or _is_name(cell)).strip()
        row_timed = any(word in cells[0] for word in times)
        columns = tuple(row_timed or any(word in head for word in times) for head in heads)
        yield _Row(label, heads, cells, columns)


def _is_name(cell: str) -> bool:
    """Whether a cell says what its row is about, rather than a figure."""
    return not _NUMBER.search(cell)


def _moved(old: _Row, new: _Row, where: str, tolerance: float, digits: float) -> list[Change]:
    changes = []
    for head, timed, first, second in zip(old.heads, old.timed, old.cells, new.cells, strict=True):
        if not timed and not _same(first, second, tolerance, digits):
            row = f"{old.label}, {head}".strip(", ")
            changes.append(Change(where, row, first, second))
    return changes


def _other_words(old: _Row, new: _Row, where: str, tolerance: float, digits: float) -> list[Change]:
    if len(old.cells) != len(new.cells):
        return [Change(where, old.label, " | ".join(old.cells), " | ".join(new.cells))]
    return _moved(old, new, where, tolerance, digits)


def _same(old: str, new: str, tolerance: float, digits: float) -> bool:
    if _NUMBER.sub("#", old) != _NUMBER.sub("#", new):
        return False
    pairs = zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True)
    return all(_near(first, second, tolerance, digits) for first, second in pairs)


def _near(old: str, new: str, tolerance: float, digits: float) -> bool:
    before, after = (float(word.replace("−", "-")) for word in (old, new))
    last = max(_last_digit(old), _last_digit(new)) if _is_rounded(old, new) else 0.0
    return abs(after - before) <= 1.001 * digits * last + tolerance * abs(before)


def _is_rounded(*words: str) -> bool:
    """Whether a number has been rounded; one of one or two digits and no point is a count."""
    return any("." in word or "e" in word.lower() or len(word.lstrip("-−+")) > 2 for word in words)


def _last_digit(word: str) -> float:
    mantissa, _, exponent = word.lower().replace("−", "-").partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(10.0 ** (int(exponent or 0) - decimals))


def picture_difference(old: Path, new: Path) -> float:
    """Share of the tiles of a picture that look otherwise; 1 where its size is another."""
    if old.suffix == ".svg":
        first, second = (file.read_text(encoding="utf-8") for file in (old, new))
        return float(bool(compare_blocks(first, second, "", 0.01)))
    before, after = _tiles(old), _tiles(new)
    if before.shape != after.shape:
        return 1.0
    return float(np.mean(np.abs(before - after) > _LUMINANCE))


def _tiles(file: Path) -> np.ndarray:
    """Mean luminance of each tile of each frame."""
    from PIL import Image, ImageSequence

    with Image.open(file) as picture:
        frames = [
            np.asarray(frame.convert("RGBA").convert("L"), dtype=float)
            for frame in ImageSequence.Iterator(picture)
        ]
    stack = np.stack(frames)
    height, width = (size // _TILE * _TILE for size in stack.shape[1:])
    cut = stack[:, :height, :width]
    shape = (len(frames), height // _TILE, _TILE, width // _TILE, _TILE)
    return np.asarray(cut.reshape(shape).mean(axis=(2, 4)))
