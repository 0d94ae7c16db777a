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
from trms_cli.gap.diagnosis import Worth
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


class _TooSlow(Exception):
    """The loops take longer than they are worth."""


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


def worth_of(
    experiment: Experiment, before: Model, *, controller: str, command: str
) -> Worth | None:
    """What the correction gains; None where the loop cannot be closed or takes too long.

    ``experiment``: the corrected model as rig and in the controller. ``before``: the model as it
    was. ``controller``, ``command``: their name, and what drives with the corrected model.
    """
    until = process_time() + _LONGEST
    try:
        after, noise = tracking(experiment, until)
        errors, _ = tracking(replace(experiment, model=before), until)
    except (TrmsError, _TooSlow, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return None
    if not after or after.keys() != errors.keys():
        return None
    words = gain_in_words(errors, after, noise, controller)
    return Worth(before=errors, after=after, controller=controller, command=command, words=words)


def tracking(
    experiment: Experiment, until: float = np.inf
) -> tuple[dict[str, float], dict[str, float]]:
    """Root mean square of the tracking error once the beam has risen, and the sensors' noise, rad.

    Both by angle. Raises _TooSlow beyond ``until``, of the process' time.
    """
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
    errors = {
        name: _rms(np.asarray(state[name] - reference[name])[is_counted])
        for name in controlled
        if name in state
    }
    return errors, {name: loop.plant.noise_sd.get(name, 0.0) for name in errors}


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
