"""Recordings of small simulated rigs for these tests."""

from dataclasses import replace

import numpy as np

from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.simulation.rollout import Rollout

SAMPLE = 0.02  # s
QUANTUM = 2 * np.pi / 4096  # rad
TACHO_NOISE = 1.6  # rad/s


def levels(seed: int, samples: int, ranges: list[tuple[float, float]]) -> np.ndarray:
    """Commands held for one to two seconds."""
    generator = np.random.default_rng(seed)
    u = np.empty((samples, len(ranges)))
    for i, (low, high) in enumerate(ranges):
        k = 0
        while k < samples:
            hold = int(generator.integers(50, 100))
            u[k : k + hold, i] = generator.uniform(low, high)
            k += hold
    return u


def sensed(
    model: Model, y: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Angles counted by an encoder, speeds with a tacho's noise, and what is declared of both."""
    measured, sd = y.copy(), np.empty(y.shape[1])
    for i, signal in enumerate(model.outputs):
        if signal.unit == "rad":
            sd[i] = QUANTUM / 12**0.5
            measured[:, i] = np.round(y[:, i] / QUANTUM) * QUANTUM
        else:
            sd[i] = TACHO_NOISE
            measured[:, i] += TACHO_NOISE * generator.standard_normal(len(y))
    return measured, sd


def dataset_of(
    model: Model,
    commands: np.ndarray,
    measured: np.ndarray,
    sd: np.ndarray,
    *,
    step: float = SAMPLE,
    name: str = "rig",
) -> Dataset:
    """A recording of all inputs and outputs of a model."""
    time = step * np.arange(len(commands))
    return Dataset(
        name, f"{name}.csv", "0" * 64, step, time, model.inputs, model.outputs, commands, measured,
        sd,
    )  # fmt: skip


def measuring(dataset: Dataset, outputs: int) -> Dataset:
    """The same recording with only so many of its outputs."""
    return replace(
        dataset,
        outputs=dataset.outputs[:outputs],
        measurements=dataset.measurements[:, :outputs].copy(),
        noise_sd=dataset.noise_sd[:outputs],
    )


def recording(
    model: Model,
    *,
    seed: int = 0,
    seconds: float = 20.0,
    ranges: list[tuple[float, float]],
    substeps: int = 4,
    feedback: float = 0.0,
) -> tuple[Dataset, np.ndarray]:
    """A dataset of the model with its present parameters, and the true states (n, n_x).

    With ``feedback`` (V/rad) the measured first angle is fed back to the first command.
    """
    samples = round(seconds / SAMPLE)
    u = levels(seed, samples, ranges)
    rollout = Rollout(model, SAMPLE, substeps=substeps)
    x, states, y = rollout.initial(model.rest(), u[0]), [], []
    for k in range(samples):
        states.append(x[: model.n_x].copy())
        angle = rollout.outputs(u, [k], [1], x[None]).y[0, 0] if feedback else 0.0
        u[k, 0] -= feedback * np.round(angle / QUANTUM) * QUANTUM
        found = rollout.outputs(u, [k], [1], x[None])
        y.append(found.y[0])
        x = found.ends[0]
    measured, sd = sensed(model, np.array(y), np.random.default_rng(seed + 1))
    return dataset_of(model, u, measured, sd, name=f"rig{seed}"), np.array(states)
