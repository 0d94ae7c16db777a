"""What a person may choose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Choices of a run."""

    quick: bool = False  #: Few samples, to see that everything works; the figures mean nothing
    out: Path = Path("outputs/bench")  #: Folder of the document and the figures

    def duration(self, seconds: float) -> float:
        """Simulated time of a closed loop, s."""
        return min(seconds, 2.0) if self.quick else seconds
