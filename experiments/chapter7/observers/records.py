"""A record of a simulated rig, and every observer's errors on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.chapter7.observers.study import Job, Study
from trms_cli.core.plugins import build
from trms_cli.models.model import names
from trms_cli.observers.observer import ObserverSetup
from trms_cli.plants.plant import PlantRun
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History

FloatArray = npt.NDArray[np.float64]
#: States whose errors are told, as the thesis's figures have them.
STATES = ("alpha_h", "alpha_v", "omega_h", "omega_v", "S_h", "S_v")
_BATCH = 100  #: samples of which the quickest batch is a step's time


@dataclass(frozen=True)
class Record:
    """What a rig was told, showed and did."""

    experiment: Experiment
    commands: FloatArray  #: (n, n_u) array; in force since the sample before
    measurements: FloatArray  #: (n, n_y) array
    truth: FloatArray  #: (n, n_x) array; of the model's states
    outputs: tuple[str, ...]
    noise_sd: dict[str, float]


@dataclass
class Outcome:
    """What became of a job."""

    job: Job
    #: RMSE by (channels, torques), observer and state
    errors: dict[tuple[str, str], dict[str, dict[str, float]]] = field(default_factory=dict)
    #: Of a step, by (channels, torques) and observer: the quickest batch of 100
    microseconds: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)
    problem: str = ""  #: Why there is no record


def run_job(study: Study, job: Job) -> Outcome:
    """Make the record and give it to every observer."""
    outcome = Outcome(job)
    try:
        record = make_record(job.overrides)
        for torques in job.torques:
            for name, channels in study.channels.items():
                errors, times = {}, {}
                for observer in study.observers:
                    errors[observer], times[observer] = judge(
                        observer_of(observer, torques), record, channels, study.transient
                    )
                outcome.errors[name, torques] = errors
                outcome.microseconds[name, torques] = times
    except Exception as error:  # a failing rig must not hide the others
        outcome.problem = f"{type(error).__name__}: {error}"
    return outcome


def make_record(overrides: Sequence[str]) -> Record:
    """Close the loop in memory, as ``trms run`` would."""
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks.experiment import experiment_of, topics_of

    loop_setup = experiment_of(compose(list(overrides)).config)
    rigs: list[PlantRun] = []

    def make_history(plant: PlantRun) -> History:
        rigs.append(plant)
        topics = topics_of(loop_setup, plant)
        return History({t.name: {f.name: f.unit for f in t.fields} for t in topics}, None)

    loop = Loop.start(loop_setup, make_history)
    loop.run()
    plant, history = rigs[0], loop.history

    def table(topic: str, column_names: Sequence[str]) -> FloatArray:
        columns = history.columns(topic)
        return np.stack([columns[name] for name in column_names], axis=1)

    outputs = names(plant.outputs)
    applied = table("/command", names(plant.inputs))
    return Record(
        loop_setup,
        np.vstack([plant.first_command, applied[:-1]]),
        table("/measurement", outputs),
        table("/plant/state", loop_setup.model.state_names),
        outputs,
        dict(plant.noise_sd),
    )


def observer_of(name: str, torques: str) -> Any:
    """An observer as its configuration has it."""
    from trms_cli.composition.composer import compose

    overrides = [f"observer={name}"]
    if torques == "none":
        overrides.append("observer.disturbances=[]")
    return build(compose(overrides).config["observer"], "observer")


def judge(
    observer: Any, record: Record, channels: Sequence[str], transient: float
) -> tuple[dict[str, float], float]:
    """RMSE of each state after the transient, and µs a step."""
    estimated, microseconds = estimates(observer, record, channels)
    begin = int(transient * len(estimated))
    error = np.sqrt(np.mean((estimated - record.truth)[begin:] ** 2, axis=0))
    rmse = dict(zip(record.experiment.model.state_names, error.tolist(), strict=True))
    return {name: rmse[name] for name in STATES}, microseconds


def estimates(observer: Any, record: Record, channels: Sequence[str]) -> tuple[FloatArray, float]:
    """What an observer makes of a record, (n, n_x), and µs a step: the quickest batch's."""
    outputs = tuple(name for name in record.outputs if name in channels)
    columns = [record.outputs.index(name) for name in outputs]
    measured = record.measurements[:, columns]
    model = record.experiment.model
    setup = ObserverSetup(
        model,
        record.experiment.sample_time,
        outputs,
        {name: record.noise_sd[name] for name in outputs},
        measured[0],
        record.commands[0],
    )
    state = observer.init(setup)
    estimated = np.empty_like(record.truth)
    stamps = [perf_counter()]
    for k, (u, y) in enumerate(zip(record.commands, measured, strict=True)):
        estimated[k] = observer.step(state, u, y, None).x
        if k % _BATCH == _BATCH - 1:
            stamps.append(perf_counter())
    return estimated, float(1e6 * np.min(np.diff(stamps)) / _BATCH)
