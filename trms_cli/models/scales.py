"""How large the forces, travels and times of a model are, by its own equations.

What is typical of a rig, the friction of a bearing or the lag of a drive, is known for small
benches with two rotors. Another rig's is that in the proportion of their scales: a friction of a
hundredth of the force that full command makes is as likely on a drive of 200 N as on a beam of
0.1 N m.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.models.dry_friction import axis_of, moment_index
from trms_cli.models.model import Model, Signal, index_of, names
from trms_cli.models.parameters import Parameter


class PortScale(NamedTuple):
    """What is large at one place of a rig: an input, an equation of motion, an output."""

    force: float = 0.1  #: That full command makes there; by default all are those of small benches
    travel: float = 1.0  #: Of the angle or position, or the output
    time: float = 0.5  #: s
    input: float = 2.5  #: Full command
    force_unit: str = "N*m"
    travel_unit: str = "rad"
    input_unit: str = "V"


#: Of the rigs that effects state their typical sizes for.
BENCH = PortScale()

#: Travel of an axis that turns without a stop, rad.
_FREE_TURN = 1.0
#: Poles slower than this, 1/s, are integrators.
_STILL = 1e-6
_STEPS, _MOST_STEPS = 600, 20_000
_FACTOR = re.compile(r"([*/]?)(N\*m|rad|V|Hz|[A-Za-z]+|1)(?:\^(\d+))?")


@dataclass(frozen=True)
class ModelScales:
    """The scales of a model."""

    time: float  #: s, of its dynamics: the median of its poles' time constants at rest
    inputs: Mapping[str, float]  #: Full command of each input, in its unit
    forces: Mapping[str, float]  #: Of each axis, in the unit of its moment
    travels: Mapping[str, float]  #: Of each axis, by its name, and of each output, by its name


@lru_cache(maxsize=128)
def acceleration_function(model: Model, axes: tuple[str, ...]) -> ca.Function:
    """``(x, u, p, w) → acceleration (n, 1), mobility (n, n)`` of some axes.

    ``mobility[i, j]`` is what a unit force on axis ``j`` adds to the acceleration of axis ``i``.
    Built once for a model, and inlined wherever it is called.
    """
    x, u, p, w = model.symbols()
    f = model.dynamics(x, u, p, w)
    rates = f[[model.state_index(axis_of(model, axis).angle) for axis in axes]]
    acceleration = ca.jtimes(rates, x, f)
    columns = [moment_index(model, axis) for axis in axes]
    mobility = ca.jacobian(acceleration, w)[:, columns]
    return ca.Function("accelerations", [x, u, p, w], [acceleration, mobility])


@lru_cache(maxsize=32)
def scales_of(model: Model) -> ModelScales:
    """The scales by a simulation: full command on each input to both sides, from rest.

    It lasts as long as the slowest pole at rest takes, and ends where an axis has reached its stop,
    or without one has turned by a radian. What nothing moves within it has a scale of small
    benches.
    """
    x, u, p, w = model.symbols()
    known = {"p": model.parameters.values, "w": np.zeros(model.n_w)}
    axes = tuple(model.axes)
    rows = [model.state_index(model.axes[axis].angle) for axis in axes]
    acceleration, mobility = acceleration_function(model, axes)(x, u, p, w)
    equations = ca.vertcat(model.dynamics(x, u, p, w), acceleration / ca.diag(mobility))
    read = ca.vertcat(equations[model.n_x :], model.measurement(x, u, p))
    at = ca.Function("at", [x, u, p, w], [equations[: model.n_x], read], [*"xupw"], ["f", "read"])
    rest, zero = model.rest(), np.zeros(model.n_u)
    slope = ca.Function("slope", [x, u, p, w], [ca.jacobian(at(x, u, p, w)[0], x)])
    poles = np.abs(np.linalg.eigvals(np.array(slope(rest, zero, known["p"], known["w"]))))
    poles = poles[poles > _STILL]
    time = float(np.median(1 / poles)) if poles.size else BENCH.time
    duration = min(3 / float(poles.min()), 60 * time) if poles.size else 4 * time
    steps = int(np.clip(duration * float(poles.max(initial=0.0)), _STEPS, _MOST_STEPS))
    simulate = _simulation(at, duration / steps, steps)
    read_all = at.map(steps)
    limits = np.array([_most_travel(model, axis) for axis in axes])
    start = np.array(at(x=rest, u=zero, **known)["read"]).ravel()
    changes, travels = np.zeros(len(start)), np.zeros(len(axes))
    for i, bound in enumerate(model.input_bounds()[1]):
        for sign in (-1.0, 1.0) if np.isfinite(bound) else ():
            command = zero.copy()
            command[i] = sign * bound
            path = np.array(simulate(rest, command, known["p"], known["w"]))
            path = np.column_stack([rest, path[:, :-1]])
            away = np.abs(path[rows] - rest[rows, None])
            over = ~np.isfinite(path).all(axis=0) | (away > limits[:, None]).any(axis=0)
            end = int(np.argmax(over)) if over.any() else steps
            readings = read_all(x=path, u=command, **known)["read"]
            change = np.abs(np.array(readings) - start[:, None])[:, :end]
            changes = np.fmax(changes, change.max(axis=1))
            travels = np.fmax(travels, away[:, :end].max(axis=1, initial=0.0))
    stops = np.array([model.stops.get(model.axes[axis].angle, np.inf) for axis in axes])
    travels = np.where(np.isfinite(stops), stops, travels)
    by_axis = _positive(axes, travels, BENCH.travel)
    outputs = _positive(names(model.outputs), changes[len(axes) :], BENCH.travel)
    of_angle = {model.axes[axis].angle: by_axis[axis] for axis in axes}
    outputs |= {name: of_angle[name] for name in outputs if name in of_angle}
    inputs = {
        name: bound if np.isfinite(bound) else 1.0 for name, bound in model.input_limits.items()
    }
    return ModelScales(
        time, inputs, _positive(axes, changes[: len(axes)], BENCH.force), outputs | by_axis
    )


def _simulation(at: ca.Function, step: float, count: int) -> ca.Function:
    """``(x, u, p, w)`` → the states after each of so many Runge–Kutta steps, (n_x, count)."""
    x, u, p, w = (ca.SX.sym(name, at.size1_in(name)) for name in "xupw")
    f = [at(x, u, p, w)[0]]
    for fraction in (0.5, 0.5, 1.0):
        f.append(at(x + fraction * step * f[-1], u, p, w)[0])
    after = x + step / 6 * (f[0] + 2 * f[1] + 2 * f[2] + f[3])
    return ca.Function("step", [x, u, p, w], [after]).mapaccum(count)


def _most_travel(model: Model, axis: str) -> float:
    """Where the simulation ends for an axis: at its stop, or after a turn by a radian."""
    angle = model.axes[axis].angle
    unit = model.states[model.state_index(angle)].unit
    return float(model.stops.get(angle, _FREE_TURN if unit == BENCH.travel_unit else np.inf))


def _positive(keys: Sequence[str], values: FloatArray, otherwise: float) -> dict[str, float]:
    return {key: float(v) if v > 0 else otherwise for key, v in zip(keys, values, strict=True)}


def port_scale(model: Model, *, axis: str = "", input: str = "", output: str = "") -> PortScale:
    """What is large at an axis, an input or an output of a model, and in which units."""
    scale = BENCH
    if not model.bench_sizes and model.sample_time is None:
        scales = scales_of(model)
        scale = PortScale(
            scales.forces.get(axis, BENCH.force),
            scales.travels.get(axis or output, BENCH.travel),
            scales.time,
            scales.inputs.get(input, BENCH.input),
        )
    if axis:
        moment = model.disturbances[moment_index(model, axis)].unit
        angle = model.states[model.state_index(axis_of(model, axis).angle)].unit
        return scale._replace(force_unit=moment, travel_unit=angle)
    if output:
        return scale._replace(travel_unit=_signal(model.outputs, output).unit)
    return scale._replace(input_unit=_signal(model.inputs, input).unit) if input else scale


def _signal(signals: Sequence[Signal], name: str) -> Signal:
    return signals[index_of(signals, name, "a signal of the model")]


def at_port(parameter: Parameter, scale: PortScale, upper: float | None = None) -> Parameter:
    """A size stated for small benches (in N m, rad, s, V and their powers) as it is at a port.

    Unit, typical range and bounds are the port's own, ``upper`` is a nearer bound in any case. A
    value that is not given, NaN, becomes the middle of the range.
    """
    ratio = 1.0
    for sign, unit, power in _FACTOR.findall(parameter.unit):
        ratio *= _ratio(scale, unit) ** ((-1 if sign == "/" else 1) * int(power or 1))
    typical = parameter.typical
    if typical is not None and ratio != 1.0:
        low, high = (float(f"{end * ratio:.2g}") for end in typical)
        typical = (low, high)
    highest = parameter.upper * ratio if upper is None else upper
    if typical is not None and typical[1] > highest:
        typical = (min(typical[0], highest / 2), highest)
    value = parameter.value
    if math.isnan(value):
        low, high = typical or (0.0, 0.0)
        value = float(f"{math.sqrt(low * high) if low > 0 else high:.2g}")
    return replace(
        parameter,
        value=value,
        unit=unit_at_port(parameter.unit, scale),
        typical=typical,
        lower=parameter.lower * ratio,
        upper=highest,
    )


def unit_at_port(unit: str, scale: PortScale) -> str:
    """The unit with the port's own in the place of N*m, rad and V."""
    own = {"N*m": scale.force_unit, "rad": scale.travel_unit, "V": scale.input_unit}
    return _FACTOR.sub(lambda m: m[1] + own.get(m[2], m[2]) + (f"^{m[3]}" if m[3] else ""), unit)


