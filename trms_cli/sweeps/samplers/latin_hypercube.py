"""A Latin hypercube: each parameter's distribution is cut into n equal shares, each drawn once.

The mean of n such runs scatters less than that of n independent draws, the more so the more
nearly a figure is a sum of effects of single parameters (McKay, Beckman and Conover 1979,
Technometrics 21(2)). The rank correlations that chance leaves between the columns are taken out
by the reordering of Iman and Conover (1982, Communications in Statistics B 11(3)), which keeps
every column's values and thus its strata.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.sweeps.samplers.drawing import DrawingSampler, FloatArray


@dataclass(frozen=True, kw_only=True)
class LatinHypercube(DrawingSampler):
    """Stratified draws."""

    NAME: ClassVar[str] = "latin_hypercube"
    #: Draws, and shares into which each distribution is cut; each is run with every combination of
    #: the choices
    samples: Annotated[int, Meta(ge=1)] = 100
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the draws; the runs' own ``seed`` is another
    #: Take chance correlations between the columns out, where there are more samples than columns
    decorrelated: bool = True

    def shares(self, columns: int) -> FloatArray:
        """A point in each of the shares of every column."""
        return hypercube(self.samples, columns, self.seed, self.decorrelated)


def hypercube(
    samples: int, columns: int, seed: int | Sequence[int], decorrelated: bool = True
) -> FloatArray:
    """A Latin hypercube in the unit cube, (samples, columns).

    ``decorrelated``: see :class:`LatinHypercube`.
    """
    from scipy.stats import qmc

    sampler = qmc.LatinHypercube(columns, seed=np.random.default_rng(seed))
    points = np.asarray(sampler.random(samples))
    if not decorrelated or columns < 2 or samples <= columns + 1:
        return points
    while True:
        try:
            return _decorrelated(points)
        except np.linalg.LinAlgError:  # few samples, and the order of one column is another's
            points = np.asarray(sampler.random(samples))


def _decorrelated(points: FloatArray) -> FloatArray:
    """The same values in each column, in the order that normal scores without correlation have."""
    from scipy.linalg import cholesky, solve_triangular
    from scipy.stats import norm, rankdata

    ranks = np.column_stack([rankdata(column, method="ordinal") for column in points.T])
    scores = norm.ppf(ranks / (len(points) + 1))
    root = cholesky(np.corrcoef(scores.T), lower=True)
    uncorrelated = solve_triangular(root, scores.T, lower=True).T
    order = np.column_stack([rankdata(column, method="ordinal") for column in uncorrelated.T])
    return np.take_along_axis(np.sort(points, axis=0), order.astype(int) - 1, axis=0)
