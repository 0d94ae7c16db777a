"""Synthetic rigs to train on: drawn from the priors, one effect each, simulated by the library."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.gap.baselines.fits import is_size, nominal_free
from experiments.gap.baselines.marks import marks
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extended
from trms_cli.identification.dataset import Dataset, FloatArray
from trms_cli.models.model import Model, index_of
from trms_cli.models.parameters import Parameter
from trms_cli.models.rest import resting_state
from trms_cli.simulation.rollout import Rollout

#: s, of a training recording, and what is left out at its beginning.
_DURATION, _SETTLING = 40.0, 3.0
#: Share of a command's limit about which it moves, and by which, by rotor.
_CENTRE, _SWING = {"main": 0.5, "tail": 0.0}, {"main": 0.18, "tail": 0.36}
#: Hz and s: lines of the waves, holding times of the levels.
_BAND, _LINES, _HOLD = (0.02, 1.2), 24, (1.0, 5.0)
#: Encoder's and tacho's quanta and the tacho's noise, as the bench declares them.
_ENCODER, _TACHO, _TACHO_NOISE = 2 * np.pi / 4096, 0.49, 1.6
#: rad. A rig that swings farther is none.
_FARTHEST = 2.5
_FARTHEST_SD = 2.5


@dataclass(frozen=True)
class Request:
    """Rigs of one class."""

    model: Model  #: The nominal one
    name: str
    effect: Effect | None
    outputs: tuple[str, ...]
    sample_time: float  #: s
    count: int
    seed: int


def rigs(request: Request) -> FloatArray:
    """Marks of the rigs of a class, (up to count, n); a rig that ran away is left out."""
    model = request.model
    rig = model if request.effect is None else extended(model, {request.name: request.effect})
    rollout = Rollout(rig, request.sample_time)
    random = np.random.default_rng(np.random.SeedSequence([0xC1A5, request.seed]))
    rows = []
    for _ in range(request.count):
        dataset = _recorded(request, rig, rollout, random)
        if dataset is not None:
            rows.append(marks(model, [dataset], 10.0))
    return np.array(rows)


def _recorded(
    request: Request, rig: Model, rollout: Rollout, random: np.random.Generator
) -> Dataset | None:
    model, step = request.model, request.sample_time
    skipped = round(_SETTLING / step)
    u = _commands(model, round(_DURATION / step) + skipped, step, random)
    p = _drawn(rig, random)
    start = rollout.initial(resting_state(rig, {}, u[0]), u[0])
    with np.errstate(all="ignore"):
        y = rollout.outputs(u, [0], [len(u)], start[None], p).y[skipped:]
    columns = [index_of(model.outputs, name, "an output") for name in request.outputs]
    y, outputs, sd = y[:, columns], tuple(model.outputs[i] for i in columns), []
    for i, signal in enumerate(outputs):
        if not np.isfinite(y[:, i]).all():
            return None
        if signal.unit == "rad":
            if np.abs(y[:, i]).max() > _FARTHEST:
                return None
            quantum, noise = _ENCODER, 0.0
        else:
            quantum, noise = _TACHO, _TACHO_NOISE
        y[:, i] = quantum * np.round((y[:, i] + noise * random.standard_normal(len(y))) / quantum)
        sd.append(float(np.hypot(noise, quantum / 12**0.5)))
    commands = np.ascontiguousarray(u[skipped:])
    time: FloatArray = step * np.arange(len(y), dtype=float)
    return Dataset(
        "synthetic", "", "0" * 64, step, time, model.inputs, outputs, commands, y, np.array(sd)
    )


def _commands(model: Model, samples: int, step: float, random: np.random.Generator) -> FloatArray:
    """Sums of sines with held random levels, within the limits."""
    time, columns = step * np.arange(samples), []
    for signal in model.inputs:
        rotor = next((r for r, name in model.rotors.items() if name == signal.name), "tail")
        limit = model.input_limits[signal.name]
        lines = np.exp(random.uniform(np.log(_BAND[0]), np.log(_BAND[1]), _LINES))
        phases = random.uniform(0, 2 * np.pi, _LINES)
        waves = np.sin(2 * np.pi * np.outer(time, lines) + phases).sum(axis=1)
        waves /= np.sqrt(_LINES / 2)
        levels, at = np.empty(samples), 0
        while at < samples:
            hold = max(1, round(random.uniform(*_HOLD) / step))
            levels[at : at + hold] = random.uniform(-1, 1)
            at += hold
        swing = _SWING.get(rotor, 0.3) * random.uniform(0.6, 1.1)
        centre = _CENTRE.get(rotor, 0.0) * random.uniform(0.95, 1.05)
        u = centre + 0.5 * swing * (waves + levels)
        columns.append(limit * np.clip(u, -1, 1))
    return np.stack(columns, axis=1)


def _drawn(rig: Model, random: np.random.Generator) -> FloatArray:
    """All parameters of a rig: the nominal ones from their priors, sizes from their ranges."""
    p, order = rig.parameters.values, rig.parameters.names
    scatter = random.uniform(0.0, 1.0)
    for free in nominal_free(rig):
        z = np.clip(random.standard_normal(), -_FARTHEST_SD, _FARTHEST_SD)
        value = free.prior_mean + scatter * free.scale * z
        p[order.index(free.name)] = np.clip(value, free.lower, free.upper)
    for parameter in rig.parameters:
        if is_size(parameter.name) and parameter.prior_sd is None:
            p[order.index(parameter.name)] = _size(parameter, random)
    return p


def _size(parameter: Parameter, random: np.random.Generator) -> float:
    """Over its typical range: by factors where it has one sign, evenly where it has two."""
    if parameter.typical is None:
        return parameter.value * float(np.exp(random.uniform(-1, 1)))
    low, high = parameter.typical
    if low > 0:
        value = float(np.exp(random.uniform(np.log(low), np.log(high))))
    else:
        value = float(random.uniform(low, high))
    return float(np.clip(value, parameter.lower, parameter.upper))
