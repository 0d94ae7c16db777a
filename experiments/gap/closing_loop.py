"""Tracking of rigs that have an effect which the nominal model lacks, model by model.

Each rig is recorded in open loop, diagnosed from that recording, and then controlled by newton_mpc
and the UKF with the nominal model, the refitted one, the corrected one and the true one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.drivers import OpenLoop
from experiments.gap.driver import Loop, ModelBased, loop_of
from experiments.gap.models import (
    DIAGNOSED,
    KNOWN_CAUSE,
    NOMINAL,
    REFIT,
    TRUE,
    diagnose_recordings,
    identify_model,
)
from experiments.gap.rigs import Rig, drive_rigs, gentle_excitation, rig_of, write_csv
from trms_cli.effects.model_file import load_model
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

FloatArray = npt.NDArray[np.float64]
Report = Callable[[str], None]

RECORDING = "recording.csv"
AXES = ("pitch", "yaw")
#: s for which a reference has to stand still before an axis counts as settled.
_SETTLED_AFTER = 7.0
#: s, of the brakes before a recording.
_SETTLING = 20.0
#: Of noise and drift: of the recordings, and of the controlled runs.
_RECORDING_SEED, _RUN_SEED = 11, 12


@dataclass(frozen=True)
class Tracking:
    """One controlled run."""

    rig: str
    effect: str
    seed: int
    task: str
    model: str
    rmse: Mapping[str, float]  #: Measured angle less reference, by axis, rad
    #: The same where the reference stood still for some seconds, rad; NaN without such samples
    settled: Mapping[str, float]
    effort: Mapping[str, float]  #: Root mean square of the command, by axis, V
    #: Sum of the absolute changes of the command over time, by axis, V/s
    movement: Mapping[str, float]


@dataclass(frozen=True)
class Verdict:
    """What a diagnosis said of a rig."""

    rig: str
    effect: str
    verdict: str
    effects: tuple[str, ...]  #: The first cause
    probability: float  #: Of the first cause
    seconds: float  #: That the diagnosis took


@dataclass(frozen=True)
class Sizes:
    """How large an effect is."""

    rig: str
    effect: str
    own: Mapping[str, float]  #: The rig's, by the name of the size
    fitted: Mapping[str, Mapping[str, float]]  #: By model; without those that a model does not have


def rigs_of(study: Mapping[str, Any]) -> list[Rig]:
    """The rigs of the study."""
    return [
        rig_of(effect, sizes, seed, study["scatter"])
        for effect, sizes in study["effects"].items()
        for seed in study["seeds"]
    ]


def record(rigs: Sequence[Rig], study: Mapping[str, Any], out: Path, report: Report) -> None:
    """Recordings for the diagnosis, of all rigs at once; earlier ones are taken."""
    missing = [rig for rig in rigs if not (out / rig.name / RECORDING).exists()]
    if not missing:
        return
    report(f"recording {len(missing)} rigs")
    duration, step = study["record"]["duration"], study["record"]["sample_time"]
    commands = {s: gentle_excitation(s, duration, step) for s in {r.seed for r in missing}}
    driver = OpenLoop(np.stack([commands[rig.seed] for rig in missing]))
    recorded = drive_rigs(
        missing, driver, duration, step, among=rigs, settling=_SETTLING, seed=_RECORDING_SEED
    )
    for i, rig in enumerate(missing):
        (out / rig.name).mkdir(parents=True, exist_ok=True)
        write_csv(recorded, i, out / rig.name / RECORDING)


def diagnose(rig: Rig, words: Sequence[str], out: Path) -> Verdict:
    """Diagnose a rig from its recording; an earlier diagnosis is taken."""
    folder = diagnose_recordings([out / rig.name / RECORDING], out / rig.name / DIAGNOSED, words)
    return verdict_of(rig, folder)


def verdict_of(rig: Rig, folder: Path) -> Verdict:
    """What the diagnosis in a folder says."""
    document = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    first = document["causes"][0]
    return Verdict(
        rig.name,
        rig.effect,
        document["verdict"],
        tuple(first["effects"]),
        float(first["probability"]),
        float(sum((document.get("seconds") or {}).values())),
    )


def model_of(rig: Rig, model: str, out: Path) -> Model:
    """What a controller of the rig is given."""
    folder = out / rig.name
    if model == NOMINAL:
        return Newtonian()
    paths = {
        REFIT: lambda: identify_model(folder / RECORDING, folder / REFIT),
        DIAGNOSED: lambda: folder / DIAGNOSED / "corrected_model.yaml",
        KNOWN_CAUSE: lambda: identify_model(folder / RECORDING, folder / KNOWN_CAUSE, rig.effect),
        TRUE: lambda: rig.write_true_model(folder / "true_model.yaml"),
    }
    return load_model(str(paths[model]()))


def control(
    rigs: Sequence[Rig],
    tasks: Mapping[str, Sequence[str]],
    models: Sequence[str],
    study: Mapping[str, Any],
    out: Path,
    report: Report,
) -> list[Tracking]:
    """Control every rig in every task with every model; runs that are there already are taken."""
    every = rigs_of(study)
    return control_with(
        lambda rig, model: model_of(rig, model, out), rigs, tasks, models, study, out, report, every
    )


def control_with(
    chosen: Callable[[Rig, str], Model],
    rigs: Sequence[Rig],
    tasks: Mapping[str, Sequence[str]],
    models: Sequence[str],
    study: Mapping[str, Any],
    out: Path,
    report: Report,
    among: Sequence[Rig] = (),
) -> list[Tracking]:
    """:func:`control` with models that ``chosen`` gives, by their names.

    ``among``: all rigs that there are, of which those given are some; empty: those given.
    """
    runs = [(rig, task, model) for task in tasks for model in models for rig in rigs]
    missing = [run for run in runs if not _file(*run, out).exists()]
    if missing:
        loops = {task: loop_of(words) for task, words in tasks.items()}
        _control(chosen, missing, among or rigs, loops, study, out, report)
    return [Tracking(**json.loads(_file(*run, out).read_text(encoding="utf-8"))) for run in runs]


def _control(
    chosen: Callable[[Rig, str], Model],
    runs: Sequence[tuple[Rig, str, str]],
    among: Sequence[Rig],
    loops: Mapping[str, Loop],
    study: Mapping[str, Any],
    out: Path,
    report: Report,
) -> None:
    duration, step = study["run"]["duration"], study["record"]["sample_time"]
    report(f"making models and loops of {len(runs)} runs")
    models = {(rig.name, model): chosen(rig, model) for rig, _, model in runs}
    driver = ModelBased(
        [loops[task] for _, task, _ in runs],
        [models[rig.name, model] for rig, _, model in runs],
        round(duration / step),
        step,
    )
    report(f"{len(runs)} runs of {duration:g} s")
    rigs = [rig for rig, _, _ in runs]
    recorded = drive_rigs(rigs, driver, duration, step, among=among, seed=_RUN_SEED)
    for i, run in enumerate(runs):
        angles, commands = recorded.measured[i, :, :2], recorded.commands[i]
        references = driver.references[i]
        run_tracking = tracking(*run, references, angles, commands, step, study)
        file = _file(*run, out)
        file.parent.mkdir(parents=True, exist_ok=True)
        traces = {"time": recorded.time, "reference": references, "angle": angles}
        np.savez_compressed(file.with_suffix(".npz"), command=commands, **traces)
        file.write_text(json.dumps(asdict(run_tracking)), encoding="utf-8")


def tracking(
    rig: Rig,
    task: str,
    model: str,
    references: FloatArray,
    angles: FloatArray,
    commands: FloatArray,
    step: float,
    study: Mapping[str, Any],
) -> Tracking:
    """Figures of a run.

    ``references``, ``angles``: (n, 2) arrays; rad. ``commands``: (n, 2) array; V.
    """
    first, waited = round(study["run"]["from"] / step), round(_SETTLED_AFTER / step)
    error = angles - references
    counted = np.arange(len(error)) >= first
    rmse, settled, effort, movement = {}, {}, {}, {}
    for i, axis in enumerate(AXES):
        is_jump = np.diff(references[:, i], prepend=references[0, i]) != 0
        count = np.concatenate([np.zeros(waited), np.cumsum(is_jump)])
        still = counted & (count[waited:] == count[:-waited])
        rmse[axis] = _rms(error[counted, i])
        settled[axis] = _rms(error[still, i])
        effort[axis] = _rms(commands[counted, i])
        changed = float(np.abs(np.diff(commands[first:, i])).sum())
        movement[axis] = changed / (step * np.count_nonzero(counted))
    return Tracking(rig.name, rig.effect, rig.seed, task, model, rmse, settled, effort, movement)


def traces_of(rig: str, task: str, model: str, out: Path) -> dict[str, FloatArray]:
    """``time``, ``reference``, ``angle``, ``command`` of a run that was made."""
    with np.load(out / rig / f"{task}-{model}.npz") as archive:
        return {name: np.asarray(archive[name], dtype=float) for name in archive.files}


def sizes_of(rig: Rig, models: Sequence[str], out: Path) -> Sizes:
    """Sizes of the rig's effect in the fitted models of it, those that have the effect."""
    fitted_sizes: dict[str, dict[str, float]] = {}
    for model in models:
        if model in (KNOWN_CAUSE, DIAGNOSED):
            parameters = model_of(rig, model, out).parameters
            fitted_sizes[model] = {
                size: parameters[f"{rig.effect}.{size}"].value
                for size in rig.sizes
                if f"{rig.effect}.{size}" in parameters
            }
    return Sizes(rig.name, rig.effect, dict(rig.sizes), fitted_sizes)


def _file(rig: Rig, task: str, model: str, out: Path) -> Path:
    return out / rig.name / f"{task}-{model}.json"


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
