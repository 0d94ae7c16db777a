"""A population method: the cost of parameters alone, the search for less of it, and its journal.

A search without slopes in the parameters sees one number a point: the negative logarithm of
likelihood and prior in nats, up to a constant, with everything else eliminated:

- the starts of the windows, by one Gauss–Newton step from their estimates with the exact slopes,
  then a second simulation from there;
- the noise of each output, which is as large as the residuals but no smaller than declared,

        n (log s + ½ z̄²/s²),   s = max(1, z̄),   z̄² the mean square of residuals over declared noise

  which is ½ Σ z² where the model follows to within the noise. Residuals beyond the robust
  threshold count as if they lay on it.

Residuals are counted as if they were white.

A journal keeps what was tried, to go on from there. A search is a pure function of its seed and of
the costs that it was told. So the costs are all that has to be kept: a search that goes on from a
journal asks for the same points again, is told the costs that stand there without a simulation, and
is then where it was, bit for bit. The points' digests tell when it is not the same search: other
settings, another version of a library.

Points lie in the unit box; what they mean is :class:`Box`'s business.
"""

import hashlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import accumulate
from time import perf_counter
from typing import Any, Protocol

import msgspec
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.greybox.windows import Residuals, Windows
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    HistoryPoint,
    Progress,
)


class SimulationCost:
    """The cost as a function of the free parameters; several threads may call it at once."""

    def __init__(self, problem: FitProblem) -> None:
        self._problem = problem
        self.windows = Windows(problem, with_parameters=False)
        # Threads share the points among themselves, each simulates all windows of one.
        self.windows.rollout.jobs = 1
        self.starts = self.windows.starts(problem.all_values(problem.starts))
        self._count = self.windows.measured.sum(axis=(0, 1)) * self.windows.share

    @property
    def samples(self) -> int:
        """Simulated in one evaluation: every window twice, once with slopes in its start."""
        return 2 * int(self.windows.count.sum())

    def __call__(self, theta: FloatArray) -> float:
        """Cost in nats at parameters (n_f,); infinite where the simulation is not finite."""
        p = self._problem.all_values(theta)
        with np.errstate(all="ignore"):
            result = self.windows.residuals(p, self.starts, slopes=True)
            if not result.finite:
                return np.inf
            step = self._start_step(result)
            result = self.windows.residuals(p, self.starts + step * self.windows.spread)
            if not result.finite:
                return np.inf
            cost = self._of_residuals(result.r) + 0.5 * float(np.sum(step**2))
            gap = theta - self._problem.prior_means
            cost += 0.5 * float(np.sum(self._problem.prior_precisions * gap**2))
        return cost if np.isfinite(cost) else np.inf

    def _of_residuals(self, r: FloatArray) -> float:
        square = self._mean_square(r)
        s2 = np.maximum(1.0, square)
        if self._problem.discrepancy == "none":
            s2 = np.ones_like(square)
        return float(np.sum(self._count * (0.5 * np.log(s2) + 0.5 * square / s2)))

    def _mean_square(self, r: FloatArray) -> FloatArray:
        """Mean square of each output's residuals over their declared deviation, (n_y,)."""
        z2 = (r / self.windows.declared[:, None]) ** 2
        count = np.maximum(self.windows.measured.sum(axis=(0, 1)), 1)
        square: FloatArray = z2.sum(axis=(0, 1)) / count
        if self._problem.robust is not None:
            far: FloatArray = self._problem.robust**2 * np.maximum(square, 1.0)
            square[:] = np.minimum(z2, far).sum(axis=(0, 1)) / count
        return square

    def _start_step(self, residuals: Residuals) -> FloatArray:
        """Change of the starts in units of their spread, (m, n_x)."""
        assert residuals.j is not None
        s = np.sqrt(np.maximum(1.0, self._mean_square(residuals.r)))
        root = self.windows.measured / (self.windows.declared * s)[:, None]
        m, n = len(self.windows), self.windows.n_x
        slopes = (residuals.j[..., :n] * self.windows.spread * root[..., None]).reshape(m, -1, n)
        a = np.ascontiguousarray(slopes.transpose(0, 2, 1))
        b = (residuals.r * root).reshape(m, -1)
        # Not by BLAS, which would start threads of its own beside those of the search.
        normal = np.einsum("mik,mjk->mij", a, a) + np.eye(n)
        right = np.einsum("mik,mk->mi", a, b)[..., None]
        return np.asarray(-np.linalg.solve(normal, right)[..., 0], dtype=np.float64)


_WHERE = "resume"


class Generation(msgspec.Struct, frozen=True):
    """One generation."""

    points: str  #: Digest of the points that were asked for
    costs: list[float | None]  #: Of each point; None where the simulation failed
    seconds: float  #: Of computing up to the end of this generation


class _State(msgspec.Struct):
    about: dict[str, Any]
    generations: list[Generation]


