"""A real-coded genetic algorithm (pymoo) as a search.

K. Deb & R. B. Agrawal, "Simulated binary crossover for continuous search space", Complex Systems 9
(1995); the polynomial mutation is theirs too. Parents and children compete, and the best survive.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

Crossover = Literal["simulated_binary", "uniform", "two_point"]
Mutation = Literal["polynomial", "gaussian"]
Selection = Literal["tournament", "random"]

#: pymoo sorts costs; a failed simulation is worse than any that did not.
_FAILED = 1e30


class GeneticSearch:
    """See :class:`trms_cli.identification.genetic.Genetic` for the arguments.

    Parameters
    ----------
    first : (individuals, n) array
        The first generation, in the unit box.
    """

    ended = ""

    def __init__(
        self,
        first: FloatArray,
        seed: int,
        *,
        selection: Selection,
        crossover: Crossover,
        crossover_probability: float,
        crossover_index: float,
        mutation: Mutation,
        mutation_probability: float | None,
        mutation_index: float,
        mutation_sd: float,
    ) -> None:
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
        each = 1.0 / n if mutation_probability is None else mutation_probability
        cross: dict[str, Any] = {
            "simulated_binary": lambda: SBX(prob=crossover_probability, eta=crossover_index),
            "uniform": lambda: UX(prob=crossover_probability),
            "two_point": lambda: TwoPointCrossover(prob=crossover_probability),
        }
        mutate: dict[str, Any] = {
            "polynomial": lambda: PM(prob=1.0, prob_var=each, eta=mutation_index),
            "gaussian": lambda: GaussianMutation(prob=1.0, prob_var=each, sigma=mutation_sd),
        }
        select: dict[str, Any] = {
            "tournament": lambda: TournamentSelection(func_comp=comp_by_cv_and_fitness),
            "random": RandomSelection,
        }
        self._algorithm = GA(
            pop_size=individuals,
            sampling=first,
            selection=select[selection](),
            crossover=cross[crossover](),
            mutation=mutate[mutation](),
            seed=seed,
        )
        self._algorithm.setup(Problem(n_var=n, n_obj=1, xl=np.zeros(n), xu=np.ones(n)), seed=seed)
        # When to stop is decided outside.
        self._algorithm.termination = get_termination("n_gen", 10**9)
        self._asked: Any = None

    def ask(self) -> FloatArray:
        """The next generation."""
        self._asked = self._algorithm.ask()
        points: FloatArray = np.array(self._asked.get("X"), dtype=float)
        return points

    def tell(self, points: FloatArray, costs: FloatArray) -> None:
        """Its costs."""
        self._asked.set("F", np.where(np.isfinite(costs), costs, _FAILED)[:, None])
        for individual in self._asked:
            individual.evaluated.add("F")
        self._algorithm.tell(infills=self._asked)
