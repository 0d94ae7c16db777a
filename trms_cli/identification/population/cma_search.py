"""CMA-ES (pycma) as a search, restarted where it has converged.

N. Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772; restarts with a doubled
population after A. Auger & N. Hansen, "A restart CMA evolution strategy with increasing population
size", CEC 2005.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

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


class CmaSearch:
    """See :class:`trms_cli.identification.cma_es.CmaEs` for the arguments.

    Parameters
    ----------
    start : (n,) array
        Centre of the first generation, in the unit box.
    """

    def __init__(
        self,
        start: FloatArray,
        seed: int,
        *,
        initial_step: float,
        individuals: int | None,
        restarts: int,
        tolerance: float,
    ) -> None:
        self._generator = np.random.default_rng(seed)
        self._start, self._step = start, initial_step
        self._individuals, self._left, self._tolerance = individuals, restarts, tolerance
        self.ended = ""
        self._strategy = self._new(start)

    def ask(self) -> FloatArray:
        """The next generation."""
        points: FloatArray = np.clip(np.array(self._strategy.ask(), dtype=float), 0.0, 1.0)
        return points

    def tell(self, points: FloatArray, costs: FloatArray) -> None:
        """Its costs; begins anew elsewhere when the strategy has converged and may."""
        finite = np.where(np.isfinite(costs), costs, _FAILED)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._strategy.tell(list(points), finite.tolist())
            reasons = self._strategy.stop()
        if not reasons:
            return
        if self._left > 0:
            self._left -= 1
            self._individuals = 2 * self._strategy.popsize
            self._strategy = self._new(self._generator.uniform(0.1, 0.9, len(self._start)))
            return
        reason = next(iter(reasons))
        self.ended = f"converged: {_WORDS.get(reason, reason)}"

    def _new(self, start: FloatArray) -> Any:
        import cma

        options: dict[str, Any] = {
            "bounds": [0.0, 1.0],
            "randn": lambda *shape: self._generator.standard_normal(shape),
            "verbose": -9,
            "tolfun": self._tolerance,
            "tolfunhist": self._tolerance,
            "seed": np.nan,  # its own generator is not used
        }
        if self._individuals is not None:
            options["popsize"] = self._individuals
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return cma.CMAEvolutionStrategy(np.clip(start, 0.01, 0.99), self._step, options)
