"""The advised experiment at work: a pair that a first recording confuses, and the second one.

A rig is recorded with slow sines and diagnosed. What the diagnosis advises to record next, a
command of this program, is made into commands and played to the rig; both recordings are diagnosed
together.
"""

from __future__ import annotations

import contextlib
import io
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.drivers import MAIN_CENTRE, OpenLoop
from experiments.gap.closing_loop import RECORDING, Report
from experiments.gap.models import diagnose_recordings
from experiments.gap.rigs import INPUTS, Rig, drive_rigs, rig_of, write_csv
from trms_cli.core.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]

#: Of noise and drift, in the first recording and in the advised one.
_SEEDS = (21, 22)
_LINES = 8


@dataclass(frozen=True)
class Standing:
    """What a diagnosis holds of the pair."""

    verdict: str
    #: ``true``, ``rival``, ``both``: Probabilities of the true effect alone, of its rival alone, of
    #: the two together
    true: float
    rival: float
    both: float
    confusable: bool  #: Whether the two stand in one group of ``confusable``
    first: tuple[str, ...]  #: The likeliest cause


@dataclass(frozen=True)
class Separation:
    """A rig before and after the advised experiment; without an advice both are the same."""

    rig: str
    true: str
    rival: str
    why: str  #: Of the advice
    command: str  #: empty where there was none
    before: Standing
    after: Standing


def separate(study: Mapping[str, Any], out: Path, report: Report) -> list[Separation]:
    """Record, diagnose, take the advice, diagnose again, for each seed."""
    settings, step = study["separation"], study["record"]["sample_time"]
    ((effect, sizes),) = settings["effect"].items()
    rigs = [rig_of(effect, sizes, seed, study["scatter"]) for seed in settings["seeds"]]
    folders = [out / f"separation-{rig.seed}" for rig in rigs]
    if not all((folder / RECORDING).exists() for folder in folders):
        report(f"recording {len(rigs)} rigs with slow sines")
        samples = round(settings["duration"] / step)
        commands = np.stack([slow_sines(r.seed, samples, step, settings["highest"]) for r in rigs])
        recorded = drive_rigs(
            rigs, OpenLoop(commands), samples * step, step, settling=20.0, seed=_SEEDS[0]
        )
        for i, folder in enumerate(folders):
            folder.mkdir(parents=True, exist_ok=True)
            write_csv(recorded, i, folder / RECORDING)
    return [
        _separate(rig, folder, effect, settings["rival"], study, report)
        for rig, folder in zip(rigs, folders, strict=True)
    ]


def _separate(
    rig: Rig, folder: Path, true: str, rival: str, study: Mapping[str, Any], report: Report
) -> Separation:
    words, step = study["separation"]["diagnose"], study["record"]["sample_time"]
    report(f"separating {rig.name}: the first recording")
    first = diagnose_recordings([folder / RECORDING], folder / "first", words)
    before, advice = pair_standing(first, true, rival)
    if advice is None:
        return Separation(rig.name, true, rival, "", "", before, before)
    advised = folder / "advised.csv"
    if not advised.exists():
        commands = commands_of(advice["command"], folder / "advice", step)
        driver = OpenLoop(commands[None])
        recorded = drive_rigs([rig], driver, len(commands) * step, step, seed=_SEEDS[1])
        write_csv(recorded, 0, advised)
    report(f"separating {rig.name}: both recordings")
    both = diagnose_recordings([folder / RECORDING, advised], folder / "both", words)
    after, _ = pair_standing(both, true, rival)
    return Separation(rig.name, true, rival, advice["why"], advice["command"], before, after)


def pair_standing(folder: Path, true: str, rival: str) -> tuple[Standing, Mapping[str, str] | None]:
    """What the diagnosis in a folder holds of a pair, and its advice."""
    document = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    beliefs = {frozenset(c["effects"]): float(c["probability"]) for c in document["causes"]}
    standing = Standing(
        document["verdict"],
        beliefs.get(frozenset([true]), 0.0),
        beliefs.get(frozenset([rival]), 0.0),
        beliefs.get(frozenset([true, rival]), 0.0),
        any({true, rival} <= set(group) for group in document["confusable"]),
        tuple(document["causes"][0]["effects"]),
    )
    return standing, document["next_experiment"]


def slow_sines(seed: int, samples: int, sample_time: float, highest: float) -> FloatArray:
    """Sums of sines up to a frequency (Hz), (samples, 2) V: a rig that is led about gently."""
    random = np.random.default_rng(seed)
    time = sample_time * np.arange(samples)
    columns = []
    for centre, size in ((MAIN_CENTRE, 0.12), (0.0, 0.3)):
        lines = random.uniform(0.02, highest, _LINES)
        phases = random.uniform(0, 2 * np.pi, _LINES)
        tones = np.sin(2 * np.pi * np.outer(time, lines) + phases).sum(axis=1)
        columns.append(centre + size * tones / np.sqrt(_LINES / 2))
    return np.stack(columns, axis=1)


def commands_of(command: str, scratch: Path, sample_time: float) -> FloatArray:
    """What a ``trms excite`` or an open-loop ``trms run`` would play, (n, 2) V.

    Raises ConfigurationError for any other command, or one with another sample time.
    """
    program, verb, *words = shlex.split(command)
    if program != "trms" or verb not in ("excite", "run"):
        raise ConfigurationError(
            f"{command!r} is no experiment",
            where="next_experiment.command",
            remedy="trms excite … or trms run controller=open_loop …",
        )
    words = [*(w for w in words if not w.startswith("out=")), f"out='{scratch}'", "picture=false"]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        time, commands = _designed(words, scratch) if verb == "excite" else _played(words)
    if abs(time[1] - time[0] - sample_time) > 1e-6:
        raise ConfigurationError(
            f"sampled every {time[1] - time[0]:g} s",
            where="next_experiment.command",
            remedy=f"the rig is sampled every {sample_time:g} s",
        )
    return commands


def _designed(words: Sequence[str], scratch: Path) -> tuple[FloatArray, FloatArray]:
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks import excite
    from trms_cli.library.tasks.task import Listener

    excite.perform(compose(words, "excite"), Listener("excite"))
    lines = (scratch / excite.TABLE_NAME).read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if line and not line.startswith("#")]
    names = [cell.split("[")[0] for cell in lines[0].split(",")]
    table = np.array([line.split(",") for line in lines[1:]], dtype=float)
    return table[:, names.index("t")], table[:, [names.index(name) for name in INPUTS]]


def _played(words: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """The signals of an open-loop controller; the run itself is the rig's."""
    from trms_cli.composition.composer import compose
    from trms_cli.controllers.controller import ControlSample, ControlSetup
    from trms_cli.library.tasks.experiment import experiment_of
    from trms_cli.models.estimate import Estimate

    experiment = experiment_of(compose(words).config)
    controller, model = experiment.controller, experiment.model
    state = controller.init(ControlSetup(model, experiment.sample_time, np.zeros(model.n_u)))
    time = experiment.sample_time * np.arange(experiment.samples, dtype=np.float64)
    nothing = np.zeros(model.n_w)
    estimate = Estimate(model.rest(), model.rest(), nothing, nothing)
    commands = [
        controller.step(
            state,
            ControlSample(float(t), np.zeros((1, 2)), estimate, np.zeros(model.n_u)),
            want_prediction=False,
        ).u.copy()
        for t in time
    ]
    return time, np.array(commands)
