"""Whether it is worth it: what the correction gains in the loop, simulated before anyone drives.

The corrected model stands for the rig, noise and quanta of its sensors included. The loop is closed
twice, with the model as it was and with the corrected one in controller and observer; all else,
the noise too, is the same. Beside the rig this knows nothing that the correction does not, so that
it tells what is to be had if the diagnosis is right.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import process_time

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.core.wording import listing, number, percent, signal, small_unit
from trms_cli.gap.diagnosis import LoopGain, Worth
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.plants.plant import PlantRun
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History

#: s of a run; s at its beginning that are not counted, in which the beam rises from rest.
DURATION, _RISING = 30.0, 10.0
#: Hz of the reference, a sine: slow enough to be followed, and each run holds some turns of it.
FREQUENCY = 0.1
#: rad; the reference's amplitudes at most (those of configs/ref/sine.yaml), and the least that is
#: worth following; an offset below is none.
LARGEST: Mapping[str, float] = {"alpha_v": 0.3, "alpha_h": 0.5}
_SMALLEST = 0.05
#: Quantiles of the recorded angles within which the reference stays.
_RANGE = (0.05, 0.95)
#: s of this process' own time for both runs, which take 2 s on most machines: a diagnosis does not
#: wait longer, and what else a machine does changes no answer.
_LONGEST = 10.0
#: A change of an error is one from this share of it, and from so many standard deviations of the
#: sensor's noise: below, the noise that the loop follows decides.
_CHANGED, _ABOVE_NOISE = 0.05, 2.5


#: A loop counts as worse from this growth of its error on.
_WORSE = 0.02
#: s that a reference has to stand still before an axis counts as at rest.
_SETTLED = 6.0


#: Controllers whose loops are judged, on that sine and on squares of its amplitude; with what each
#: gets besides on one whose rate is limited.
JUDGED_CONTROLLERS: Mapping[str, Sequence[str]] = {
    "newton_mpc": ("controller.preview_horizon=40",),
    "pid": (),
}
#: Hz of the square: each level stands still for ten seconds.
_SQUARE_FREQUENCY = 0.05
_REFERENCE_WORDS = {
    "sine": "on a sine",
    "square": "on a square",
    "limited_square": "on a square of limited rate",
    "rest": "at rest",
}


class _TooSlow(Exception):
    """The loops take longer than they are worth."""


#: What a loop that cannot be closed raises.
_REFUSALS = (TrmsError, ArithmeticError, ValueError, np.linalg.LinAlgError)


def sine_within(datasets: Sequence[Dataset], axes: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Amplitude and offset, rad, of a sine within the recorded range of each angle.

    Rounded to hundredths, so that they can be typed; angles that were not recorded have none.
    """
    sines = {}
    for axis in axes:
        columns = [
            d.measurements[:, i]
            for d in datasets
            for i, output in enumerate(d.outputs)
            if output.name == axis
        ]
        values = np.concatenate(columns) if columns else np.zeros(0)
        values = values[np.isfinite(values)]
        if axis not in LARGEST or not len(values):
            continue
        low, high = (float(v) for v in np.quantile(values, _RANGE))
        amplitude = round(min(0.5 * (high - low), LARGEST[axis]), 2)
        offset = round(0.5 * (low + high), 2)
        sines[axis] = (max(amplitude, _SMALLEST), offset if abs(offset) >= _SMALLEST else 0.0)
    return sines


def square_of(sine: Sequence[str]) -> list[str]:
    """Overrides of a square of the amplitude and the offset of a sine's overrides."""
    slow = f"={_SQUARE_FREQUENCY:g}"
    renamed = ("ref=square" if word == "ref=sine" else word for word in sine)
    return [w.partition("=")[0] + slow if ".frequency=" in w else w for w in renamed]


def judged_references(sine: Sequence[str], controller: str) -> dict[str, list[str]]:
    """Overrides by name of the references that a controller is judged on."""
    square = square_of(sine)
    limited = [*square, "shaping@ref.shaping=limited", *JUDGED_CONTROLLERS[controller]]
    return {"sine": list(sine), "square": square, "limited_square": limited}


def worth_of(
    experiment: Experiment,
    before: Model,
    *,
    controller: str,
    command: str,
    loops: Mapping[tuple[str, str], Experiment] | None = None,
) -> Worth | None:
    """What the correction gains; None where the loop cannot be closed or takes too long.

    ``experiment``: the corrected model as rig and in the controller. ``before``: the model as it
    was. ``controller``, ``command``: their name, and what drives with the corrected model.
    ``loops``: further ones, likewise, by controller and reference; see :func:`loops_of`.
    """
    until = process_time() + _LONGEST
    try:
        after, noise = tracking(experiment, until)
        errors, _ = tracking(replace(experiment, model=before), until)
    except (*_REFUSALS, _TooSlow):
        return None
    if not after or after.keys() != errors.keys():
        return None
    words = gain_in_words(errors, after, noise, controller)
    gains = loops_of(loops or {}, before)
    return Worth(
        before=errors,
        after=after,
        controller=controller,
        command=command,
        words=words,
        loops=gains,
        warning=warning_of(gains),
    )


