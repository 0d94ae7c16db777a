"""Scales of the states, inputs and disturbances of a model, for what is tuned by them.

Weights of a controller and noises of an observer are stated for small benches with two rotors. For
another model they hold in the proportion of :mod:`trms_cli.models.scales`: an error of a position
is worth what the same share of its travel is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.models.model import Model, names
from trms_cli.models.scales import BENCH, scales_of

#: Slopes below this are none.
_NO_SLOPE = 1e-12


@dataclass(frozen=True)
class StateScales:
    """What is large of each signal of a model, in its unit."""

    states: FloatArray  #: (n_x,)
    inputs: FloatArray  #: (n_u,); full command
    disturbances: FloatArray  #: (n_w,)
    time: float  #: s, of its dynamics
    growth: float = 0.0  #: 1/s, of what grows fastest by itself at rest; 0 where nothing does


@lru_cache(maxsize=32)
def state_scales(model: Model) -> StateScales:
    """Scales of a model: of each axis its travel, rate and force, of an output its travel.

    Other states have that of a signal of the same unit, or without one, the value at which they
    change what has a scale as fast as that is large; 1 where they change nothing. What has been
    added by effects does not change the scales of the others.
    """
    upper = model.input_bounds()[1]
    inputs = np.where(np.isfinite(upper) & (upper > 0), upper, 1.0)
    states, disturbances = np.full(model.n_x, np.nan), np.full(model.n_w, np.nan)
    for name, stop in model.stops.items():
        if name in model.state_names and np.isfinite(stop):
            states[model.state_index(name)] = stop
    if model.sample_time is not None:  # a step tells nothing of forces
        ones = np.ones(model.n_w)
        return StateScales(np.where(np.isnan(states), 1.0, states), inputs, ones, BENCH.time)
    scales = scales_of(model.without_effects())
    x, u, p, w = model.symbols()
    f = model.dynamics(x, u, p, w)
    slopes = ca.Function("slopes", [x, u, p, w], [ca.jacobian(f, x), ca.jacobian(f, w)])
    at = (model.rest(), np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))
    by_state, by_disturbance = (np.nan_to_num(np.array(slope)) for slope in slopes(*at))
    growth = max(0.0, float(np.linalg.eigvals(by_state).real.max()))
    by_state, by_disturbance = np.abs(by_state), np.abs(by_disturbance)
    for axis, place in model.axes.items():
        row = model.state_index(place.angle)
        states[row] = scales.travels[axis]
        for j in np.flatnonzero(by_state[row] > _NO_SLOPE):
            if j != row and np.isnan(states[j]):
                states[j] = states[row] / (scales.time * by_state[row, j])
        disturbances[names(model.disturbances).index(place.moment)] = scales.forces[axis]
    for i, state in enumerate(model.states):
        if np.isnan(states[i]):
            states[i] = scales.travels.get(state.name, np.nan)
    by_unit = dict(zip((s.unit for s in model.inputs), inputs, strict=True))
    for i, state in enumerate(model.states):
        if np.isnan(states[i]):
            states[i] = by_unit.get(state.unit, np.nan)
    reach = np.where(np.isnan(states), np.inf, states) / scales.time  # per s, of what has a scale
    for slopes_of, values in ((by_state, states), (by_disturbance, disturbances)):
        for j in np.flatnonzero(np.isnan(values)):
            rows = np.flatnonzero((slopes_of[:, j] > _NO_SLOPE) & np.isfinite(reach))
            values[j] = min(reach[rows] / slopes_of[rows, j], default=1.0)
    return StateScales(states, inputs, disturbances, scales.time, growth)


def bench_ratios(model: Model) -> StateScales:
    """Scales of a model over those of the rigs that the program's numbers are stated for.

    1 for each signal of such a rig itself.
    """
    if model.bench_sizes:
        return StateScales(np.ones(model.n_x), np.ones(model.n_u), np.ones(model.n_w), 1.0)
    scales = state_scales(model)
    return StateScales(
        scales.states / BENCH.travel,
        scales.inputs / BENCH.input,
        scales.disturbances / BENCH.force,
        scales.time / BENCH.time,
        scales.growth,
    )


def scale_of_state(model: Model, name: str) -> float:
    """How far a state goes, in its unit."""
    return float(state_scales(model).states[model.state_index(name)])
