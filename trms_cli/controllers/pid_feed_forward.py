"""What a model tells a PID law beforehand: the rotor's curve, the holding torque, the inverse.

The thrust of a rotor goes as ω|ω|, so that a volt is worth little where the rotor stands still and
much where it turns fast: the loop gain of an axis would change with its angle and with what pushes
it. The law therefore asks for a torque on its axis, and the :func:`torque_curve` of its rotor turns
that into an input. Both the curve and the holding torques are read off the steady states of the
model (:mod:`trms_cli.models.steady_state`), dead zones and supply limits included. That
takes some hundred solutions, so the tables are kept between runs.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.process_cache import cached_result
from trms_cli.models import steady_state
from trms_cli.models.discretisation import discretise
from trms_cli.models.dry_friction import turning_rate
from trms_cli.models.model import Model, names
from trms_cli.models.rest import static_motor_command
from trms_cli.models.steady_state import SteadyState, Target
from trms_cli.models.vector_field import holds_at_rest, without_impulses

#: Which rotor holds which axis.
ROTOR_OF_AXIS = {"pitch": "main", "yaw": "tail"}
#: Inputs of the curve are this part of the range apart, for the slope of a cell is a gain of the
#: loop. The wide one is that in which the infinite slope at a standing rotor becomes a finite one.
_CELL, _STANDING_CELL = 0.02, 0.06
#: First torque tried, N m, and how often a step may be halved or doubled.
_SMALLEST_TORQUE, _POINTS = 1e-5, 240
#: Beyond this part of the range the curve goes on as it came; before, a step that cannot be held
#: is tried again so many times, shortened.
_ENOUGH, _REFUSALS = 0.85, 4
_ANGLES = 25  # of the table of holding torques
_FURTHEST = 1.5  # rad, its range where an axis has no stops
#: The memory of the input path is at its fixed point whatever the step, s.
_MEMORY_STEP = 0.02
#: rad/s at which dry friction is read off; below the first, the torque fades. s, of that reading.
#: N m below which there is none.
_RATES = (0.001, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
_FRICTION_STEP, _NO_FRICTION = 1e-3, 1e-7
#: Values of a path memory at which its motion and its torque are read off; rad/s of that reading.
_MEMORY, _MEMORY_RATE = np.linspace(-1.0, 1.0, 41), 0.1
#: rad/s: the axes are followed up to about here.
INVERTED = np.geomspace(0.1, 3.0, 24)


@dataclass(frozen=True)
class PiecewiseLinear:
    """A function of one number, linear between its points and constant beyond them."""

    x: list[float]  #: Its points
    y: list[float]  #: x increases

    def at(self, value: float) -> float:
        x, y = self.x, self.y
        if value <= x[0]:
            return y[0]
        if value >= x[-1]:
            return y[-1]
        i = bisect_right(x, value)
        return y[i - 1] + (y[i] - y[i - 1]) * (value - x[i - 1]) / (x[i] - x[i - 1])

    def inverse(self) -> PiecewiseLinear:
        """Of an increasing table."""
        return PiecewiseLinear(self.y, self.x)

    def slope(self, value: float) -> float:
        """Of the cell that a value is in."""
        i = min(max(bisect_right(self.x, value), 1), len(self.x) - 1)
        return (self.y[i] - self.y[i - 1]) / (self.x[i] - self.x[i - 1])


@dataclass(frozen=True)
class RotorTables:
    """What the steady states say of one axis and its rotor."""

    curve: PiecewiseLinear  #: Input by torque, V by N m
    holding: PiecewiseLinear  #: Torque by angle, N m by rad
    #: Torque by the torque on each axis before this one, beyond what holds this one where those
    #: are at 0, N m by N m
    burdens: tuple[PiecewiseLinear, ...] = ()


@dataclass(frozen=True)
class PathMemory:
    """A state of the model that only motion of an axis changes, and its torque on that axis."""

    rise: PiecewiseLinear  #: Its change by the angle where that grows, 1/rad by its value
    fall: PiecewiseLinear  #: The same where the angle shrinks
    torque: PiecewiseLinear  #: What overcomes it, N m by its value


def rotor_tables(
    model: Model, channels: Mapping[str, int], steady: SteadyState
) -> dict[str, RotorTables]:
    """The tables of each axis, from the cache where this model has been asked before.

    ``channels``: input of the rotor that holds the axis, by axis. ``steady``: of this model, with
    its own parameters and equal weights.
    """

    def computed() -> dict[str, RotorTables]:
        tables: dict[str, RotorTables] = {}
        torques: dict[int, PiecewiseLinear] = {}
        for axis, channel in channels.items():
            curve = torque_curve(model, axis, channel, steady)
            torques[channel] = curve.inverse()
            holding = holding_torques(model, axis, channel, steady, torques[channel])
            burdens = [
                burden(model, other, (channels[other], channel), steady, torques)
                for other in tables
            ]
            tables[axis] = RotorTables(curve, holding, tuple(burdens))
        return tables

    inputs = [*_all_that_steady_states_follow_from(model), sorted(channels.items())]
    return cached_result(__file__, inputs, dict[str, RotorTables], computed)


def _all_that_steady_states_follow_from(model: Model) -> list[object]:
    """Equations, numbers and limits of a model, and the solver's code."""
    x, u, p, w = model.symbols()
    memory = ca.SX.sym("memory", len(model.memory(_MEMORY_STEP)))
    arriving, after = model.input_path(memory, u, p, (0.0, 1.0), _MEMORY_STEP)
    motion = model.dynamics if model.sample_time is None else model.transition
    equations = ca.Function(
        "equations", [x, u, p, w, memory], [motion(x, u, p, w), arriving, after]
    )
    return [
        equations.serialize(),
        model.parameters.values,
        model.rest(),
        model.state_names,
        names(model.disturbances),
        model.controlled,
        sorted(model.axes.items()),
        sorted(model.input_limits.items()),
        sorted(model.stops.items()),
        Path(str(steady_state.__file__)).read_bytes(),
    ]


