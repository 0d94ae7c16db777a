"""A genetic algorithm, as chapter 4 of the thesis fits the white-box model's parameters.

Individuals are parameter vectors within a box around the priors; their fitness is the cost of a
simulation of all windows. Of the thesis's own operators and sizes nothing is public: these are
usual ones for real numbers, all configurable.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.identification.method import FitResult, Progress
from trms_cli.identification.population.fit import Box, search_fit
from trms_cli.identification.population.genetic_search import (
    Crossover,
    GeneticSearch,
    Mutation,
    Selection,
)
from trms_cli.identification.problem import FitProblem

Probability = Annotated[float, Meta(ge=0, le=1)]


@dataclass(frozen=True, kw_only=True)
class Genetic:
    """Real-coded genetic algorithm with elitist survival."""

    individuals: Annotated[int, Meta(ge=4)] = 50  #: Of a generation
    generations: Annotated[int, Meta(ge=1)] = 100
    #: Half the width of the search box in prior standard deviations
    spread: Annotated[float, Meta(gt=0)] = 3.0
    #: How the first generation is drawn: from the priors, or evenly over the box. The start is
    #: always one of it.
    first: Literal["priors", "even"] = "priors"
    selection: Selection = "tournament"  #: Of parents
    crossover: Crossover = "simulated_binary"
    crossover_probability: Probability = 0.9  #: Of a pair of parents
    #: Of the simulated binary crossover: the larger, the closer children are to parents
    crossover_index: Annotated[float, Meta(ge=0)] = 10.0
    mutation: Mutation = "polynomial"
    #: Of each parameter of a child; None: one over the number of parameters
    mutation_probability: Probability | None = None
    #: Of the polynomial mutation: the larger, the smaller the change
    mutation_index: Annotated[float, Meta(ge=0)] = 20.0
    #: Of the Gaussian mutation, as a share of the box
    mutation_sd: Annotated[float, Meta(gt=0)] = 0.05

    fits_parameters: ClassVar[bool] = True

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Search; see :class:`trms_cli.identification.method.Method`."""
        settings = asdict(self)
        del settings["generations"]  # more of them is the same search
        return search_fit(
            "genetic",
            problem,
            progress,
            self._search,
            box=Box(problem, self.spread),
            evaluations=self.individuals * self.generations,
            settings=settings,
            unit="generation",
        )

    def _search(self, box: Box, seed: int) -> GeneticSearch:
        generator = np.random.default_rng([seed, 0])
        first = box.drawn(self.individuals, generator)
        if self.first == "even":
            first[1:] = generator.uniform(size=first[1:].shape)
        return GeneticSearch(
            first,
            seed,
            selection=self.selection,
            crossover=self.crossover,
            crossover_probability=self.crossover_probability,
            crossover_index=self.crossover_index,
            mutation=self.mutation,
            mutation_probability=self.mutation_probability,
            mutation_index=self.mutation_index,
            mutation_sd=self.mutation_sd,
        )
