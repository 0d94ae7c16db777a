"""Where a model is before anything but one measurement and the command in force is known."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model
from trms_cli.observers.state_kinds import kinds_of_states

FloatArray = npt.NDArray[np.float64]

_ITERATIONS = 50
#: An axis whose angle is measured rests there, held by whatever holds it: its balance of torques
#: says nothing then, but settles what nothing else does.
_FAINT = 1e-6


def resting_state(model: Model, measured: Mapping[str, float], command: FloatArray) -> FloatArray:
    """The state at which the rig rests with the measured values and a constant command.

    Measured states are taken over. The others solve, in least squares, ``f(x, u) = 0``: rotors
    turn at the speed of their command, rates are zero. The balance of torques of an axis counts
    only if its angle is not measured.

    Parameters
    ----------
    measured : dict of str to float
        By channel, NaN where missing; channels that are no states are ignored.
    command : (n_u,) array
    """
    x = model.rest()
    known = {
        name: value
        for name, value in measured.items()
        if name in model.state_names and np.isfinite(value)
    }
    for name, value in known.items():
        x[model.state_index(name)] = value
    unknown = [i for i, name in enumerate(model.state_names) if name not in known]
    if not unknown:
        return x

    weights = np.ones(model.n_x)
    for i, (name, kind) in enumerate(zip(model.state_names, kinds_of_states(model), strict=True)):
        if name in known and kind != "angle":
            weights[i] = 0.0  # it may well be changing
        if kind == "momentum":
            weights[i] = _FAINT if known.keys() & _angles(model) else 1.0

    at = model.symbols()
    f = model.dynamics(*at)
    linear = ca.Function("rates", list(at), [f, ca.densify(ca.jacobian(f, at[0]))])
    constant = (command, model.parameters.values, np.zeros(model.n_w))
    for _ in range(_ITERATIONS):
        rates, slope = (np.array(value) for value in linear(x, *constant))
        slope = weights[:, None] * slope[:, unknown]
        # Scaled columns: rotor speeds are a hundred times what angles are.
        scale = np.maximum(np.linalg.norm(slope, axis=0), 1e-12)
        move, *_ = np.linalg.lstsq(slope / scale, -weights * rates[:, 0], rcond=1e-10)
        x[unknown] += move / scale
        if np.max(np.abs(move / scale)) < 1e-9:
            break
    if not np.all(np.isfinite(x)):
        x = model.rest()
        for name, value in known.items():
            x[model.state_index(name)] = value
    return x


def _angles(model: Model) -> set[str]:
    return {axis.angle for axis in model.axes.values()}
