"""Figures that a study records, and what has moved since."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, ConfigurationError

#: A number, a verdict in words, or nothing.
Figure = float | str | bool | None
Figures = Mapping[str, Mapping[str, Figure]]


class Tolerance(msgspec.Struct, forbid_unknown_fields=True):
    """By how much a figure may move."""

    absolute: float
    relative: float


def rounded(node: Any, digits: int = 6) -> Any:
    """Figures to six digits, what comes after them depends on the compiler; no infinities."""
    if isinstance(node, Mapping):
        return {str(key): rounded(value, digits) for key, value in node.items()}
    if isinstance(node, Sequence) and not isinstance(node, str):
        return [rounded(value, digits) for value in node]
    if isinstance(node, float | np.floating):
        return float(f"{node:.{digits}g}") if math.isfinite(node) else None
    return node


def json_text(document: Any) -> str:
    """A document as the studies keep it."""
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def read_expected(file: Path, part: str) -> dict[str, dict[str, Any]]:
    """A part of the recorded figures.

    Raises ConfigurationError if the file has none.
    """
    try:
        return dict(json.loads(file.read_text(encoding="utf-8"))[part])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            "there are no recorded figures",
            where=str(file),
            remedy=f"python -m experiments.{file.parent.name} --update records today's",
        ) from error


def differences(
    figures: Figures, expected: Figures, tolerances: Mapping[str, Tolerance]
) -> list[str]:
    """A sentence for each figure of the parts with a tolerance that is not what was recorded."""
    words = []
    for part, allowed in tolerances.items():
        ours, expected_part = figures.get(part, {}), expected.get(part, {})
        for name in sorted(ours.keys() ^ expected_part.keys()):
            words.append(f"{part}: {name} is {'new' if name in ours else 'gone'}")
        for name in sorted(ours.keys() & expected_part.keys()):
            if not _agree(ours[name], expected_part[name], allowed):
                now, then = rounded([ours[name], expected_part[name]])
                words.append(f"{part}: {name} is {now}, expected {then}")
    return words


def _agree(ours: Figure, expected: Figure, allowed: Tolerance) -> bool:
    numbers = [
        v for v in (ours, expected) if isinstance(v, int | float) and not isinstance(v, bool)
    ]
    if len(numbers) < 2:
        return ours == expected
    room = allowed.absolute + allowed.relative * abs(numbers[1])
    return abs(numbers[0] - numbers[1]) <= room


def exit_code(
    figures: Figures,
    expected: Figures,
    tolerances: Mapping[str, Tolerance],
    report: Callable[[str], None],
) -> int:
    """Tell which figures moved: 1 if any did."""
    changes = differences(figures, expected, tolerances)
    for sentence in changes:
        sys.stdout.write(f"  {sentence}\n")
    report(f"{len(changes)} of {sum(map(len, figures.values()))} figures are not what was recorded")
    return EXIT_WORSE if changes else EXIT_OK
