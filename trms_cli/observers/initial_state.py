"""Where a model is before anything but one measurement and the command in force is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.process_cache import kept
from trms_cli.models.model import Model
from trms_cli.models.rest import rest_equations
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

    Notes
    -----
    States that only remember an output or input take its value.
    """
    x = model.rest()
    known = {
        name: value
        for name, value in measured.items()
        if name in model.state_names and np.isfinite(value)
    }
    for name, value in known.items():
        x[model.state_index(name)] = value
    equations = rest_equations(model)
    rows = list(equations.unknowns)
    unknown = [k for k, i in enumerate(rows) if model.state_names[i] not in known]
    if unknown:
        linear = BufferedFunction(kept(_linear_rates, model), compile=False)
        weights = equation_weights(model, rows, known.keys())
        constant = (command, model.parameters.values, np.zeros(model.n_w))
        _solve(x, rows, unknown, weights, lambda at: linear.evaluate(at, *constant))
    if not np.all(np.isfinite(x)):
        x = model.rest()
        for name, value in known.items():
            x[model.state_index(name)] = value
    whole = BufferedFunction(equations.state, compile=False)
    return whole.evaluate(x[rows], command)[0].copy()


def _linear_rates(model: Model) -> ca.Function:
    """``(s, u, p, w)`` → the equations of rest and their slopes in s, both dense."""
    equations = rest_equations(model)
    _, u, p, w = model.symbols()
    s = ca.SX.sym("s", len(equations.unknowns))
    f = equations.residual(s, u, p, w)
    return ca.Function("rates", [s, u, p, w], [f, ca.densify(ca.jacobian(f, s))])


def equation_weights(model: Model, rows: list[int], known: Set[str]) -> FloatArray:
    """How much the equation of each unknown counts."""
    weights = np.ones(len(rows))
    kinds = kinds_of_states(model)
    for k, i in enumerate(rows):
        name, kind = model.state_names[i], kinds[i]
        # A known state may well be changing. The equation of an angle is its rate where there is
        # a derivative; of a black box it is the balance of torques itself.
        if name in known and (kind != "angle" or model.sample_time is not None):
            weights[k] = 0.0
        if kind == "momentum":
            weights[k] = _FAINT if known & _angles(model) else 1.0
    return weights


def _solve(
    x: FloatArray,
    rows: list[int],
    unknown: list[int],
    weights: FloatArray,
    linear: Callable[[FloatArray], Sequence[FloatArray]],
) -> None:
    """Gauss–Newton on the unknown ones among the rows, in place."""
    free = [rows[k] for k in unknown]
    for _ in range(_ITERATIONS):
        rates, slope = (np.array(value, order="C") for value in linear(x[rows]))
        slope = weights[:, None] * slope.reshape(len(rows), -1)[:, unknown]
        # Scaled columns: rotor speeds are a hundred times what angles are.
        scale = np.maximum(np.linalg.norm(slope, axis=0), 1e-12)
        move, *_ = np.linalg.lstsq(slope / scale, -weights * rates, rcond=1e-10)
        x[free] += move / scale
        if np.max(np.abs(move / scale)) < 1e-9:
            break


def _angles(model: Model) -> set[str]:
    return {axis.angle for axis in model.axes.values()}
