"""Scrambled Sobol points: they fill the space more evenly than random draws, however many."""

import warnings
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.sweeps.samplers.drawing import DrawingSampler, FloatArray


@dataclass(frozen=True, kw_only=True)
class Sobol(DrawingSampler):
    """A sequence of low discrepancy, scrambled after Owen and Matoušek."""

    NAME: ClassVar[str] = "sobol"
    #: Draws; best a power of two. The first 64 of 128 are the 64.
    samples: Annotated[int, Meta(ge=1)] = 128
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the scrambling; the runs' own ``seed`` is another

    def shares(self, columns: int) -> FloatArray:
        """The first points of the sequence."""
        from scipy.stats import qmc

        with warnings.catch_warnings():
            # Any number of them is well spread; that powers of two are best is documented.
            warnings.filterwarnings("ignore", message=".*power of 2.*")
            engine = qmc.Sobol(columns, seed=np.random.default_rng(self.seed))
            return np.asarray(engine.random(self.samples))
