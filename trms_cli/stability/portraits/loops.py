"""Trajectories of a closed loop in the plane of a portrait.

The command follows from what the controller and its observer remember, not from the state alone:
there is no field in the plane, so no nullclines, and trajectories may cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.portraits.journeys import Journey
from trms_cli.stability.portraits.section import Section
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts

FloatArray = npt.NDArray[np.float64]

#: A command within this share of its bound is at it.
_AT_BOUND = 1e-6


@dataclass(frozen=True)
class LoopJourneys:
    """Trajectories of a loop."""

    journeys: tuple[Journey, ...]
    failures: int  #: Control samples whose solve failed, of all runs
    ended: tuple[str, ...]  #: Why runs ended early


def loop_journeys(
    section: Section, loop: LoopParts, starts: FloatArray, duration: float, tell: Tell
) -> LoopJourneys:
    """Runs of the loop from starts (m, n_x), its references at the section's operating point."""
    coordinates, point = section.coordinates, section.point
    model = coordinates.model
    bound = model.input_bounds()[1] * (1.0 - _AT_BOUND)
    found, failures, ended = [], 0, []
    for number, start in enumerate(starts, 1):
        tell(f"run {number} of {len(starts)}")
        offset = dict(zip(model.state_names, (start - point.x).tolist(), strict=True))
        run = run_loop(model, loop, point, duration, offset=offset)
        # What is held back is the command as given: a loop's path to the motors bounds it too.
        saturated = np.any(np.abs(run.applied) >= bound, axis=1)
        c = coordinates.values(run.x, run.applied)
        found.append(Journey(run.time, run.x, c, saturated))
        failures += run.failures
        if run.ended:
            ended.append(run.ended)
    return LoopJourneys(tuple(found), failures, tuple(ended))
