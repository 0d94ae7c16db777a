"""Branches of solutions followed step by step.

One loop, :func:`follow`, for all branches: of operating points over a command, of equilibria along
their arc, of periodic orbits. What differs is the attempt at the next place: prediction, correction
and the judgement whether it lies on the same branch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

Place = TypeVar("Place")


def follow(
    place: Place,
    attempt: Callable[[Place, float], tuple[Place | None, float]],
    step: float,
    shortest: float,
) -> Iterator[Place]:
    """The places of a branch after one, until steps get shorter than the shortest.

    Parameters
    ----------
    place : Place
    attempt : callable
        (place, step) → the next place, or None where the step was too long; and the length of the
        step after it.
    step, shortest : float
        The first step, and the shortest one that is tried.
    """
    while step >= shortest:
        following, step = attempt(place, step)
        if following is not None:
            place = following
            yield place