def _ratio(scale: PortScale, unit: str) -> float:
    ratios = {
        "N*m": scale.force / BENCH.force,
        "rad": scale.travel / BENCH.travel,
        "s": scale.time / BENCH.time,
        "Hz": BENCH.time / scale.time,
        "V": scale.input / BENCH.input,
    }
    return ratios.get(unit, 1.0)


#: Logarithm of the factor by which deviations grow over the longest run.
_MOST_GROWTH = 3.5


@lru_cache(maxsize=64)
def longest_run(model: Model) -> float:
    """s, that a free run from an estimated start lasts until it says nothing of the model.

    Until deviations have grown by the factor e^3.5, by the fastest unstable pole at rest: infinite
    for a model that does not fall over. Benches with two rotors, whose slowest oscillations at
    times grow by a little, have none either.
    """
    if model.bench_sizes or model.sample_time is not None:
        return math.inf
    model = model.without_effects()
    x, u, p, w = model.symbols()
    slope = ca.Function("slope", [x, u, p, w], [ca.jacobian(model.dynamics(x, u, p, w), x)])
    zero = np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w)
    poles = np.linalg.eigvals(np.array(slope(model.rest(), *zero)))
    growth = float(poles.real.max(initial=0.0))
    return _MOST_GROWTH / growth if growth > _STILL else math.inf
