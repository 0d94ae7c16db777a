"""Where dry friction holds a rig at a point, so that a small signal moves nothing.

Set-valued friction at rest takes up any torque below its own. A test signal of a few millivolts
then does not turn the axis, and what is read of its loop is no response, but zero. The linear loop
that margins are about is that of the rig as it glides.
"""

from __future__ import annotations

import numpy as np

from trms_cli.models.dry_friction import SPEEDS
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.vector_field import VectorField

#: Step of the commands, as a share of half their range: any dry friction takes up so little.
_STEP = 1e-6
#: s that the rig has to answer, and part of the free motion below which it has not.
_WAIT, _HELD = 0.5, 0.01


def held_by_friction(model: Model, point: OperatingPoint) -> tuple[str, ...]:
    """Angles and rotor speeds that a small step of the commands does not move, for dry friction.

    Parameters
    ----------
    model : Model
        With its effects; one that only steps from sample to sample has no friction of this kind.
    point : OperatingPoint

    Returns
    -------
    tuple of str
        States that move without dry friction, and do not with it.
    """
    if model.sample_time is not None:
        return ()
    lower, upper = model.input_bounds()
    commands = np.vstack([point.u, point.u + _STEP * (upper - lower) / 2])
    starts = np.vstack([point.x, point.x])
    field = VectorField(model)
    moved = []
    for impulses in (True, False):
        ends = field.motions(starts, commands, _WAIT, _WAIT / 10, impulses=impulses)
        moved.append(np.abs(ends[:, 1] - ends[:, 0]).max(axis=0))
    with_friction, free = moved
    speeds = [SPEEDS[rotor] for rotor in model.rotors if SPEEDS.get(rotor) in model.state_names]
    rows = {name: model.state_index(name) for name in (*model.controlled, *speeds)}
    return tuple(name for name, i in rows.items() if with_friction[i] < _HELD * free[i])
