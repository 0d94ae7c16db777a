"""Trains the networks that travel with the program and writes them into ``configs/networks``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from experiments.chapter3.methods import method, option
from experiments.chapter3.recordings import cut_at_stops, recording
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.identification.blackbox.prediction_error import free_run, rms, sample_signals
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FitProblem, Progress
from trms_cli.models.narx_file import NarxFile, write_narx_file
from trms_cli.models.network import NarxStructure, Network

SETTINGS = Path(__file__).with_name("networks.yaml")
#: s, horizons of the errors that are written into the file.
_HORIZONS = (1.0, 4.0, 20.0)
COMMAND = "python -m experiments.chapter3 networks"


def settings() -> dict[str, Any]:
    """What is trained, and how."""
    return dict(yaml.safe_load(SETTINGS.read_text(encoding="utf-8")))


def train_network(name: str, progress: Progress) -> NarxFile:
    """Record the simulated rig and train one of the networks of :data:`SETTINGS`."""
    common = settings()
    own = common["networks"][name]
    model = build(option("model", own["model"]), "model")

    def pieces(seed: int, duration: float) -> list[Dataset]:
        whole = recording(
            own["model"],
            own["excitation"],
            duration=duration,
            sample_time=common["sample_time"],
            seed=seed,
            name=f"{name} {seed}",
        )
        return cut_at_stops(whole, model.stops, common["shortest"])

    seed = int(common["seed"])
    fitted = [
        piece for i in range(own["recordings"]) for piece in pieces(seed + i, own["duration"])
    ]
    validation = pieces(seed + 100, own["held_out"])
    test = pieces(seed + 200, own["held_out"])
    method_options = {**common["method"], **own["method"]}
    fit = method("nnoe", method_options.pop("training", "lm"), method_options)
    problem = FitProblem(
        model=model, datasets=tuple(fitted), validation=tuple(validation), seed=seed
    )
    result = fit.fit(problem, progress)
    document = result.model_document
    assert document is not None
    structure = NarxStructure.from_data(document["structure"])
    network = Network.from_data(document["network"])
    errors = {
        f"{horizon:g} s": window_errors(structure, network, test, horizon, fit.regressors.smoothing)
        for horizon in _HORIZONS
    }
    seconds = sum(len(piece) for piece in fitted) * common["sample_time"]
    return NarxFile(
        name=name,
        structure=structure,
        network=network,
        limits=document["limits"],
        source=f"{COMMAND}: {seconds:.0f} s of the simulated rig {own['model']} with the bench's "
        "sensors",
        rig=own["model"],
        training={**_rounded(document["training"]), "free_run_rms": errors},
    )


def window_errors(
    structure: NarxStructure,
    network: Network,
    datasets: list[Dataset],
    horizon: float,
    smoothing: float,
) -> dict[str, float]:
    """RMS error of each output over free runs of a length (s), three digits, in its unit."""
    steps, first = round(horizon / structure.sample_time), structure.longest_lag
    past, inputs, measured = [], [], []
    for dataset in datasets:
        raw, smooth = (sample_signals(dataset, structure, window) for window in (0.0, smoothing))
        for start in range(first, len(raw) - steps + 1, steps):
            past.append(smooth.outputs[start - first : start])
            inputs.append(raw.inputs[start - first : start + steps])
            measured.append(raw.outputs[start : start + steps])
    if not past:
        return {}
    run = free_run(structure, network, np.stack(past, axis=1), np.stack(inputs, axis=1))
    errors = rms((run - np.stack(measured, axis=1)).reshape(-1, run.shape[2]))
    return {
        name: float(f"{error:.3g}") for name, error in zip(structure.outputs, errors, strict=True)
    }


def write_network(content: NarxFile) -> Path:
    """Put a network where the program finds it by its name."""
    path = config_folder() / "networks" / f"{content.name}.yaml"
    path.parent.mkdir(exist_ok=True)
    write_narx_file(path, content)
    text = path.read_text(encoding="utf-8")
    path.write_text(f"# {_heading(content)}\n{text}", encoding="utf-8")
    return path


def _heading(content: NarxFile) -> str:
    axes = {"newtonian_horizontal": "1 DOF yaw", "newtonian_vertical": "1 DOF pitch"}
    return f"NARX network of the simulated rig, {axes.get(content.rig, '2 DOF')}; made by {COMMAND}"


def _rounded(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record of a training without its times: equal trainings give equal files."""
    stages = [{k: v for k, v in stage.items() if k != "seconds"} for stage in record["stages"]]
    return {**record, "stages": stages}
