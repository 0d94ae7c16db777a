"""What a person may choose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

_Case = TypeVar("_Case")


@dataclass(frozen=True)
class Options:
    """Choices of a run."""

    quick: bool = False  #: Few samples, to see that everything works; the figures mean nothing
    out: Path = Path("outputs/bench")  #: Folder of the document and the figures

    def duration(self, seconds: float) -> float:
        """Simulated time of a closed loop, s."""
        return min(seconds, 2.0) if self.quick else seconds

    def cases(self, all_of_them: Mapping[str, _Case]) -> dict[str, _Case]:
        """Cases by their names; of a quick run the first two."""
        return dict(islice(all_of_them.items(), 2 if self.quick else None))
