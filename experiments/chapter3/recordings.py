"""Recordings of the simulated bench rig: seeded commands in, measured angles and speeds out."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from experiments.chapter3.methods import option
from trms_cli.core.arrays import FloatArray
from trms_cli.core.plugins import build
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import names
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig

#: Multiples of it modulo 1 stay far from one another.
_GOLDEN = 0.6180339887498949

#: rad; nearer to a stop than this the beam is on it.
_NEAR = 0.01


def recording(
    model: str,
    excitation: Mapping[str, list[Mapping[str, Any]]],
    *,
    duration: float,
    sample_time: float,
    seed: int,
    name: str,
) -> Dataset:
    """Drive the simulated rig in open loop and record it with the sensors of a real bench.

    Parameters
    ----------
    model : str
        Option of ``configs/model``.
    excitation : dict of str to list of dict
        By input: signals (``_target_`` and their figures) of which the sum is the command; the
        recording's seed moves each signal's own ``seed`` or ``phase``. The sum is kept within
        the limits.
    duration, sample_time : float
        s.
    seed : int
        Of the commands and of the noise.
    """
    rig_model = build(option("model", model), "model")
    rig = SimulatedRig(model=rig_model, sensors=bench_sensors())
    n = round(duration / sample_time)
    run = rig.init(PlantSetup(sample_time, n, seed))
    time = np.arange(n, dtype=np.float64) * sample_time
    lower, upper = run.input_limits
    columns = []
    for number, signal in enumerate(run.inputs):
        parts = [_seeded(part, seed, number) for part in excitation[signal.name]]
        total = np.sum([build(part, "excitation").sample(time) for part in parts], axis=0)
        columns.append(np.clip(total, lower[number], upper[number]))
    commands = np.column_stack(columns)
    measurements = np.empty((n, len(run.outputs)))
    for k in range(n):
        measurements[k] = run.measure()
        run.advance(commands[k])
    return Dataset(
        name,
        f"simulated {model}",
        "",
        sample_time,
        time,
        run.inputs,
        run.outputs,
        commands,
        measurements,
        np.array([run.noise_sd[channel] for channel in names(run.outputs)]),
    )


def cut_at_stops(dataset: Dataset, stops: Mapping[str, float], shortest: float) -> list[Dataset]:
    """The pieces of a recording between the hits on the frame, those of ``shortest`` s or more.

    A hit is no part of the dynamics that a network is to learn, and what follows it in a window
    would be blamed on the weights.
    """
    free = np.ones(len(dataset), dtype=bool)
    for name, stop in stops.items():
        if name in names(dataset.outputs):
            free &= np.abs(dataset.output(name)) < stop - _NEAR
    edges = np.flatnonzero(np.diff(np.concatenate(([0], free.astype(int), [0]))))
    pieces = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if (last - first) * dataset.sample_time >= shortest:
            pieces.append(dataset.part(int(first), int(last)))
    return pieces


@cache
def bench_sensors() -> Sensors:
    """The sensors of the simulated rig's own configuration."""
    sensors = build(option("sensors", "bench"), "sensors")
    assert isinstance(sensors, Sensors)
    return sensors


def spans(datasets: list[Dataset]) -> dict[str, tuple[float, float]]:
    """Smallest and largest sample of each output."""
    values: FloatArray = np.vstack([dataset.measurements for dataset in datasets])
    return {
        name: (float(values[:, i].min()), float(values[:, i].max()))
        for i, name in enumerate(names(datasets[0].outputs))
    }


def _seeded(part: Mapping[str, Any], seed: int, number: int) -> dict[str, Any]:
    """A signal with its draws or its phase moved: another recording or input, another signal."""
    signal = dict(part)
    if "seed" in part:
        signal["seed"] = int(part["seed"]) + 1000 * seed + 100 * number
    if "phase" in part:
        signal["phase"] = float(part["phase"]) + _GOLDEN * (2 * seed + number) % 1.0
    return signal
