"""Multilevel random signals: amplitudes are drawn too, which two levels cannot show."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.excitation.excitation import Plan, Shape, check_band, shape_of
from trms_cli.identification.excitation.prbs import FLAT
from trms_cli.references.multilevel import Multilevel

#: Of the lowest frequency's period, for which a level may hold: longer ones put most of the power
#: below the band.
_SHARE_OF_PERIOD = 0.1
#: Levels that a signal should have at least on average.
_LEAST_HOLDS = 20
#: Signals drawn, of which those that are least alike are taken: a few dozen levels of two draws
#: easily correlate by 0.3.
_DRAWS = 40


@dataclass(frozen=True, kw_only=True)
class MultilevelExcitation:
    """Random levels; the shortest holding time from the band's upper end."""

    levels: Annotated[int, Meta(ge=2)] | None = None  #: Equally distant ones; None: any value
    #: s; None: a tenth of a period of the band's lower end, if twenty levels fit the duration
    longest: Annotated[float, Meta(gt=0)] | None = None

    def shape(self, plan: Plan) -> Shape:
        """The signals; see :class:`Excitation`."""
        check_band(plan)
        shortest = FLAT / plan.highest
        longest = self.longest
        if longest is None:
            longest = min(_SHARE_OF_PERIOD / plan.lowest, 2 * plan.duration / _LEAST_HOLDS)
        longest = max(longest, shortest)
        candidates = [
            Multilevel(
                amplitude=1.0,
                levels=self.levels,
                shortest=shortest,
                longest=longest,
                seed=plan.seed * _DRAWS + i,
            ).sample(plan.time)
            for i in range(_DRAWS if plan.inputs > 1 else 1)
        ]
        selection = _least_alike(candidates, plan.inputs)
        return shape_of(selection, shortest_s=shortest, longest_s=longest, levels=self.levels)


def _least_alike(candidates: list[FloatArray], count: int) -> list[FloatArray]:
    """The first signal, and of the others those with the least correlation to the ones before."""
    selection = candidates[:1]
    while len(selection) < count:
        rest = [d for d in candidates if not any(d is c for c in selection)]
        selection.append(
            min(rest, key=lambda d: max(abs(float(np.corrcoef(d, c)[0, 1])) for c in selection))
        )
    return selection
