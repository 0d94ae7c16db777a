"""The loop of a population method: ask for points, simulate them, tell their costs.

Points lie in the unit box; what they mean is the evaluation's business.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from time import perf_counter
from typing import Protocol

import numpy as np
import numpy.typing as npt

from trms_cli.identification.population.journal import Journal

FloatArray = npt.NDArray[np.float64]


class Search(Protocol):
    """An optimiser that is asked and told. A pure function of its seed and of the costs."""

    def ask(self) -> FloatArray:
        """The points of the next generation, shape (individuals, n), in the unit box."""
        ...

    def tell(self, points: FloatArray, costs: FloatArray) -> None:
        """Their costs, shape (individuals,); infinite where a simulation failed."""
        ...

    @property
    def ended(self) -> str:
        """Why the search would not go on by itself; empty while it does."""
        ...


@dataclass
class Evolved:
    """What a search has found."""

    best: FloatArray  #: (n,) array; the point of least cost so far
    cost: float = np.inf  #: Its cost; infinite if every simulation failed
    #: Least cost so far and median of the generation, after each
    costs: list[tuple[float, float]] = field(default_factory=list)
    evaluations: int = 0  #: Simulations of a point, those of a journal included
    seconds: float = 0.0  #: Of computing, those of a journal included
    ended: str = ""  #: Why it ended; empty when all generations were done
    stopped: bool = False  #: Whether the watch asked to stop


#: Called after each generation with what has been found; False asks to stop.
Watch = Callable[[Evolved], bool]


def evolve(
    search: Search,
    evaluate: Callable[[FloatArray], FloatArray],
    *,
    evaluations: int,
    dimension: int,
    journal: Journal | None = None,
    watch: Watch | None = None,
) -> Evolved:
    """Run a search to its end.

    Parameters
    ----------
    search : Search
    evaluate : callable
        Points (m, n) to costs (m,).
    evaluations : int
        Budget: no generation is begun once as many points were simulated.
    dimension : int
        n.
    journal : Journal or None
        Generations that stand there are not simulated again; the others are added.
    watch : callable or None
    """
    journal = journal or Journal()
    found = Evolved(np.full(dimension, 0.5))
    while found.evaluations < evaluations and not (found.ended or found.stopped):
        begin = perf_counter()
        points = search.ask()
        known = journal.recorded(len(found.costs), points)
        if known is None:
            costs = np.asarray(evaluate(points), dtype=float)
            costs = np.where(np.isfinite(costs), costs, np.inf)
        else:
            costs = known.told()
        search.tell(points, costs)
        _note(found, points, costs)
        if known is None:
            found.seconds += perf_counter() - begin
            journal.keep(points, costs, found.seconds)
        else:
            found.seconds = known.seconds
        found.ended = search.ended
        if watch is not None and known is None:
            found.stopped = not watch(found)
    return found


def _note(found: Evolved, points: FloatArray, costs: FloatArray) -> None:
    first = int(np.argmin(costs))
    if costs[first] < found.cost:
        found.best, found.cost = points[first].copy(), float(costs[first])
    found.costs.append((found.cost, float(np.median(costs))))
    found.evaluations += len(costs)


def on_threads(
    cost: Callable[[FloatArray], float], jobs: int
) -> Callable[[FloatArray], FloatArray]:
    """An evaluation of points one by one, several at once.

    The simulation is compiled code, which lets other threads run. Each point is one thread's
    alone, so that its cost does not depend on how many there are.
    """

    def evaluate(points: FloatArray) -> FloatArray:
        if jobs <= 1:
            return np.array([cost(point) for point in points])
        # Two threads as often as not wait for one another; points in turn keep both busy.
        with ThreadPoolExecutor(jobs) as pool:
            try:
                return np.array(list(pool.map(cost, points)))
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise

    return evaluate
