"""Scrambled Sobol points: they fill the space more evenly than random draws, however many."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from trms_cli.sweeps.point import SweepPoint
from trms_cli.sweeps.robustness import Robustness
from trms_cli.sweeps.samplers.drawing import Planned, planned, require_drawn
from trms_cli.sweeps.space import Space


@dataclass(frozen=True, kw_only=True)
class Sobol:
    """A sequence of low discrepancy, scrambled after Owen and Matoušek."""

    #: Draws; best a power of two. The first 64 of 128 are the 64.
    samples: Annotated[int, Meta(ge=1)] = 128
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the scrambling; the runs' own ``seed`` is another
    #: Figures that are told of at the end, by the names of ``trms runs``
    figures: tuple[str, ...] = ()
    #: Largest allowed value of some figures: a run beyond one counts as a failure
    limits: Mapping[str, float] = field(default_factory=dict)

    def start(self, space: Space, known: Sequence[SweepPoint] = ()) -> Planned:
        """Begin, or go on; see :class:`trms_cli.sweeps.sampler.Sampler`."""
        from scipy.stats import qmc

        require_drawn(space, "sobol")
        told = Robustness(self.figures, self.limits).checked()
        with warnings.catch_warnings():
            # Any number of them is well spread; that powers of two are best is documented.
            warnings.filterwarnings("ignore", message=".*power of 2.*")
            engine = qmc.Sobol(len(space.continuous), seed=np.random.default_rng(self.seed))
            shares = np.asarray(engine.random(self.samples))
        return planned(space, shares, known, told)
