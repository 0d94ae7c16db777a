"""Independent draws from ranges and priors, crossed with the choices: plain Monte Carlo."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.sweeps.samplers.drawing import DrawingSampler, FloatArray


@dataclass(frozen=True, kw_only=True)
class Random(DrawingSampler):
    """Independent draws."""

    NAME: ClassVar[str] = "random"
    #: Draws; each is run with every combination of the choices. The first hundred of two hundred
    #: are the hundred.
    samples: Annotated[int, Meta(ge=1)] = 100
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the draws; the runs' own ``seed`` is another

    def shares(self, columns: int) -> FloatArray:
        """Independent points of the unit cube, each by a generator of its own."""
        rows = [np.random.default_rng([self.seed, n]).random(columns) for n in range(self.samples)]
        return np.array(rows)