def loops_of(
    experiments: Mapping[tuple[str, str], Experiment], before: Model
) -> tuple[LoopGain, ...]:
    """What the correction gains each loop; those that take too long are left out.

    A loop that the corrected model alone does not close has an infinite error with it.

    ``experiments``: by controller and reference (:func:`judged_references`).
    """
    gains = []
    until = process_time() + _LONGEST
    for (controller, reference), experiment in experiments.items():
        try:
            old, noise = _errors(replace(experiment, model=before), reference, until)
            new = _errors_or_none(experiment, reference, until)
        except _TooSlow:
            break
        except _REFUSALS:
            continue
        for name in (reference, "rest"):
            if not np.isfinite(old.get(name, np.nan)):
                continue
            error = np.inf if new is None else new.get(name, np.inf)
            grows = not error <= (1 + _WORSE) * old[name]
            is_worse = grows and not error - old[name] <= _ABOVE_NOISE * noise
            gains.append(
                LoopGain(
                    controller=controller,
                    reference=name,
                    before=old[name],
                    after=float(error),
                    is_worse=bool(is_worse),
                )
            )
    return tuple(gains)


def _errors_or_none(
    experiment: Experiment, reference: str, until: float
) -> dict[str, float] | None:
    """Errors of a loop; None for one that cannot be closed."""
    try:
        return _errors(experiment, reference, until)[0]
    except _REFUSALS:
        return None


def warning_of(loops: Sequence[LoopGain]) -> str:
    """Where the correction makes a loop worse, and what to use there; empty if nowhere."""
    unit, scale = small_unit("rad")
    parts = []
    for worse in (loop for loop in loops if loop.is_worse):
        figures = f"{number(scale * worse.before, 2)} → {number(scale * worse.after, 2)} {unit}"
        if not np.isfinite(worse.after):
            figures = "cannot control with it"
        where = _REFERENCE_WORDS[worse.reference]
        best = min(
            (other for other in loops if other.reference == worse.reference),
            key=lambda loop: min(loop.after, loop.before),
        )
        if best.controller != worse.controller and best.after < worse.before:
            remedy = f"use controller={best.controller} with it ({number(scale * best.after, 2)})"
        else:
            remedy = "keep the model as it was there"
        parts.append(f"{worse.controller} {where} {figures}: {remedy}")
    if not parts:
        return ""
    return f"the correction is predicted to make a loop worse: {'; '.join(parts)}"


def tracking(
    experiment: Experiment, until: float = np.inf
) -> tuple[dict[str, float], dict[str, float]]:
    """Root mean square of the tracking error once the beam has risen, and the sensors' noise, rad.

    Both by angle. Raises _TooSlow beyond ``until``, of the process' time.
    """
    differences, _, noise = _differences(experiment, until)
    return {name: _rms(values) for name, values in differences.items()}, noise


def _errors(experiment: Experiment, name: str, until: float) -> tuple[dict[str, float], float]:
    """Errors over all angles, rad: on the reference of that name, and on a square also at rest.

    And the largest sensor noise, rad.
    """
    differences, reference, noise = _differences(experiment, until)
    squares = np.sum([values**2 for values in differences.values()], axis=0)
    errors = {name: float(np.sqrt(np.mean(squares)))}
    settled = round(_SETTLED / experiment.sample_time)
    changes = np.cumsum(np.any(np.diff(reference, axis=0, prepend=reference[:1]) != 0, axis=1))
    before = np.concatenate([np.full(settled, -1), changes])[: len(changes)]
    is_still = changes == before
    if name == "square" and is_still.any():
        errors["rest"] = float(np.sqrt(np.mean(squares[is_still])))
    return errors, max(noise.values(), default=0.0)


def _differences(
    experiment: Experiment, until: float
) -> tuple[dict[str, FloatArray], FloatArray, dict[str, float]]:
    """State less reference by angle once the beam has risen, the references, and the noise."""
    controlled = experiment.model.controlled

    def make_history(plant: PlantRun) -> History:
        fields = {"/reference": controlled, "/plant/state": [s.name for s in plant.states]}
        return History({topic: dict.fromkeys(f, "") for topic, f in fields.items()}, None)

    def watch(time: float, error: float) -> None:
        if process_time() > until:
            raise _TooSlow

    with np.errstate(all="ignore"):
        loop = Loop.start(replace(experiment, prediction_every=0), make_history)
        loop.run(watch)
    reference = loop.history.columns("/reference")
    state = loop.history.columns("/plant/state")
    is_counted = loop.history.times("/reference") >= _RISING
    differences = {
        name: np.asarray(state[name] - reference[name])[is_counted]
        for name in controlled
        if name in state
    }
    columns = np.column_stack([np.asarray(reference[name])[is_counted] for name in controlled])
    return differences, columns, {n: loop.plant.noise_sd.get(n, 0.0) for n in differences}


def gain_in_words(
    before: Mapping[str, float], after: Mapping[str, float], noise: Mapping[str, float], name: str
) -> str:
    """The sentence: by how much each angle is followed closer by the controller of that name.

    ``noise``: standard deviation of each angle's sensor, rad.
    """
    parts, is_better, is_worse = [], False, False
    unit, scale = small_unit("rad")
    for axis, old in before.items():
        new = after[axis]
        share = 1 - new / old if old > 0 else 0.0
        same = abs(share) < _CHANGED or abs(new - old) < _ABOVE_NOISE * noise.get(axis, 0.0)
        is_better |= share > 0 and not same
        is_worse |= share < 0 and not same
        way = f"{percent(abs(share))} {'less' if share > 0 else 'more'}"
        figures = f"{number(scale * old, 2)} → {number(scale * new, 2)} {unit}"
        parts.append(f"{signal(axis)} {figures} ({'about the same' if same else way})")
    text = f"Simulated on such a rig, {name} tracks with the model as it was and corrected: RMS of "
    text += listing(parts)
    text += f", from {_RISING:g} s on"
    if is_worse:
        text += "; what the correction adds does not suit this controller throughout"
    elif not is_better:
        text += "; the controller and its observer make up for what the model lacks"
    return f"{text}."


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
