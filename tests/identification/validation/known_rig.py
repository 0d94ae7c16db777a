"""Rigs whose truth is known: recordings that a model made, sensors and all."""

from functools import cache

import numpy as np

from tests.identification.greybox.rigs import dataset_of
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, names
from trms_cli.simulation.rollout import Rollout

SAMPLE_TIME = 0.02
QUANTUM = {
    "alpha_v": 2 * np.pi / 4096,
    "alpha_h": 2 * np.pi / 4096,
    "omega_v": 0.49,
    "omega_h": 0.49,
}
WHITE = {"alpha_v": 0.0, "alpha_h": 0.0, "omega_v": 1.6, "omega_h": 1.6}


def model(name: str = "newtonian", **factors: float) -> Model:
    """A built-in model, some of its parameters multiplied."""
    node = dict(read_yaml(config_folder() / f"model/{name}.yaml"))
    node.pop("defaults", None)
    if factors:
        known = build(node, "model").parameters
        node["parameters"] = {key: factor * known[key].value for key, factor in factors.items()}
    return build(node, "model")


def recording(rig: Model, seconds: float = 40.0, seed: int = 0) -> Dataset:
    """A recording of a rig in open loop: random levels, held for two seconds each."""
    rng = np.random.default_rng(seed)
    n = round(seconds / SAMPLE_TIME)
    middle = {"u_v": 1.3, "u_h": 0.0}
    swing = {"u_v": 0.3, "u_h": 0.6}
    commands = np.column_stack(
        [
            np.repeat(middle[u] + swing[u] * rng.uniform(-1, 1, n // 100 + 1), 100)[:n]
            for u in names(rig.inputs)
        ]
    )
    y = _rollout(rig).outputs(commands, [0], [n], rig.rest()[None]).y
    quantum = np.array([QUANTUM[name] for name in names(rig.outputs)])
    white = np.array([WHITE[name] for name in names(rig.outputs)])
    y = np.round((y + white * rng.standard_normal(y.shape)) / quantum) * quantum
    return dataset_of(rig, commands, y, np.hypot(white, quantum / np.sqrt(12)), step=SAMPLE_TIME)


@cache
def _rollout(rig: Model) -> Rollout:
    return Rollout(rig, SAMPLE_TIME)
