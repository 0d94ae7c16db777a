"""Where a model rests: the equations of a steady state, and the unknowns that are left in them.

For a model with a derivative they are ``f(x, u, p, w) = 0`` in all states. A model that steps
rests where a step changes nothing; the states that only remember equal what they remember,

    x = state(s, u)      residual(s, u) = (transition(x, u) − x) / T  in the rows of s

so that a network with many delays has no more unknowns than it has outputs. The residual has the
unit of a rate in both cases.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.process_cache import call_memoised
from trms_cli.models.discrete import copied_states, root_of
from trms_cli.models.model import FloatArray, Model
from trms_cli.models.state_kinds import kinds_of_states

#: s; the fixed point of the input path's memory is that of any step.
_STEP = 0.02
_ITERATIONS = 50
#: s, free run of a black box before Newton's steps to its rest; and where those end.
_SETTLING, _AT_REST = 60.0, 1e-10
#: An axis whose angle is measured rests there, held by whatever holds it: its balance of torques
#: says nothing then, but settles what nothing else does.
_FAINT = 1e-6


@dataclass(frozen=True)
class RestEquations:
    """Equations of the steady states of one model."""

    unknowns: tuple[int, ...]  #: Positions in x of the states s that the others follow from
    state: ca.Function  #: ``(s, u) → x``, inlined where it is called
    #: ``(s, u, p, w)`` → what is zero at rest, in the unit of s per second, shape (n_s, 1)
    residual: ca.Function


def rest_equations(model: Model) -> RestEquations:
    """The equations for the states of a model at rest, without the memory of its input path."""
    return call_memoised(_rest_equations, model)


def _rest_equations(model: Model) -> RestEquations:
    x, u, p, w = model.symbols()
    if model.sample_time is None:
        f = model.dynamics(x, u, p, w)
        return RestEquations(
            tuple(range(model.n_x)),
            ca.Function("state", [x, u], [x]),
            ca.Function("residual", [x, u, p, w], [f]),
        )
    copies = copied_states(model)
    roots = [root_of(copies, i) for i in range(model.n_x)]
    unknowns = [i for i, root in enumerate(roots) if root == ("x", i)]
    s = ca.SX.sym("s", len(unknowns))
    lifted = ca.vertcat(*(s[unknowns.index(at)] if kind == "x" else u[at] for kind, at in roots))
    change = model.transition(lifted, u, p, w)[unknowns] - s
    return RestEquations(
        tuple(unknowns),
        ca.Function("state", [s, u], [lifted]),
        ca.Function("residual", [s, u, p, w], [change / model.sample_time]),
    )


def settled_state(model: Model, start: FloatArray) -> FloatArray:
    """A fixed point of a model that steps, without a command, (n_x,).

    A free run from ``start``, then Newton's method from where it ended. The run goes to a fixed
    point that is stable, where the model has several; an end that Newton's method does not improve
    is kept as it is.
    """
    assert model.sample_time is not None
    equations = rest_equations(model)
    _, u, p, w = model.symbols()
    s = ca.SX.sym("s", len(equations.unknowns))
    residual = equations.residual(s, u, p, w)
    newton = ca.Function("newton", [s, u, p, w], [residual, ca.jacobian(residual, s)])
    lifted = ca.Function("lifted", [s, u], [equations.state(s, u)])
    still = (np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))

    rows = list(equations.unknowns)
    at = model.symbols()
    step = ca.Function("free", list(at), [model.transition(*at)])
    count = max(1, round(_SETTLING / model.sample_time))
    arguments = (ca.repmat(ca.DM(value), 1, count) for value in still)
    ends = np.array(step.mapaccum(count)(lifted(start[rows], still[0]), *arguments))[:, -1]
    point = ends[rows] if np.isfinite(ends).all() else start[rows]
    fixed = _newton(newton, point, still)
    return np.array(lifted(fixed, still[0]))[:, 0]


def _newton(
    function: ca.Function, start: FloatArray, constant: tuple[FloatArray, ...]
) -> FloatArray:
    point = start.copy()
    for _ in range(_ITERATIONS):
        rate, slope = (np.array(value) for value in function(point, *constant))
        move, *_ = np.linalg.lstsq(slope, -rate[:, 0], rcond=1e-10)
        point = point + move
        if not np.isfinite(point).all():
            return start
        if np.abs(move).max() < _AT_REST * (1.0 + np.abs(point).max()):
            return point
    return start


def static_motor_command(model: Model, u: ca.SX, p: ca.SX) -> ca.SX:
    """What reaches the motors when ``u`` has been held for long, (n_u, 1): dead zones and limits.

    The memory of the input path is at the fixed point of its update; one Newton step from zero
    finds it for every path that is linear in its memory (delays, lags).
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


def resting_state(model: Model, measured: Mapping[str, float], command: FloatArray) -> FloatArray:
    """The state at which the rig rests with the measured values and a constant command.

    Measured states are taken over. The others solve, in least squares, ``f(x, u) = 0``: rotors
    turn at the speed of their command, rates are zero. The balance of torques of an axis counts
    only if its angle is not measured.

    ``measured``: by channel, NaN where missing; channels that are no states are ignored.
    ``command``: (n_u,).

    States that only remember an output or input take its value.
    """
    x = model.rest()
    measured_states = {
        name: value
        for name, value in measured.items()
        if name in model.state_names and np.isfinite(value)
    }
    for name, value in measured_states.items():
        x[model.state_index(name)] = value
    equations = rest_equations(model)
    rows = list(equations.unknowns)
    unknown = [k for k, i in enumerate(rows) if model.state_names[i] not in measured_states]
    if unknown:
        linear = BufferedFunction(call_memoised(_linear_rates, model), compile=False)
        weights = equation_weights(model, rows, measured_states.keys())
        constant = (command, model.parameters.values, np.zeros(model.n_w))
        _solve(x, rows, unknown, weights, lambda at: linear.evaluate(at, *constant))
    if not np.all(np.isfinite(x)):
        x = model.rest()
        for name, value in measured_states.items():
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


def equation_weights(model: Model, rows: list[int], measured_names: Set[str]) -> FloatArray:
    """How much the equation of each unknown counts."""
    weights = np.ones(len(rows))
    kinds = kinds_of_states(model)
    for k, i in enumerate(rows):
        name, kind = model.state_names[i], kinds[i]
        # A known state may well be changing. The equation of an angle is its rate where rates are
        # states; of a black box without it is the balance of torques itself.
        if name in measured_names and (kind != "angle" or "momentum" not in kinds):
            weights[k] = 0.0
        if kind == "momentum":
            weights[k] = _FAINT if measured_names & _angles(model) else 1.0
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