def torque_curve(model: Model, axis: str, channel: int, steady: SteadyState) -> PiecewiseLinear:
    """Input by the torque on an axis that the rotor gives with it in steady state, V by N m.

    With the beam level and the yaw straight ahead: the input that holds the axis there against a
    torque −m on it gives m more than the one that holds it free.
    """
    equation = names(model.disturbances).index(model.axes[axis].moment)
    limit = float(model.input_bounds()[1][channel])
    zero = np.zeros(len(model.controlled))

    def solved(torque: float, guess: Target | None) -> Target | None:
        w = np.zeros(model.n_w)
        w[equation] = -torque
        target = steady.solve(zero, w, guess)
        return target if target.exact else None

    middle = solved(0.0, None)
    sides: list[list[tuple[float, float]]] = []
    for sign in (-1.0, 1.0):
        points: list[tuple[float, float]] = []
        torque, step, last, refused = 0.0, _SMALLEST_TORQUE, middle, 0
        for _ in range(_POINTS):
            if last is None:
                break
            following = solved(sign * (torque + step), last)
            if following is None:
                reached = abs(last.u[channel]) / limit
                if refused == _REFUSALS or reached > _ENOUGH:
                    break
                refused += 1
                step /= 4
                continue
            change = float(abs(following.u[channel] - last.u[channel])) / limit
            standing = abs(last.u[channel]) < _STANDING_CELL * limit
            cell = _STANDING_CELL if standing else _CELL
            if change < cell / 2:
                step *= 2.0
                if step > 1e6:
                    break
                continue
            torque += step
            points.append((sign * torque, float(following.u[channel])))
            last = following
            step *= min(2.0, max(0.25, cell / change))
        sides.append(points)
    start = [(0.0, float(middle.u[channel]))] if middle is not None else []
    points = sides[0][::-1] + start + sides[1]
    return _increasing(points, limit)


def _increasing(points: Sequence[tuple[float, float]], limit: float) -> PiecewiseLinear:
    """A strictly increasing table up to both limits; the ends go on as they ended."""
    table: list[tuple[float, float]] = []
    for torque, u in points:
        if not table or u > table[-1][1] + 1e-6 * limit:
            table.append((torque, u))
    if len(table) < 2:
        return PiecewiseLinear([-limit, limit], [-limit, limit])
    (a, ua), (b, ub) = table[0], table[1]
    if ua > -limit:
        table.insert(0, (a - (ua + limit) * (b - a) / (ub - ua), -limit))
    (a, ua), (b, ub) = table[-2], table[-1]
    if ub < limit:
        table.append((b + (limit - ub) * (b - a) / (ub - ua), limit))
    return PiecewiseLinear([p[0] for p in table], [p[1] for p in table])


def holding_torques(
    model: Model, axis: str, channel: int, steady: SteadyState, torque_of: PiecewiseLinear
) -> PiecewiseLinear:
    """Torque that holds an axis at an angle, N m by rad, with the other axis at 0."""
    points = [
        (value, torque_of.at(float(target.u[channel])))
        for value, target in _held(model, axis, steady)
    ]
    table = points or [(0.0, 0.0)]
    return PiecewiseLinear([p[0] for p in table], [p[1] for p in table])


