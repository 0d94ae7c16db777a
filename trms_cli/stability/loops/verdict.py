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

Kind = Literal[
    "settles", "dies out", "still creeping", "rests beside", "chatters", "swings", "is lost"
]
#: Crossings of its mean in the last two thirds that a swing has at the least: a start from where
#: friction held an axis has fewer.
_CROSSINGS = 4
#: Of one third to the next: a swing that keeps more than this part does not die out, and an error
#: that does is not on its way back; it may come to rest anywhere.
_SHRINKS, _RETURNS = 0.8, 0.5
#: Of one sixth of the run to the next: a mean error that keeps more does not creep on.
_STILL = 0.98
#: Share of half its range from which a command is at its limit.
_LIMIT = 1 - 1e-6


@dataclass(frozen=True)
class Verdict:
    """How a run ended."""

    #: ``settles``: within the bounds; ``dies out``: not yet, but getting there; ``still creeping``:
    #: beyond the bounds, but closer and closer, too slowly for the run to show where to; ``rests
    #: beside`` the point; ``chatters``: commands swing on, too fast to be seen in the angles;
    #: ``swings`` on; ``is lost``: it went too far from the point
    kind: Kind
    rest: FloatArray  #: (n_r,) array; mean error in the last third, rad
    swing: FloatArray  #: (n_r,) array; half of the range in the last third, rad
    axis: int  #: The angle that is worst

    @property
    def calm(self) -> bool:
        """Whether no swing goes on, wherever the loop rests."""
        return self.kind not in ("chatters", "swings", "is lost")

    @property
    def back(self) -> bool:
        """Whether the loop came back to the point, or is coming."""
        return self.kind in ("settles", "dies out")


@dataclass(frozen=True)
class Bounds:
    """What is told apart."""

    rest: float  #: rad that a loop may rest beside the point
    swing: float  #: rad by which it may swing
    chatter: float  #: Share of half the range of a command by which that may swing

    def closer(self, factor: float) -> Bounds:
        """Those for a loop that begins that much closer to its point."""
        return Bounds(self.rest / factor, self.swing / factor, self.chatter / factor)

    def verdict(self, errors: FloatArray, commands: FloatArray, ended: bool) -> Verdict:
        """The verdict on a run.

        Parameters
        ----------
        errors : (n, n_r) array
            Of the angles, rad.
        commands : (n, n_u) array
            As shares of half their range.
        ended : bool
            Whether the run had to end early.
        """
        third = max(1, len(errors) // 3)
        before, last = errors[-2 * third : -third], errors[-third:]
        rest, swing = last.mean(axis=0), np.ptp(last, axis=0) / 2
        if ended or not len(before):
            return Verdict("is lost", rest, swing, int(np.argmax(np.abs(errors[-1]))))
        rest_before = before.mean(axis=0)
        worst = int(np.argmax(np.maximum(np.abs(rest), swing)))
        swings = _swings_on(errors[-2 * third :], self.swing)
        if swings.any():
            return Verdict("swings", rest, swing, int(np.argmax(np.where(swings, swing, -1.0))))
        if _swings_on(commands[-2 * third :], self.chatter).any():
            return Verdict("chatters", rest, swing, worst)
        away = np.abs(rest)
        beside = (away > self.rest) & (away > _RETURNS * np.abs(rest_before))
        if beside.any():
            # with a command at its limit for good, nothing pushes on towards the point
            spent = bool(np.all(np.abs(commands[-third:]) >= _LIMIT, axis=0).any())
            resting = beside & (spent | ~_creeps(errors[-2 * third :]))
            kind: Kind = "rests beside" if resting.any() else "still creeping"
            shown = resting if resting.any() else beside
            return Verdict(kind, rest, swing, int(np.argmax(np.where(shown, away, -1.0))))
        settled = bool(np.all((away <= self.rest) & (swing <= self.swing)))
        return Verdict("settles" if settled else "dies out", rest, swing, worst)


def _creeps(errors: FloatArray) -> npt.NDArray[np.bool_]:
    """Which of (n, m) mean errors shrink from each quarter to the next, (m,)."""
    means = np.array([np.abs(part.mean(axis=0)) for part in np.array_split(errors, 4)])
    return np.asarray(np.all(means[1:] < _STILL * means[:-1], axis=0))


def _swings_on(values: FloatArray, bound: float) -> npt.NDArray[np.bool_]:
    """Which of (n, m) signals swing beyond a bound without getting calmer, (m,)."""
    half = len(values) // 2
    before, last = (np.ptp(part, axis=0) / 2 for part in (values[:half], values[half:]))
    above = values > values.mean(axis=0)
    crossed = (above[1:] != above[:-1]).sum(axis=0)
    return np.asarray((last > bound) & (last > _SHRINKS * before) & (crossed >= _CROSSINGS))
