"""Trajectories of a closed loop in the plane of a portrait.

The command follows from what the controller and its observer remember, not from the state alone:
there is no field in the plane, so no nullclines, and trajectories may cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.stability.closed_loop import run_loop
from trms_cli.stability.portraits.journeys import Journey
from trms_cli.stability.portraits.section import Section
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import LoopParts

FloatArray = npt.NDArray[np.float64]

#: A command within this share of its bound is at it.
_AT_BOUND = 1e-6
#: Commands in which a controller shows whether it answers, and what is added to them for that, in
#: shares of half the range.
_SOON, _PUSH = 50, 0.05


@dataclass(frozen=True)
class LoopJourneys:
    """Trajectories of a loop.

    Attributes
    ----------
    journeys : tuple of Journey
    failures : int
        Control samples whose solve failed, of all runs.
    ended : tuple of str
        Why runs ended early.
    """

    journeys: tuple[Journey, ...]
    failures: int
    ended: tuple[str, ...]


def require_feedback(section: Section, loop: LoopParts) -> None:
    """Refuse a controller whose commands are the same with and without a step added to them.

    Raises
    ------
    ConfigurationError
    """
    model, point = section.coordinates.model, section.point
    lower, upper = model.input_bounds()
    step = _PUSH * (upper - lower) / 2
    duration = _SOON * (getattr(loop.controller, "sample_time", None) or loop.sample_time)
    plain = run_loop(model, loop, point, duration)
    pushed = run_loop(model, loop, point, duration, path=lambda k, u: u + step)
    if np.array_equal(plain.u, pushed.u):
        raise ConfigurationError(
            f"the commands of controller={loop.names['controller']} do not depend on what it sees: "
            "there is no loop",
            where="controller",
            remedy="choose one that feeds back, as controller=lqr; without a controller, the "
            "portrait is that of the model with its command held (study.at.u_v=…)",
        )


def loop_journeys(
    section: Section, loop: LoopParts, starts: FloatArray, duration: float, tell: Tell
) -> LoopJourneys:
    """Runs of the loop from starts (m, n_x), its references at the section's operating point.

    Raises
    ------
    ConfigurationError
        If the controller does not answer.
    """
    coordinates, point = section.coordinates, section.point
    model = coordinates.model
    require_feedback(section, loop)
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
