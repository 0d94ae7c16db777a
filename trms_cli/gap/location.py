"""Where the gap lies: one generalised disturbance at a time on every equation and sensor.

Each place in turn may err as much as is most likely, all others only as much as those of rigs
without a gap; the share of the likelihood that a place gains, of what all of them together gain,
is its share of the gap. Places that move the same equation alike (a drive and its motor, a thrust
and the moment that it makes) have one disturbance; which of them it is follows from the causes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.discrepancy import (
    Discrepancy,
    likely_shares,
    log_likelihood,
    sensor_channels,
    usual_channels,
)
from trms_cli.gap.fitting import FittedModel
from trms_cli.gap.force.laws import ForceRecord
from trms_cli.models.model import Model, names

#: A sensor of a rig without a gap errs by this share of what it reads.
_SENSOR_FLOOR = 1e-4
#: Size at which the search for a disturbance begins, and how often it is improved.
_FIRST, _FIRST_OF_SENSORS, _ITERATIONS = 0.1, 0.01, 4


@dataclass(frozen=True)
class Location:
    """What each place closes of the gap."""

    locations: tuple[str, ...]
    gains: FloatArray  #: (k, m) array; nats by which each place raises the likelihood of each block
    together: FloatArray  #: (m,) array; the same of all places

    def share(self, blocks: IntArray | None = None) -> dict[str, float]:
        """Share of the gap by place, from some blocks (with repetition); None: from all."""
        chosen = slice(None) if blocks is None else blocks
        total = max(float(self.together[chosen].sum()), 1e-9)
        gains = np.clip(self.gains[:, chosen].sum(axis=1) / total, 0.0, 1.0)
        return dict(zip(self.locations, gains.tolist(), strict=True))


def locate(nominal: FittedModel, usual: Mapping[str, float]) -> Location:
    """Try every equation and every measured sensor.

    ``usual``: share by which each equation errs on rigs without a gap.
    """
    model, windows = nominal.structure.problem.model, nominal.structure.windows
    channels = (*usual_channels(model), *sensor_channels(model, windows.measured))
    every = replace(nominal.metric.discrepancy, channels=channels)
    sensors = np.array([channel.kind == "output" for channel in channels])
    equations = [usual.get(channel.location, 0.03) for channel in channels]
    floor = np.where(sensors, _SENSOR_FLOOR, equations)
    begins = np.maximum(floor, np.where(sensors, _FIRST_OF_SENSORS, _FIRST))
    r = nominal.residuals
    none = log_likelihood(every, r, floor)
    gains, shares = [], []
    tried = [i for i in range(len(channels)) if channels[i].fixed is None]
    for i in tried:
        moving = np.arange(len(channels)) == i
        first = np.where(moving, begins, floor)
        found = likely_shares(every, r, first, moving=moving, iterations=_ITERATIONS, least=floor)
        gains.append(log_likelihood(every, r, found) - none)
        shares.append(found[i])
    start = floor.copy()
    start[tried] = np.maximum(floor[tried], 0.7 * np.array(shares))
    both = likely_shares(every, r, start, iterations=_ITERATIONS, least=floor)
    together = log_likelihood(every, r, both) - none
    return Location(tuple(channels[i].location for i in tried), np.array(gains), together)


def smoothed_forces(refit: FittedModel, entry: FittedModel) -> dict[str, ForceRecord]:
    """The force that each nominal equation lacks beside a fit, read by a smoother from the rest.

    In the nominal model's states, along the motion of the refit, with its discrepancy's sizes.
    """
    structure, along = entry.structure, refit.metric.discrepancy
    model, windows = structure.problem.model, structure.windows
    discrepancy = Discrepancy(refit.structure.windows, along.trajectory, along.channels)
    x, variance = discrepancy.smoothed(refit.metric.shares, entry.residuals)
    n = discrepancy.trajectory.x.shape[-1]
    inside = windows.inside
    states = discrepancy.trajectory.x[..., : model.n_x]
    time = windows.first[:, None] * windows.sample_time + windows.sample_time * np.arange(
        inside.shape[1]
    )
    starts = np.cumsum([0, *(len(d) for d in structure.problem.datasets)])
    recording = np.searchsorted(starts, windows.first, side="right") - 1
    motion = _motion(model, states, windows.commands, windows.sample_time)
    records = {}
    for i, channel in enumerate(discrepancy.channels):
        if channel.kind != "disturbance":
            continue
        records[channel.location] = ForceRecord(
            location=channel.location,
            unit=channel.unit,
            time=time[inside]
            - starts[recording][:, None].repeat(inside.shape[1], 1)[inside] * windows.sample_time,
            recording=np.broadcast_to(recording[:, None], inside.shape)[inside],
            force=x[..., n + i][inside],
            sd=np.sqrt(variance[..., n + i][inside]),
            **{kind: {k: v[inside] for k, v in group.items()} for kind, group in motion.items()},
        )
    return records


def _motion(
    model: Model, states: FloatArray, commands: FloatArray, sample_time: float
) -> dict[str, dict[str, FloatArray]]:
    """Angles, rates, speeds and commands by the names that a force record has."""
    from trms_cli.models.dry_friction import SPEEDS

    angles, rates = {}, {}
    for name, axis in model.axes.items():
        angles[name] = states[..., model.state_index(axis.angle)]
        rates[name] = np.gradient(angles[name], sample_time, axis=1)
    inputs = names(model.inputs)
    speeds = {
        rotor: states[..., model.state_index(SPEEDS[rotor])]
        for rotor in model.rotors
        if SPEEDS.get(rotor) in model.state_names
    }
    of_rotors = {rotor: commands[..., inputs.index(name)] for rotor, name in model.rotors.items()}
    return {"angles": angles, "rates": rates, "speeds": speeds, "commands": of_rotors}
