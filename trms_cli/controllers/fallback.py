"""What acts when a controller has no answer: its declared fall-back, finite and within limits."""

import math
from typing import Literal

import numpy as np

from trms_cli.controllers.controller import Command, Status
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import SimulationError
from trms_cli.models.steady_state import Target

#: The last plan shifted in time, the last command, the steady-state input of the reference, or the
#: end of the run.
Policy = Literal["shifted_plan", "hold", "steady_input", "stop"]

NOT_FINITE = "the estimate or the reference is not finite"


def are_finite(*vectors: FloatArray) -> bool:
    """Whether no component of any is NaN or infinite; a sum of a few numbers shows either."""
    total = 0.0
    for vector in vectors:  # at every sample: faster than a generator
        total += sum(vector.ravel().tolist())
    return math.isfinite(total)


def fall_back(
    who: str,
    policy: Policy,
    reason: str,
    planned: FloatArray | None,
    target: Target | None,
    last: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> Command:
    """The declared command of a sample that has no solution; ``hold`` where there is no such one.

    Raises SimulationError under the policy ``stop``.

    ``who``: the controller, for the message that ends a run. ``planned``, ``last``: (n_u,); what
    the plan has for now, None without one; the last command, finite. ``bounds``: (lower, upper); of
    the inputs, V.
    """
    if policy == "stop":
        raise end_of_run(who, reason)
    steady = None if target is None else target.u
    acting: str = policy
    command = {"shifted_plan": planned, "steady_input": steady, "hold": last}[policy]
    if command is None or not np.isfinite(command).all():
        acting, command = "hold", last
    words = f"{reason}; {acting.replace('_', ' ')} acts"
    return Command(np.clip(command, *bounds), Status.FAILED, fallback=acting, message=words)


def end_of_run(who: str, reason: str) -> SimulationError:
    """What the policy ``stop`` ends a run with."""
    return SimulationError(
        f"{who}: {reason}",
        where="controller",
        remedy="choose another controller.fallback to go on",
    )


def hold_command(last: FloatArray, reason: str) -> Command:
    """The last command, (n_u,) and finite, of a law that has no answer."""
    words = f"{reason}; the last command is held"
    return Command(last.copy(), Status.FAILED, fallback="hold", message=words)
