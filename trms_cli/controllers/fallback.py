"""What acts when a controller has no answer: its declared fall-back, finite and within limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from trms_cli.controllers.controller import Command, Status
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import SimulationError

#: The last plan shifted in time, the last command, the steady-state input of the reference, or the
#: end of the run.
Policy = Literal["shifted_plan", "hold", "steady_input", "stop"]


def fall_back(
    who: str,
    policy: Policy,
    reason: str,
    candidates: Mapping[str, FloatArray | None],
    bounds: tuple[FloatArray, FloatArray],
) -> Command:
    """The declared command of a sample that has no solution.

    Parameters
    ----------
    who : str
        The controller, for the message that ends a run.
    candidates : dict of str to (n_u,) array or None
        Command of each policy that there is now; ``hold`` is always there and finite.
    bounds : (lower, upper)
        Of the inputs, V.

    Raises
    ------
    SimulationError
        Under the policy ``stop``.
    """
    if policy == "stop":
        raise SimulationError(
            f"{who}: {reason}",
            where="controller",
            remedy="choose another controller.fallback to go on",
        )
    acting: str = policy
    chosen = candidates.get(acting)
    if chosen is None or not np.isfinite(chosen).all():
        acting, chosen = "hold", candidates["hold"]
    assert chosen is not None
    return Command(
        np.clip(chosen, *bounds),
        Status.FAILED,
        fallback=acting,
        message=f"{reason}; {acting.replace('_', ' ')} acts",
    )
