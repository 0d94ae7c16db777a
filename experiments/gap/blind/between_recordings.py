"""How a model's errors differ from the sealed part of one recording to another of the same rig.

It is what the interval of a shrink is made of (:mod:`trms_cli.gap.shrinkage`): where it says that
errors differ by so much, a set with second recordings shows whether they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.judgement import JudgedCase
from trms_cli.models.beam_rig import ROTORS

FloatArray = npt.NDArray[np.float64]
_SPEEDS = {rotor.speed for rotor in ROTORS.values()}

#: Of the normal distribution: a standard deviation is that many median absolute deviations.
_NORMAL = 1.4826
#: Factors by which the two models' errors differ on the sealed part, and between.
_BANDS = (1.0, 1.02, 1.1, 1.35, 2.2, 4.5, np.inf)


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Of channels together, deviations of the logarithm of a fresh error over a sealed one.

    Deviations are robust, from the median absolute deviation.
    """

    channels: str  #: ``angles`` or ``speeds``
    low: float  #: Factor by which both models' sealed errors differ at least
    high: float | None  #: And at most; None: without a bound
    refit: float  #: Deviation of the refitted model's
    corrected: float  #: Deviation of the corrected model's
    apart: float  #: Deviation of their difference
    correlation: float | None  #: Of the two; None with fewer than three
    count: int  #: Channels of rigs


def between_recordings(judged_cases: Sequence[JudgedCase]) -> list[Spread]:
    """Of the rigs whose diagnosis names an effect, all together first and then by band."""
    spreads: list[Spread] = []
    for name, of_speeds in (("angles", False), ("speeds", True)):
        rows = np.array(
            [
                (*j.answer.sealed[channel], *fresh)
                for j in judged_cases
                if j.fresh is not None and j.answer.named_effects
                for channel, fresh in j.fresh.errors.items()
                if (channel in _SPEEDS) is of_speeds and channel in j.answer.sealed
            ]
        ).reshape(-1, 4)
        rows = rows[np.all(rows > 0, axis=1)]
        logs = np.log(rows)
        differ = np.abs(logs[:, 1] - logs[:, 0])
        whole = [(_BANDS[0], _BANDS[-1])]
        for low, high in whole + list(pairwise(_BANDS)):
            inside = (differ >= np.log(low)) & (differ < np.log(high))
            if inside.any():
                spreads.append(_spread(logs[inside], name, low, high))
    return spreads


def _spread(logs: FloatArray, channels: str, low: float, high: float) -> Spread:
    refit, corrected = logs[:, 2] - logs[:, 0], logs[:, 3] - logs[:, 1]
    together: float | None = None
    if len(logs) > 2 and refit.std() > 0 and corrected.std() > 0:
        together = float(np.corrcoef(refit, corrected)[0, 1])
    return Spread(
        channels=channels,
        low=float(low),
        high=float(high) if np.isfinite(high) else None,
        refit=_deviation(refit),
        corrected=_deviation(corrected),
        apart=_deviation(corrected - refit),
        correlation=together,
        count=len(logs),
    )


def _deviation(values: FloatArray) -> float:
    return float(_NORMAL * np.median(np.abs(values - np.median(values))))
