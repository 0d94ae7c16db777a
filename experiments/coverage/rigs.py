"""Simulated rigs with hidden parameters, and a recording of each."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.parameters import ParameterSet
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.plants.simulated import SimulatedRig

FloatArray = npt.NDArray[np.float64]

#: The bench's encoders (rad) and tachos (rad/s).
ENCODER_QUANTUM, TACHO_QUANTUM, TACHO_NOISE = 2 * math.pi / 4096, 0.49, 1.6
#: V; range of the commands, and how long each is held, s. Pitch stays off its stops.
COMMANDS = {"u_v": (0.3, 1.5), "u_h": (-0.7, 0.7)}
HOLD = (0.5, 4.0)
#: s, integration step of the rig; the fitted model takes steps of a whole sample.
RIG_STEP = 0.005


class RigRecording(NamedTuple):
    """A recording with what is hidden behind it."""

    dataset: Dataset
    truth: ParameterSet
    travel: float  #: Largest share of the range of any angle that was used; near 1 a stop was hit


def record_rig(model: Model, seed: int, duration: float, sample_time: float = 0.02) -> RigRecording:
    """A rig drawn from the priors, excited by random levels and measured by noisy sensors.

    Parameters
    ----------
    model : Model
        Its parameters' priors are what the rig is drawn from.
    seed : int
        Of the draw, the excitation and the noise.
    duration, sample_time : float
        s.
    """
    angles = [s.name for s in model.outputs if s.unit == "rad"]
    rotors = [s.name for s in model.outputs if s.unit == "rad/s"]
    rig = SimulatedRig(
        model=model,
        prior_seed=seed,
        integration_step=RIG_STEP,
        sensors=Sensors(
            noise_sd=dict.fromkeys(rotors, TACHO_NOISE),
            quantum=dict.fromkeys(angles, ENCODER_QUANTUM) | dict.fromkeys(rotors, TACHO_QUANTUM),
        ),
    )
    samples = round(duration / sample_time)
    run = rig.init(PlantSetup(sample_time=sample_time, samples=samples, seed=seed))
    commands = excitation(model, seed, samples, sample_time)
    measured, travel = np.empty((samples, model.n_y)), 0.0
    limits = {model.state_index(name): model.stops[name] for name in angles}
    for k in range(samples):
        measured[k] = run.measure()
        run.advance(commands[k])
        travel = max(travel, *(abs(run.state[i]) / stop for i, stop in limits.items()))
    dataset = Dataset(
        f"rig_{seed}",
        f"rig_{seed}",
        "",
        sample_time,
        np.arange(samples, dtype=np.float64) * sample_time,
        model.inputs,
        model.outputs,
        commands,
        measured,
        np.array([run.noise_sd[s.name] for s in model.outputs]),
    )
    return RigRecording(dataset, run.parameters, travel)


def excitation(model: Model, seed: int, samples: int, sample_time: float) -> FloatArray:
    """Levels drawn anew after random times, for each input by itself, shape (samples, n_u)."""
    generator = np.random.default_rng(np.random.SeedSequence([seed, 0xE8C1]))
    commands = np.empty((samples, model.n_u))
    for i, signal in enumerate(model.inputs):
        k = 0
        while k < samples:
            hold = max(1, round(generator.uniform(*HOLD) / sample_time))
            commands[k : k + hold, i] = generator.uniform(*COMMANDS[signal.name])
            k += hold
    return commands
