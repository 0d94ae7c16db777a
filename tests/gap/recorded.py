"""Recordings of simulated rigs for the tests of the diagnosis: a model, effects, sensors' noise."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import yaml

from experiments.gap.blind.drivers import rich_excitation
from tests.identification.greybox.rigs import dataset_of, sensed
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extend_model
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

STEP = 0.02  # s


def effect(name: str, **sizes: float) -> Effect:
    """An effect of the library, at other sizes."""
    text = (config_folder() / "effect" / f"{name}.yaml").read_text(encoding="utf-8")
    made = build({**yaml.safe_load(text)[name], **sizes}, name)
    assert isinstance(made, Effect)
    return made


def recording(
    effects: Mapping[str, Effect] | None = None,
    *,
    model: Model | None = None,
    values: Mapping[str, float] | None = None,
    seconds: float = 40.0,
    seed: int = 1,
    outputs: tuple[str, ...] | None = None,
) -> Dataset:
    """What a rig records in open loop, its sensors as those of the bench."""
    nominal = model or Newtonian()
    rig = extend_model(nominal, dict(effects or {}))
    if values:
        rig.parameters = rig.parameters.replaced(dict(values))
    count = round(seconds / STEP)
    settling = round(10.0 / STEP)
    commands = 0.7 * rich_excitation([seed], count, STEP)[0]
    commands[:, 0] += 0.35
    commands = commands[:, : nominal.n_u]
    held = np.repeat(commands[:1], settling, axis=0)
    rollout = Rollout(rig, STEP)
    start = rollout.initial(rig.rest(), commands[0])
    y = rollout.outputs(np.vstack([held, commands]), [0], [settling + count], start[None]).y
    measured, sd = sensed(rig, y[settling:], np.random.default_rng(seed))
    whole = dataset_of(rig, np.ascontiguousarray(commands), measured, sd, step=STEP)
    kept = [i for i, s in enumerate(rig.outputs) if outputs is None or s.name in outputs]
    return replace(
        whole,
        outputs=tuple(rig.outputs[i] for i in kept),
        measurements=np.ascontiguousarray(measured[:, kept]),
        noise_sd=sd[kept],
    )


def coloured(rng: np.random.Generator, samples: int, time: float) -> np.ndarray:
    """Noise of variance one that forgets itself over ``time`` [s]."""
    keep = np.exp(-STEP / time)
    noise = rng.normal(size=samples) * np.sqrt(1 - keep**2)
    result = np.empty(samples)
    result[0] = rng.normal()
    for i in range(1, samples):
        result[i] = keep * result[i - 1] + noise[i]
    return result