def burden(
    model: Model,
    axis: str,
    channels: tuple[int, int],
    steady: SteadyState,
    torques: Mapping[int, PiecewiseLinear],
) -> PiecewiseLinear:
    """Torque that holds another axis at 0 by the torque that holds one, N m by N m.

    What a rotor's drag does to the other axis. Zero where the one is held at 0.

    ``channels``: inputs of the rotors that hold the one and the other. ``torques``: torque by
    input of each.
    """
    pairs, free = [], 0.0
    for value, target in _held(model, axis, steady):
        own, other = (torques[c].at(float(target.u[c])) for c in channels)
        pairs.append((own, other))
        free = other if value == 0.0 else free
    pairs.sort()
    table = [pairs[0]] if pairs else [(0.0, free)]
    for own, other in pairs[1:]:
        if own > table[-1][0] + _SMALLEST_TORQUE:
            table.append((own, other))
    return PiecewiseLinear([p[0] for p in table], [p[1] - free for p in table])


def _held(model: Model, axis: str, steady: SteadyState) -> list[tuple[float, Target]]:
    """Angles of an axis, rad, increasing, and the steady states there with the others at 0."""
    angle = model.axes[axis].angle
    position = model.controlled.index(angle)
    furthest = min(model.stops.get(angle, math.inf), _FURTHEST)
    held: dict[float, Target] = {}
    for sign in (-1.0, 1.0):
        last: Target | None = None
        for value in np.linspace(0.0, sign * furthest, _ANGLES // 2 + 1).tolist():
            reference = np.zeros(len(model.controlled))
            reference[position] = value
            target = steady.solve(reference, None, last)
            if not target.exact:
                break
            last = target
            held[value + 0.0] = target
    return sorted(held.items(), key=lambda item: item[0])


def friction_torques(model: Model, axis: str) -> PiecewiseLinear | None:
    """Torque with which dry friction resists a rate of an axis, N m by rad/s.

    With the beam level and at rest otherwise. Below the first of :data:`_RATES` it fades, so that a
    reference that comes to rest asks for none. Of friction that falls with the rate (Stribeck) the
    least from a rate on. None for an axis without dry friction.
    """
    if not holds_at_rest(model):
        return None
    equation = names(model.disturbances).index(model.axes[axis].moment)
    rate = turning_rate(model, equation)
    assert rate is not None  # the torque is the axis' own
    x, u, p, w = at = model.symbols()
    steps = [discretise(m, _FRICTION_STEP).step for m in (model, without_impulses(model))]
    inert = ca.SX.zeros(len(model.memory(_FRICTION_STEP)))
    ends = [rate(step(ca.vertcat(x, inert), u, p, w)[: model.n_x, 0], u, p, w) for step in steps]
    change = ends[1] - ends[0]
    torque = change / ca.jacobian(ends[1], w[equation])
    push = ca.jacobian(model.dynamics(*at), w[equation])
    turned = push / ca.jtimes(rate(*at), x, push)
    evaluate = ca.Function("friction", list(at), [torque, turned])
    rest, idle = model.rest(), (np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))
    turning = np.array(evaluate(rest, *idle)[1]).ravel()
    sides = [float(evaluate(rest + turning * v, *idle)[0]) for v in _RATES]
    if max(sides) < _NO_FRICTION:
        return None
    # No more than at any faster rate: an axis that is given more than resists it swings.
    sides = np.minimum.accumulate(sides[::-1])[::-1].tolist()
    rates = [-v for v in reversed(_RATES)] + [0.0] + list(_RATES)
    return PiecewiseLinear(rates, [-f for f in reversed(sides)] + [0.0] + sides)


