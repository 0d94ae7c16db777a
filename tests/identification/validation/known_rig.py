"""Rigs whose truth is known: recordings that a model made, sensors and all."""

from functools import cache

import numpy as np

from tests.identification.greybox import rigs
from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, names
from trms_cli.simulation.rollout import Rollout

QUANTUM = {"alpha_v": rigs.QUANTUM, "alpha_h": rigs.QUANTUM, "omega_v": 0.49, "omega_h": 0.49}
WHITE = {"alpha_v": 0.0, "alpha_h": 0.0, "omega_v": 1.6, "omega_h": 1.6}
_rollout = cache(Rollout)


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
    n = round(seconds / rigs.SAMPLE)
    middle = {"u_v": 1.3, "u_h": 0.0}
    swing = {"u_v": 0.3, "u_h": 0.6}
    commands = np.column_stack(
        [
            np.repeat(middle[u] + swing[u] * rng.uniform(-1, 1, n // 100 + 1), 100)[:n]
            for u in names(rig.inputs)
        ]
    )
    y = _rollout(rig, rigs.SAMPLE).outputs(commands, [0], [n], rig.rest()[None]).y
    quantum = np.array([QUANTUM[name] for name in names(rig.outputs)])
    white = np.array([WHITE[name] for name in names(rig.outputs)])
    y = np.round((y + white * rng.standard_normal(y.shape)) / quantum) * quantum
    return rigs.dataset_of(rig, commands, y, np.hypot(white, quantum / np.sqrt(12)))