class Journal:
    """The generations of a search.

    ``about``: all that the points and their costs depend on, as plain data. ``saved``: the
    :attr:`state` of an earlier search that is to go on; None begins. Raises ConfigurationError if
    the earlier search was another one.
    """

    def __init__(
        self, about: Mapping[str, Any] | None = None, saved: Mapping[str, Any] | None = None
    ) -> None:
        # As JSON reads it back: a tuple is a list there.
        self._about = msgspec.json.decode(msgspec.json.encode(dict(about or {})))
        self._entries: list[Generation] = []
        if saved is not None:
            self._entries = self._of_this_search(saved).generations

    @property
    def state(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        data = msgspec.to_builtins(_State(self._about, self._entries))
        assert isinstance(data, dict)
        return data

    @property
    def generations(self) -> tuple[Generation, ...]:
        """Those that stand here, in order."""
        return tuple(self._entries)

    def recorded(self, number: int, points: FloatArray) -> Generation | None:
        """The generation `number` (from 0 on) if it stands here.

        Raises ConfigurationError if other points were asked for then.
        """
        if number >= len(self._entries):
            return None
        entry = self._entries[number]
        if entry.points != digest(points) or len(entry.costs) != len(points):
            raise ConfigurationError(
                f"generation {number + 1} does not come out as it was then: another version of "
                "NumPy or of the optimiser draws other points",
                where=_WHERE,
                remedy="fit anew into another folder",
            )
        return entry

    def keep(self, points: FloatArray, costs: FloatArray, seconds: float) -> None:
        """Add a generation."""
        values = [float(cost) if np.isfinite(cost) else None for cost in costs]
        self._entries.append(Generation(digest(points), values, seconds))

    def _of_this_search(self, content: Mapping[str, Any]) -> _State:
        try:
            then = msgspec.convert(dict(content), _State)
        except msgspec.ValidationError as error:
            raise ConfigurationError(
                f"what was kept there is of another method or version: {error}",
                where=_WHERE,
                remedy="fit anew into another folder",
            ) from None
        for key in {**then.about, **self._about}:
            before, now = then.about.get(key), self._about.get(key)
            if before != now:
                raise ConfigurationError(
                    f"{key} was {before!r} and is {now!r} now, so what was tried then is no "
                    "beginning of this search",
                    where=_WHERE,
                    remedy="go on with the settings of then, or fit anew into another folder",
                )
        return then


def digest(points: FloatArray) -> str:
    """Of every bit of the points."""
    return hashlib.sha256(np.ascontiguousarray(points, dtype=float).tobytes()).hexdigest()[:16]


class PopulationSearch(Protocol):
    """An optimiser that is asked and told. A pure function of its seed and of the costs."""

    def ask(self) -> FloatArray:
        """The points of the next generation, shape (individuals, n), in the unit box."""

    def tell(self, points: FloatArray, costs: FloatArray) -> None:
        """Their costs, shape (individuals,); infinite where a simulation failed."""

    @property
    def stop_reason(self) -> str:
        """Why the search would not go on by itself; empty while it does."""


@dataclass
class SearchResult:
    """What a search has found."""

    best: FloatArray  #: (n,) array; the point of least cost so far
    cost: float = np.inf  #: Its cost; infinite if every simulation failed
    #: Least cost so far and median of the generation, after each
    costs: list[tuple[float, float]] = field(default_factory=list)
    evaluations: int = 0  #: Simulations of a point, those of a journal included
    seconds: float = 0.0  #: Of computing, those of a journal included
    stop_reason: str = ""  #: Why it ended; empty when all generations were done
    stopped: bool = False  #: Whether the watch asked to stop


#: Called after each generation with what has been found; False asks to stop.
Watch = Callable[[SearchResult], bool]


def evolve(
    search: PopulationSearch,
    evaluate: Callable[[FloatArray], FloatArray],
    *,
    evaluations: int,
    dimension: int,
    journal: Journal | None = None,
    watch: Watch | None = None,
) -> SearchResult:
    """Run a search in ``dimension`` n to its end.

    ``evaluate``: points (m, n) to costs (m,). ``evaluations``: budget; no generation is begun once
    as many points were simulated. ``journal``: generations that stand there are not simulated
    again; the others are added.
    """
    journal = journal or Journal()
    result = SearchResult(np.full(dimension, 0.5))
    while result.evaluations < evaluations and not (result.stop_reason or result.stopped):
        begin = perf_counter()
        points = search.ask()
        generation = journal.recorded(len(result.costs), points)
        if generation is None:
            costs = np.asarray(evaluate(points), dtype=float)
            costs = np.where(np.isfinite(costs), costs, np.inf)
        else:
            costs = np.array([np.inf if cost is None else cost for cost in generation.costs])
        search.tell(points, costs)
        first = int(np.argmin(costs))
        if costs[first] < result.cost:
            result.best, result.cost = points[first].copy(), float(costs[first])
        result.costs.append((result.cost, float(np.median(costs))))
        result.evaluations += len(costs)
        if generation is None:
            result.seconds += perf_counter() - begin
            journal.keep(points, costs, result.seconds)
        else:
            result.seconds = generation.seconds
        result.stop_reason = search.stop_reason
        if watch is not None and generation is None:
            result.stopped = not watch(result)
    return result


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


class Box:
    """The unit box, and what its points mean.

    ``spread``: half the width of the box in prior standard deviations; bounds cut it. Raises
    ConfigurationError if no parameter is free.
    """

    def __init__(self, problem: FitProblem, spread: float) -> None:
        if not problem.free:
            raise ConfigurationError(
                "no parameter is free", where="free", remedy="free=[priors], or name some"
            )
        ranges = np.array([parameter.search_range(spread) for parameter in problem.free])
        self.lower, self.upper = ranges[:, 0], ranges[:, 1]
        self._problem = problem

    @property
    def dimension(self) -> int:
        return len(self.lower)

    def values(self, point: FloatArray) -> FloatArray:
        """Parameters at points, (…, n) to (…, n)."""
        return np.asarray(self.lower + point * (self.upper - self.lower))

    def point(self, theta: FloatArray) -> FloatArray:
        """The point of parameters, (…, n), moved into the box."""
        return np.asarray(np.clip((theta - self.lower) / (self.upper - self.lower), 0.0, 1.0))

    def draw(self, number: int, generator: np.random.Generator) -> FloatArray:
        """Points drawn from the priors, evenly where there is none, shape (number, n).

        The first is the start.
        """
        free = self._problem.free
        normal = generator.standard_normal((number, self.dimension))
        even = generator.uniform(size=(number, self.dimension))
        points = np.empty((number, self.dimension))
        for i, parameter in enumerate(free):
            if parameter.prior_sd is None:
                points[:, i] = even[:, i]
                continue
            value = parameter.prior_mean + parameter.prior_sd * normal[:, i]
            point = (value - self.lower[i]) / (self.upper[i] - self.lower[i])
            # Beyond an edge a draw is made evenly instead: at the edge many would be alike.
            points[:, i] = np.where((point < 0) | (point > 1), even[:, i], point)
        points[0] = self.point(self._problem.starts)
        return points


def search_fit(
    method: str,
    settings: Mapping[str, Any],
    problem: FitProblem,
    progress: Progress,
    search: PopulationSearch,
    box: Box,
    evaluations: int,
) -> FitResult:
    """Fit by a search, resumed from what ``progress`` has kept.

    ``settings``: all that the search depends on besides problem and budget, as plain data.
    ``evaluations``: the budget, simulations of all recordings.
    """
    cost = SimulationCost(problem)
    evaluate = on_threads(lambda point: cost(box.values(point)), problem.jobs)
    journal = Journal(_about(method, problem, box, settings), progress.saved())

    def watch(result: SearchResult) -> bool:
        progress.save(journal.state)
        message = f"generation {len(result.costs)}, {result.evaluations} simulations"
        return progress.update(result.evaluations / evaluations, result.cost, message)

    result = evolve(
        search,
        evaluate,
        evaluations=evaluations,
        dimension=box.dimension,
        journal=journal,
        watch=watch,
    )
    values = box.values(result.best)
    state = journal.state["generations"]
    totals = list(accumulate(len(entry["costs"]) for entry in state[: len(result.costs)]))
    history = [
        HistoryPoint(number, entry["seconds"], best)
        for number, entry, (best, _) in zip(totals, state, result.costs, strict=False)
    ]
    return FitResult(
        method=method,
        outcome=_outcome(result),
        cost=result.cost,
        values=dict(zip(problem.names, values.tolist(), strict=True)),
        history=history,
        evaluations=result.evaluations,
        seconds=result.seconds,
        details={
            "ended": result.stop_reason
            or ("stopped" if result.stopped else "the budget was spent"),
            "generations": len(result.costs),
            "median_cost": [None if np.isinf(m) else m for _, m in result.costs],
        },
    )


def _outcome(result: SearchResult) -> FitOutcome:
    if not np.isfinite(result.cost):
        return FitOutcome.FAILED
    if result.stopped:
        return FitOutcome.INTERRUPTED
    return FitOutcome.CONVERGED if result.stop_reason else FitOutcome.BUDGET_SPENT


def _about(
    method: str, problem: FitProblem, box: Box, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """What a journal must agree on to be the beginning of this search."""
    return {
        "method": method,
        **{f"method.{key}": value for key, value in settings.items()},
        "seed": problem.seed,
        "free": list(problem.names),
        "search box": [box.lower.tolist(), box.upper.tolist()],
        "recordings": [[d.sha256, len(d), d.sample_time] for d in problem.datasets],
        "windows (length, stride)": [problem.window_length, problem.window_stride],
        "robust": problem.robust,
        "discrepancy": problem.discrepancy,
        "parameters": problem.model.parameters.values.tolist(),
    }
