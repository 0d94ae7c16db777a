"""Which targets of a run have a terminal region, and what a horizon ends in where one has not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trms_cli.controllers.newton_region import RegionDesign, TerminalRegion
from trms_cli.controllers.newton_step import NewtonStep
from trms_cli.models.steady_state import Target

FloatArray = npt.NDArray[np.float64]


class TerminalRegions:
    """Regions of the targets met so far, and which iteration a target calls for.

    Parameters
    ----------
    design : RegionDesign
    newton : NewtonStep
        The iteration whose horizon ends in a region.
    equality : NewtonStep
        The iteration that ends in the steady state. Made beforehand, since a run has no time to
        compile it when a target turns up that has no region.

    Notes
    -----
    A region serves all targets within the same cell of a grid (a share of the states' typical
    sizes and of the inputs' range): an estimated disturbance moves the target a little at every
    sample, and a design takes milliseconds.
    """

    cell = 0.01

    def __init__(self, design: RegionDesign, newton: NewtonStep, equality: NewtonStep) -> None:
        self._design, self._newton, self._equality = design, newton, equality
        model = newton.horizon.model
        self._grid = self.cell * np.concatenate(
            [newton.horizon.scale, np.maximum(model.input_bounds()[1], 1e-3)]
        )
        self._known: dict[tuple[float, ...], TerminalRegion | None] = {}
        self._target: Target | None = None
        self._centre = np.zeros(0)
        #: Of the present target, None where there is none.
        self.region: TerminalRegion | None = None

    def engine_for(
        self, target: Target, disturbance: FloatArray, present: NewtonStep
    ) -> NewtonStep:
        """The iteration for a target, with the plan and the trajectory of the present one."""
        if target is not self._target:
            self._target, self._centre = target, self._design.centre(target)
            key = tuple(np.round(np.concatenate([target.x, target.u]) / self._grid).tolist())
            if key not in self._known:
                self._known[key] = self._design.at(self._centre, disturbance)
            self.region = self._known[key]
        if self.region is None:
            chosen = self._equality
        else:
            chosen = self._newton
            chosen.set_region(self._centre, self.region.root, self.region.level)
        if chosen is not present:
            chosen.plan[:], chosen.trajectory[:] = present.plan, present.trajectory
        return chosen

    def tail(self, newton: NewtonStep, target: Target) -> FloatArray:
        """What the plan goes on with beyond its end: the local law, or the steady-state input.

        To be asked before :meth:`engine_for`, for a target that has not changed.
        """
        if self.region is None or target is not self._target:
            return target.u
        end = np.concatenate([newton.trajectory[:, -1], newton.plan[:, -1]])
        wanted = target.u + self.region.gain @ (end - self._centre)
        return np.asarray(np.clip(wanted, newton.lower, newton.upper))
