"""CMA-ES: an evolution strategy that learns how the parameters hang together.

N. Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, ClassVar

from msgspec import Meta

from trms_cli.identification.method import FitResult, Progress
from trms_cli.identification.population.cma_search import CmaSearch
from trms_cli.identification.population.fit import Box, search_fit
from trms_cli.identification.problem import FitProblem


@dataclass(frozen=True, kw_only=True)
class CmaEs:
    """Covariance matrix adaptation evolution strategy within bounds."""

    evaluations: Annotated[int, Meta(ge=1)] = 5000  #: Budget, simulations of all recordings
    #: Of a generation; None: 4 + 3 ln n for n parameters
    individuals: Annotated[int, Meta(ge=4)] | None = None
    #: Half the width of the search box in prior standard deviations
    spread: Annotated[float, Meta(gt=0)] = 3.0
    #: Standard deviation of the first generation as a share of the box; ⅙ is one prior standard
    #: deviation in a box of ±3
    initial_step: Annotated[float, Meta(gt=0, le=1)] = 1 / 6
    #: After convergence, from a random point with twice the individuals
    restarts: Annotated[int, Meta(ge=0)] = 0
    #: Converged when the costs of the last generations differ by less
    tolerance: Annotated[float, Meta(gt=0)] = 1e-3

    fits_parameters: ClassVar[bool] = True

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Search; see :class:`trms_cli.identification.method.Method`."""
        settings = asdict(self)
        del settings["evaluations"]  # more of them is the same search
        return search_fit(
            "cma_es",
            problem,
            progress,
            lambda box, seed: self._search(box, problem, seed),
            box=Box(problem, self.spread),
            evaluations=self.evaluations,
            settings=settings,
            unit="generation",
        )

    def _search(self, box: Box, problem: FitProblem, seed: int) -> CmaSearch:
        return CmaSearch(
            box.point(problem.starts),
            seed,
            initial_step=self.initial_step,
            individuals=self.individuals,
            restarts=self.restarts,
            tolerance=self.tolerance,
        )
