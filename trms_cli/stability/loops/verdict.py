"""What a run of a loop came to, from the last two thirds of it.

Each third's mean error and swing (half of the range) of each angle tell whether the loop has
settled, is still on its way, rests beside the point, or swings on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

Kind = Literal["settles", "dies out", "rests beside", "swings", "is lost"]
#: Of one third to the next: an error or a swing that keeps more than this part does not die out.
_SHRINKS = 0.8


@dataclass(frozen=True)
class Verdict:
    """How a run ended.

    Attributes
    ----------
    kind : str
        ``settles``: within the bounds; ``dies out``: not yet, but getting there; ``rests beside``
        the point; ``swings`` on; ``is lost``: it went too far from the point.
    rest : (n_r,) array
        Mean error in the last third, rad.
    swing : (n_r,) array
        Half of the range in the last third, rad.
    axis : int
        The angle that is worst.
    """

    kind: Kind
    rest: FloatArray
    swing: FloatArray
    axis: int

    @property
    def calm(self) -> bool:
        """Whether no swing goes on, wherever the loop rests."""
        return self.kind not in ("swings", "is lost")

    @property
    def back(self) -> bool:
        """Whether the loop came back to the point, or is coming."""
        return self.kind in ("settles", "dies out")


@dataclass(frozen=True)
class Bounds:
    """What is told apart.

    Attributes
    ----------
    rest : float
        rad that a loop may rest beside the point.
    swing : float
        rad by which it may swing.
    """

    rest: float
    swing: float

    def verdict(self, errors: FloatArray, ended: bool) -> Verdict:
        """On angles' errors (n, n_r), rad, of a run that had to end early or did not."""
        third = max(1, len(errors) // 3)
        before, last = errors[-2 * third : -third], errors[-third:]
        rest, swing = last.mean(axis=0), np.ptp(last, axis=0) / 2
        if ended or not len(before):
            return Verdict("is lost", rest, swing, int(np.argmax(np.abs(errors[-1]))))
        rest_before, swing_before = before.mean(axis=0), np.ptp(before, axis=0) / 2
        swings = (swing > self.swing) & (swing > _SHRINKS * swing_before)
        if swings.any():
            return Verdict("swings", rest, swing, int(np.argmax(np.where(swings, swing, -1.0))))
        away = np.abs(rest)
        beside = (away > self.rest) & (away > _SHRINKS * np.abs(rest_before))
        if beside.any():
            return Verdict(
                "rests beside", rest, swing, int(np.argmax(np.where(beside, away, -1.0)))
            )
        settled = bool(np.all((away <= self.rest) & (swing <= self.swing)))
        worst = int(np.argmax(np.maximum(away, swing)))
        return Verdict("settles" if settled else "dies out", rest, swing, worst)
