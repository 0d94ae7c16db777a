"""What reaches the motors when a command has been held for long."""

from __future__ import annotations

import casadi as ca

from trms_cli.models.model import Model

#: s; the fixed point of the input path's memory is that of any step.
_STEP = 0.02


def arriving(model: Model, u: ca.SX, p: ca.SX) -> ca.SX:
    """The input path of a model in its steady state, (n_u, 1): dead zones and limits.

    The memory of the path is at the fixed point of its update; one Newton step from zero finds it
    for every path that is linear in its memory (delays, lags).
    """
    n_m = len(model.memory(_STEP))
    memory = ca.SX.sym("memory", n_m)
    reached, after = model.input_path(memory, u, p, (0.0, 1.0), _STEP)
    if n_m == 0:
        return reached
    change = after - memory
    fixed = -ca.solve(ca.densify(ca.jacobian(change, memory)), change)
    fixed = ca.substitute(fixed, memory, ca.SX.zeros(n_m))
    return ca.substitute(reached, memory, fixed)
