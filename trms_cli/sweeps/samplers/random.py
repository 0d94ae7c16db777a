"""Independent draws from ranges and priors, crossed with the choices: plain Monte Carlo."""

from __future__ import annotations

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
class Random:
    """Independent draws."""

    #: Draws; each is run with every combination of the choices. The first hundred of two hundred
    #: are the hundred.
    samples: Annotated[int, Meta(ge=1)] = 100
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the draws; the runs' own ``seed`` is another
    #: Figures that are told of at the end, by the names of ``trms runs``
    figures: tuple[str, ...] = ()
    #: Largest allowed value of some figures: a run beyond one counts as a failure
    limits: Mapping[str, float] = field(default_factory=dict)

    def start(self, space: Space, known: Sequence[SweepPoint] = ()) -> Planned:
        """Begin, or go on; see :class:`trms_cli.sweeps.sampler.Sampler`."""
        require_drawn(space, "random")
        told = Robustness(self.figures, self.limits).checked()
        shares = [
            np.random.default_rng([self.seed, number]).random(len(space.continuous))
            for number in range(self.samples)
        ]
        return planned(space, np.array(shares), known, told)
