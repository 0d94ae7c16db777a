"""Closed loops on a rig of other code: every model in the same task, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import numpy.typing as npt

from experiments.gap.closing_loop import tracking
from experiments.gap.driver import Loop, ModelBased, loop_of
from experiments.model_study.rigs import DrawnRig, drive
from experiments.model_study.study import Study
from trms_cli.core.errors import TrmsError
from trms_cli.effects.model_file import load_model
from trms_cli.models.model import Model

FloatArray = npt.NDArray[np.float64]
AXES = ("pitch", "yaw")
_MS = 1e3


@dataclass(frozen=True)
class LoopRun:
    """A model in a loop."""

    rmse: Mapping[str, float]  #: By axis, rad; infinite where the loop broke off
    movement: Mapping[str, float]  #: Σ|Δu| by axis, V/s
    step_ms: float  #: Controller and observer in a control sample, median
    problem: str = ""  #: Why it broke off
    #: Thinned: ``time`` (s), ``reference``, ``angle`` (rad), ``command`` (V), each (n, 2)
    traces: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def error(self) -> float:
        """Of both axes: root of the sum of their mean squares, rad."""
        return float(np.sqrt(sum(value**2 for value in self.rmse.values())))


class Side:
    """A loop that may end in an error without ending those beside it.

    Parameters
    ----------
    loop, model : Loop, Model
        Controller, observer and reference; what they believe of the rig.
    samples, step : int, float
        Of the run; s.
    """

    def __init__(self, loop: Loop, model: Model, samples: int, step: float) -> None:
        self.problem = ""
        self.seconds: list[float] = []  #: Of each sample
        self._driver: ModelBased | None = None
        try:
            self._driver = ModelBased([loop], [model], samples, step)
        except (TrmsError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            self.problem = _words(error)

    @property
    def references(self) -> FloatArray | None:
        """(samples, 2) rad."""
        return None if self._driver is None else self._driver.references[0]

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """The command from now on, (2,) V; none after an error."""
        if self._driver is None or self.problem:
            return np.zeros(2)
        begin = perf_counter()
        try:
            command = self._driver.command(k, time, measured[None])[0]
        except (TrmsError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            self.problem = _words(error)
            return np.zeros(2)
        self.seconds.append(perf_counter() - begin)
        if not np.all(np.isfinite(command)):
            self.problem = "a command is not finite"
            return np.zeros(2)
        return command


class SideBySide:
    """Loops on copies of one rig; a :class:`experiments.gap.blind.rig.Driver`."""

    def __init__(self, sides: Sequence[Side]) -> None:
        self._sides = sides

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """See :class:`experiments.gap.blind.rig.Driver`."""
        pairs = zip(self._sides, measured, strict=True)
        return np.stack([side.command(k, time, y) for side, y in pairs])


def model_of(name: str) -> Model:
    """The model of a file, or of an option of ``model``."""
    if name.endswith(".yaml"):
        return load_model(name)
    from trms_cli.composition.composer import compose
    from trms_cli.core.plugins import build

    model = build(compose([f"model={name}", "picture=false"]).config["model"], "model")
    assert isinstance(model, Model)
    return model


def close_loops(
    rig: DrawnRig, models: Mapping[str, str], study: Study, thinning: int = 5
) -> dict[str, dict[str, LoopRun]]:
    """All models in all tasks on a rig, by task and model; they run side by side.

    ``models``: what ``model=`` takes, by name. ``thinning``: every how many samples a trace keeps.
    """
    settings, step = study.loops, study.recordings.sample_time
    samples = round(settings.duration / step)
    built = {name: model_of(model) for name, model in models.items()}
    loops = {task: loop_of(chosen.words) for task, chosen in settings.chosen().items()}
    keys = [(task, name) for task in loops for name in built]
    sides = [Side(loops[task], built[name], samples, step) for task, name in keys]
    with np.errstate(all="ignore"):
        recorded = drive(
            [rig] * len(sides),
            SideBySide(sides),
            settings.duration,
            step,
            among=study.rigs.every,
        )
    runs: dict[str, dict[str, LoopRun]] = {task: {} for task in loops}
    for i, ((task, name), side) in enumerate(zip(keys, sides, strict=True)):
        if side.problem or side.references is None:
            none = dict.fromkeys(AXES, float("inf"))
            runs[task][name] = LoopRun(none, none, float("nan"), side.problem)
            continue
        angles, commands = recorded.measured[i, :, :2], recorded.commands[i]
        counted = {"run": {"from": settings.begin}}
        figures = tracking(rig.rig, task, name, side.references, angles, commands, step, counted)
        controller = loops[task].controller
        period = round((getattr(controller, "sample_time", None) or step) / step)
        seconds = side.seconds[period::period]  # the first sample compiles
        traces = {
            "time": recorded.time[::thinning],
            "reference": side.references[::thinning],
            "angle": angles[::thinning],
            "command": commands[::thinning],
        }
        step_ms = _MS * float(np.median(seconds))
        runs[task][name] = LoopRun(figures.rmse, figures.movement, step_ms, "", traces)
    return runs


def acceptance(rig: DrawnRig, models: Mapping[str, str], study: Study) -> dict[str, dict[str, str]]:
    """Which law takes which model, by law and model: empty, or why not."""
    settings, step = study.acceptance, study.recordings.sample_time
    samples = round(settings.duration / step)
    built = {n: model_of(models[n]) for n in settings.models if n in models}
    keys, sides = [], []
    for controller in settings.controllers:
        loop = loop_of([f"controller={controller}"])
        for name, model in built.items():
            keys.append((controller, name))
            sides.append(Side(loop, model, samples, step))
    with np.errstate(all="ignore"):
        copies = [rig] * len(sides)
        drive(copies, SideBySide(sides), settings.duration, step, among=study.rigs.every)
    answers: dict[str, dict[str, str]] = {}
    for (controller, name), side in zip(keys, sides, strict=True):
        answers.setdefault(controller, {})[name] = side.problem
    return answers


def _words(error: Exception) -> str:
    """What went wrong, in a line."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__
