"""The first size of an impairment that a loop does not stand: a coarse scan, then bisection.

Nothing says that a loop which fails at one size fails at all larger ones, so all sizes of the
scan are tried; the bisection then closes in on the first failure that the scan shows. A shorter
failure between two sizes of the scan is not seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from trms_cli.stability.closed_loop import LoopRun
from trms_cli.stability.loops.verdict import Verdict

#: Halvings at the most: enough from a size that fails at once down to a thousandth of it.
_HALVINGS = 10


@dataclass(frozen=True)
class Tried:
    """One size."""

    size: float
    run: LoopRun
    verdict: Verdict


@dataclass(frozen=True)
class Found:
    """What a search found."""

    tried: tuple[Tried, ...]  #: By size
    below: Tried  #: The largest size before the first failure
    above: Tried | None  #: The first failure; None: all sizes were stood
    again: tuple[float, ...]  #: Sizes of the scan beyond it that are stood again

    @property
    def limit(self) -> float | None:
        """Between the two, by their geometric mean (the arithmetic one where nothing is 0)."""
        if self.above is None:
            return None
        return _between(self.below.size, self.above.size)


def searched(
    sizes: Sequence[float],
    nothing: Tried,
    attempt: Callable[[float], Tried],
    precision: float,
    fails: Callable[[Tried], bool],
) -> Found:
    """The first failure.

    Parameters
    ----------
    sizes : sequence of float
        Of the scan, the smallest first.
    nothing : Tried
        The run with nothing wrong, which does not fail.
    attempt : callable
        Runs the loop at a size.
    precision : float
        Factor between the two sizes at which the bisection ends.
    fails : callable
        What counts as a failure.
    """
    scanned = [attempt(size) for size in sizes]
    tried = [nothing, *scanned]
    first = next((i for i, t in enumerate(tried) if fails(t)), None)
    if first is None:
        return Found(tuple(tried), tried[-1], None, ())
    below, above = tried[first - 1], tried[first]
    again = tuple(t.size for t in tried[first:] if not fails(t))
    for _ in range(_HALVINGS):
        if below.size > 0 and above.size <= precision * below.size:
            break
        middle = attempt(_between(below.size, above.size))
        tried.append(middle)
        if fails(middle):
            above = middle
        else:
            below = middle
    return Found(tuple(sorted(tried, key=lambda t: t.size)), below, above, again)


def _between(low: float, high: float) -> float:
    return math.sqrt(low * high) if low > 0 else high / 2
