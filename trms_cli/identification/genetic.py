"""A genetic algorithm, as chapter 4 of the thesis fits the white-box model's parameters.

Individuals are parameter vectors within a box around the priors; their fitness is the cost of a
simulation of all windows. Of the thesis's own operators and sizes nothing is public: these are
usual ones for real numbers, all configurable.

The search is pymoo's. K. Deb & R. B. Agrawal, "Simulated binary crossover for continuous search
space", Complex Systems 9 (1995); the polynomial mutation is theirs too. Parents and children
compete, and the best survive.
"""

from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.population import Box, search_fit
from trms_cli.identification.problem import FitProblem, FitResult, Progress

#: pymoo sorts costs; a failed simulation is worse than any that did not.
_FAILED = 1e30


Probability = Annotated[float, Meta(ge=0, le=1)]


@dataclass(frozen=True, kw_only=True)
class Genetic:
    """Real-coded genetic algorithm with elitist survival."""

    individuals: Annotated[int, Meta(ge=4)] = 50  #: Of a generation
    generations: Annotated[int, Meta(ge=1)] = 100
    spread: Annotated[float, Meta(gt=0)] = 3.0  #: Half the width of the box in prior sd
    #: How the first generation is drawn: from the priors, or evenly over the box. The start is
    #: always one of it.
    first: Literal["priors", "even"] = "priors"
    selection: Literal["tournament", "random"] = "tournament"  #: Of parents
    crossover: Literal["simulated_binary", "uniform", "two_point"] = "simulated_binary"
    crossover_probability: Probability = 0.9  #: Of a pair of parents
    #: Of the simulated binary crossover: the larger, the closer children are to parents
    crossover_index: Annotated[float, Meta(ge=0)] = 10.0
    mutation: Literal["polynomial", "gaussian"] = "polynomial"
    #: Of each parameter of a child; None: one over the number of parameters
    mutation_probability: Probability | None = None
    #: Of the polynomial mutation: the larger, the smaller the change
    mutation_index: Annotated[float, Meta(ge=0)] = 20.0
    mutation_sd: Annotated[float, Meta(gt=0)] = 0.05  #: Of the Gaussian one, as a share of the box

    fits_parameters: ClassVar[bool] = True

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Search; see :class:`trms_cli.identification.problem.Method`."""
        box, generator = Box(problem, self.spread), np.random.default_rng([problem.seed, 0])
        first = box.draw(self.individuals, generator)
        if self.first == "even":
            first[1:] = generator.uniform(size=first[1:].shape)
        search = GeneticSearch(first, problem.seed, self)
        settings = asdict(self)
        budget = self.individuals * settings.pop("generations")  # more of them is the same search
        return search_fit("genetic", settings, problem, progress, search, box, budget)


class GeneticSearch:
    """The search from a first generation, (individuals, n) in the unit box."""

    stop_reason = ""

    def __init__(self, first: FloatArray, seed: int, settings: Genetic) -> None:
        from pymoo.algorithms.soo.nonconvex.ga import GA, comp_by_cv_and_fitness
        from pymoo.core.problem import Problem
        from pymoo.operators.crossover.pntx import TwoPointCrossover
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.crossover.ux import UX
        from pymoo.operators.mutation.gauss import GaussianMutation
        from pymoo.operators.mutation.pm import PM
        from pymoo.operators.selection.rnd import RandomSelection
        from pymoo.operators.selection.tournament import TournamentSelection
        from pymoo.termination import get_termination

        individuals, n = first.shape
        pair, each = settings.crossover_probability, settings.mutation_probability
        each = 1.0 / n if each is None else each
        cross: dict[str, Any] = {
            "simulated_binary": lambda: SBX(prob=pair, eta=settings.crossover_index),
            "uniform": lambda: UX(prob=pair),
            "two_point": lambda: TwoPointCrossover(prob=pair),
        }
        mutate: dict[str, Any] = {
            "polynomial": lambda: PM(prob=1.0, prob_var=each, eta=settings.mutation_index),
            "gaussian": lambda: GaussianMutation(
                prob=1.0, prob_var=each, sigma=settings.mutation_sd
            ),
        }
        select: dict[str, Any] = {
            "tournament": lambda: TournamentSelection(func_comp=comp_by_cv_and_fitness),
            "random": RandomSelection,
        }
        self._algorithm = GA(
            pop_size=individuals,
            sampling=first,
            selection=select[settings.selection](),
            crossover=cross[settings.crossover](),
            mutation=mutate[settings.mutation](),
            seed=seed,
        )
        self._algorithm.setup(Problem(n_var=n, n_obj=1, xl=np.zeros(n), xu=np.ones(n)), seed=seed)
        # When to stop is decided outside.
        self._algorithm.termination = get_termination("n_gen", 10**9)
        self._generation: Any = None

    def ask(self) -> FloatArray:
        """The next generation."""
        self._generation = self._algorithm.ask()
        return np.asarray(np.array(self._generation.get("X"), dtype=float))

    def tell(self, points: FloatArray, costs: FloatArray) -> None:
        """Its costs."""
        self._generation.set("F", np.where(np.isfinite(costs), costs, _FAILED)[:, None])
        for individual in self._generation:
            individual.evaluated.add("F")
        self._algorithm.tell(infills=self._generation)
