"""Every combination of the choices, each once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.samplers.drawing import PlannedPoints, plan_points
from trms_cli.sweeps.space import PriorOfKey, Space, SweepPoint


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Nested loops over the choices, the last typed running fastest."""

    def start(self, space: Space, earlier_points: Sequence[SweepPoint] = ()) -> PlannedPoints:
        """Begin, or go on; see :class:`trms_cli.sweeps.plugins.Sampler`."""
        if space.continuous:
            first = space.continuous[0]
            what = "a prior" if isinstance(first, PriorOfKey) else "a range of numbers"
            listed = f"{first.key}=A,B,…"
            raise ConfigurationError(
                f"{what} has no list of values to try one by one",
                where=first.key,
                remedy="draw from it: add sampler=latin_hypercube sampler.samples=100; search in "
                f"it: sampler=optimise; or list values: {listed}",
            )
        return plan_points(space, np.zeros((1, 0)), earlier_points)