def path_memories(model: Model, axis: str) -> tuple[PathMemory, ...]:
    """What the states that remember the path of an axis do to it, with the beam level.

    What such a state does depends on the path alone, not on how fast it is travelled: its rate is
    read off at one rate of the axis each way.
    """
    equation = names(model.disturbances).index(model.axes[axis].moment)
    rate = turning_rate(model, equation)
    if rate is None:
        return ()
    at = model.symbols()
    x, w = at[0], at[3]
    motion = model.dynamics(*at)
    push = ca.jacobian(motion, w[equation])
    turned = push / ca.jtimes(rate(*at), x, push)
    evaluate = ca.Function("motion", list(at), [motion, push, turned])
    idle = (np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))
    rest = model.rest()
    pushed, turning = (np.array(v).ravel() for v in evaluate(rest, *idle)[1:])
    row = int(np.argmax(np.abs(pushed)))

    def motion_at(position: int, value: float, speed: float) -> FloatArray:
        state = rest + turning * speed
        state[position] = value
        return np.array(evaluate(state, *idle)[0]).ravel()

    memories = []
    for i in model.path_memory:
        torques = -np.array([motion_at(i, z, 0.0)[row] for z in _MEMORY]) / pushed[row]
        torques -= torques[len(_MEMORY) // 2]
        rise, fall = (
            [float(motion_at(i, z, speed)[i]) / speed for z in _MEMORY]
            for speed in (_MEMORY_RATE, -_MEMORY_RATE)
        )
        if np.abs(torques).max() < _NO_FRICTION:
            continue
        values = _MEMORY.tolist()
        tables = (PiecewiseLinear(values, y) for y in (rise, fall, torques.tolist()))
        memories.append(PathMemory(*tables))
    return tuple(memories)


def without_input_memory(model: Model) -> Model:
    """The model whose commands reach the motors at once, as they would after a long time."""
    prompt = copy.copy(model)
    prompt.memory = lambda step: ()  # type: ignore[method-assign]
    prompt.input_path = (  # type: ignore[method-assign]
        lambda memory, u, p, window, step: (static_motor_command(model, u, p), memory)
    )
    return prompt


def inverse(responses: Sequence[ComplexArray], omega: FloatArray) -> FloatArray:
    """Coefficients c of the polynomial c_0 + c_1 s + c_2 s² + c_3 s³ closest to 1/G.

    Least squares of ``G(jω) Σ c_i (jω)ⁱ − 1`` over all responses G: the error of the angle when
    the polynomial drives the axis. For a rotor's lag before an axis with inertia, damping and
    stiffness it is exact.

    ``responses``: sequence of (n,) arrays; of the angle to the torque asked for, rad/(N m).
    ``omega``: (n,) array; rad/s.
    """
    powers = (1j * omega[:, None]) ** np.arange(4)
    rows = np.concatenate([response[:, None] * powers for response in responses])
    scale = np.abs(rows).max(axis=0)
    both = np.concatenate([rows.real, rows.imag]) / scale
    target = np.concatenate([np.ones(len(rows)), np.zeros(len(rows))])
    solution, *_ = np.linalg.lstsq(both, target, rcond=None)
    return np.asarray(solution / scale)


def is_rotor_before_axis(coefficients: FloatArray) -> bool:
    """Whether an inverse is one of a lag before an axis with inertia and damping.

    Such a one has its roots on the left but for the one or two of an axis that nothing pulls back,
    which lie about 0. ``coefficients``: (4,) array, as of :func:`inverse`.
    """
    roots = np.roots(coefficients[::-1])
    return bool(roots.size == 3 and roots.real.max() < INVERTED[0] / 2)


def rotor_lag(coefficients: FloatArray) -> float:
    """Time constant of the real factor (1 + τ s) of the inverse, s; 0 if it has none.

    Of the three roots one is the rotor's; the other two are the axis' swing. Where all three are
    real, the fastest is taken.
    """
    roots = np.roots(coefficients[::-1])
    real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real < 0)].real
    return float(1 / -real.min()) if real.size else 0.0


def decoupling(
    cross: Sequence[ComplexArray],
    own: Sequence[ComplexArray],
    other: Sequence[ComplexArray],
    omega: FloatArray,
    lag: float,
) -> float:
    """Torque on an axis by the rate of another's that undoes what the other does to it, s.

    Least squares of ``(G_cross/G_own + d_0 + d_1 jω/(1 + jω lag))/G_other`` over all responses;
    d_1. That is the torque left on the axis per radian that the other moves: neither axis' own
    swing, which the loops damp, has a weight in it. A rotor that speeds up turns the rig the other
    way round: that is a torque by a rate.

    ``cross``: of the axis' angle to the other's torque. ``own``: to its own. ``other``: of the
    other's angle to that one's torque.
    """
    rate = 1j * omega / (1 + 1j * omega * lag)
    rows = np.concatenate([np.stack([1 / g, rate / g], axis=-1) for g in other])
    target = -np.concatenate([c / (o * g) for c, o, g in zip(cross, own, other, strict=True)])
    solution, *_ = np.linalg.lstsq(
        np.concatenate([rows.real, rows.imag]),
        np.concatenate([target.real, target.imag]),
        rcond=None,
    )
    return float(solution[1])
