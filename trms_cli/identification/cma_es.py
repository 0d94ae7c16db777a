"""CMA-ES: an evolution strategy that learns how the parameters hang together.

The search is pycma's, restarted where it has converged. N. Hansen, "The CMA evolution strategy: a
tutorial", arXiv:1604.00772; restarts with a doubled population after A. Auger & N. Hansen, "A
restart CMA evolution strategy with increasing population size", CEC 2005.
"""

import warnings
from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.population import Box, search_fit
from trms_cli.identification.problem import FitProblem, FitResult, Progress

#: pycma takes no infinite costs; this is worse than any simulation that did not fail.
_FAILED = 1e30
#: pycma's words for why it stopped, for a person.
_WORDS = {
    "tolfun": "the costs no longer differ",
    "tolfunhist": "the best costs no longer differ",
    "tolfunrel": "the costs no longer differ",
    "tolx": "the points no longer differ",
    "tolflatfitness": "the cost does not depend on the parameters",
    "tolstagnation": "the cost no longer falls",
    "tolconditioncov": "the parameters cannot be told apart",
    "conditioncov": "the parameters cannot be told apart",
    "noeffectaxis": "the step has become too small",
    "noeffectcoord": "the step has become too small",
}


@dataclass(frozen=True, kw_only=True)
class CmaEs:
    """Covariance matrix adaptation evolution strategy within bounds."""

    evaluations: Annotated[int, Meta(ge=1)] = 5000  #: Budget, simulations of all recordings
    individuals: Annotated[int, Meta(ge=4)] | None = None  #: Of a generation; None: 4 + 3 ln n
    spread: Annotated[float, Meta(gt=0)] = 3.0  #: Half the width of the box in prior sd
    #: Standard deviation of the first generation as a share of the box; ⅙ is one prior standard
    #: deviation in a box of ±3
    initial_step: Annotated[float, Meta(gt=0, le=1)] = 1 / 6
    restarts: Annotated[int, Meta(ge=0)] = 0  #: Each from a random point with twice the individuals
    tolerance: Annotated[float, Meta(gt=0)] = 1e-3  #: Spread of the last costs at convergence

    fits_parameters: ClassVar[bool] = True

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Search; see :class:`trms_cli.identification.problem.Method`."""
        box = Box(problem, self.spread)
        search = CmaSearch(box.point(problem.starts), problem.seed, self)
        settings = asdict(self)
        budget = settings.pop("evaluations")  # more of them is the same search
        return search_fit("cma_es", settings, problem, progress, search, box, budget)


class CmaSearch:
    """The search from the centre of its first generation, (n,) in the unit box."""

    def __init__(self, start: FloatArray, seed: int, settings: CmaEs) -> None:
        self._generator = np.random.default_rng(seed)
        self._settings, self._individuals = settings, settings.individuals
        self._remaining_restarts = settings.restarts
        self.stop_reason = ""
        self._strategy = self._new(start)

    def ask(self) -> FloatArray:
        """The next generation."""
        return np.asarray(np.clip(np.array(self._strategy.ask(), dtype=float), 0.0, 1.0))

    def tell(self, points: FloatArray, costs: FloatArray) -> None:
        """Its costs; begins anew elsewhere when the strategy has converged and may."""
        finite = np.where(np.isfinite(costs), costs, _FAILED)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._strategy.tell(list(points), finite.tolist())
            reasons = self._strategy.stop()
        if not reasons:
            return
        if self._remaining_restarts > 0:
            self._remaining_restarts -= 1
            self._individuals = 2 * self._strategy.popsize
            self._strategy = self._new(self._generator.uniform(0.1, 0.9, len(points[0])))
            return
        reason = next(iter(reasons))
        self.stop_reason = f"converged: {_WORDS.get(reason, reason)}"

    def _new(self, start: FloatArray) -> Any:
        import cma

        options: dict[str, Any] = {
            "bounds": [0.0, 1.0],
            "randn": lambda *shape: self._generator.standard_normal(shape),
            "verbose": -9,
            "tolfun": self._settings.tolerance,
            "tolfunhist": self._settings.tolerance,
            "seed": np.nan,  # its own generator is not used
        }
        if self._individuals is not None:
            options["popsize"] = self._individuals
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            step = self._settings.initial_step
            return cma.CMAEvolutionStrategy(np.clip(start, 0.01, 0.99), step, options)
