"""Whether it is worth it: what the correction gains in the loop, simulated before anyone drives.

The corrected model stands for the rig, noise and quanta of its sensors included. The loop is closed
twice, with the model as it was and with the corrected one in controller and observer; all else,
the noise too, is the same. Beside the rig this knows nothing that the correction does not, so that
it tells what is to be had if the diagnosis is right.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from time import process_time
from types import MappingProxyType

import numpy as np
from scipy.special import stdtrit

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import TrmsError
from trms_cli.core.invocation import notes_to
from trms_cli.core.wording import listing, number, percent, signal, small_unit
from trms_cli.gap.diagnosis import LoopGain, Worth
from trms_cli.gap.problem import recorded_values
from trms_cli.identification.dataset import Dataset
from trms_cli.models.beam_rig import AXES
from trms_cli.models.model import Model
from trms_cli.plants.plant import PlantRun
from trms_cli.simulation.closed_loop import Experiment, Loop
from trms_cli.simulation.history import History

#: s of a run; s at its beginning that are not counted, in which the beam rises from rest.
DURATION, _RISING = 30.0, 10.0
#: Hz of the reference, a sine: slow enough to be followed, and each run holds some turns of it.
FREQUENCY = 0.1
#: rad; amplitudes of a beam's reference at most (those of configs/ref/sine.yaml), and the least
#: that is worth following; an offset below is none. Others have what was recorded for bounds.
LARGEST: Mapping[str, float] = dict(zip((a.angle for a in AXES.values()), (0.3, 0.5), strict=True))
_SMALLEST = 0.05
#: Quantiles of the recorded angles within which the reference stays.
_RANGE = (0.05, 0.95)
#: s of this process' own time for both runs, which take 2 s on most machines: a diagnosis does not
#: wait longer, and what else a machine does changes no answer.
_LONGEST = 10.0
#: A change of an error is one from this share of it, and from so many standard deviations of the
#: sensor's noise: below, the noise that the loop follows decides.
_CHANGED, _ABOVE_NOISE = 0.05, 2.5


#: A loop counts as worse from this growth of its error on. One that looks worse by the least is
#: run with further noises (times in all), and is worse if its growth is above zero at a level of
#: 95 %: what a quiet loop loses is far below its sensors' noise.
_WORSE, _LOOKS_WORSE, _TIMES = 0.02, 0.005, 3
#: s that a reference has to stand still before an axis counts as at rest.
_SETTLED = 6.0


#: Controllers whose loops are judged, on a sine and on squares of those amplitudes; with what each
#: gets besides on one whose rate is limited.
JUDGED_CONTROLLERS: Mapping[str, Sequence[str]] = {
    "newton_mpc": ("controller.preview_horizon=40",),
    "pid": (),
}
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
    """Amplitude and offset of a sine within the recorded range of each controlled state.

    Rounded, so that they can be typed; what was not recorded has none.
    """
    sines = {}
    for axis in axes:
        values = recorded_values(datasets, axis)
        if not len(values):
            continue
        low, high = (float(v) for v in np.quantile(values, _RANGE))
        if axis not in LARGEST:
            amplitude, offset = (float(f"{0.5 * v:.2g}") for v in (high - low, low + high))
            sines[axis] = (amplitude, offset if abs(offset) > 0.1 * amplitude else 0.0)
            continue
        amplitude = round(min(0.5 * (high - low), LARGEST[axis]), 2)
        offset = round(0.5 * (low + high), 2)
        sines[axis] = (max(amplitude, _SMALLEST), offset if abs(offset) >= _SMALLEST else 0.0)
    return sines


def reference_words(
    kind: str, sines: Mapping[str, tuple[float, float]], frequency: float | None = None
) -> list[str]:
    """Overrides of ``trms run`` for a reference of such amplitudes and offsets by axis.

    ``frequency``: Hz; None for that of the option.
    """
    words = [f"ref={kind}"]
    for axis, (amplitude, offset) in sines.items():
        values = {"frequency": frequency, "amplitude": amplitude, "offset": offset}
        usual = {"frequency": None, "amplitude": LARGEST.get(axis), "offset": 0.0}
        words += [f"ref.{axis}.{k}={v:g}" for k, v in values.items() if v != usual[k]]
    return words


def judged_references(
    sines: Mapping[str, tuple[float, float]], controller: str
) -> dict[str, list[str]]:
    """Overrides by name of the references that a controller is judged on.

    As ``trms run`` has them, but for amplitudes and offsets; see :func:`sine_within`.
    """
    square = reference_words("square", sines)
    limited = [*square, "shaping@ref.shaping=limited", *JUDGED_CONTROLLERS[controller]]
    return {"sine": reference_words("sine", sines), "square": square, "limited_square": limited}


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
    units = {signal.name: signal.unit for signal in before.states}
    words = gain_in_words(errors, after, noise, controller, units)
    gains = loops_of(loops or {}, before)
    return Worth(
        before=errors,
        after=after,
        controller=controller,
        command=command,
        words=words,
        loops=gains,
        warning=warning_of(gains, units[before.controlled[0]]),
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
        names = (reference, "rest")
        pairs: list[tuple[dict[str, float], dict[str, float]]] = []
        noise = 0.0
        try:
            for seed in range(experiment.seed, experiment.seed + _TIMES):
                noisy = replace(experiment, seed=seed)
                old, noise = _errors(replace(noisy, model=before), reference, until)
                try:
                    new, _ = _errors(noisy, reference, until)
                except _REFUSALS:  # it cannot be closed
                    new = dict.fromkeys(names, np.inf)
                pairs.append((old, new))
                growths = [new[n] / old[n] - 1 for n in names if np.isfinite(old.get(n, np.nan))]
                if not any(_LOOKS_WORSE < growth < np.inf for growth in growths):
                    break
        except _TooSlow:
            if not pairs:
                break
        except _REFUSALS:
            continue
        for name in names:
            if np.isfinite(pairs[0][0].get(name, np.nan)):
                errors = np.array([[old[name], new[name]] for old, new in pairs])
                gains.append(_gain(controller, name, errors, noise))
    return tuple(gains)


def _gain(controller: str, reference: str, errors: FloatArray, noise: float) -> LoopGain:
    """Of errors with the model as it was and the corrected one, (k, 2) rad, a row a noise.

    ``noise``: standard deviation of the largest sensor's, rad.
    """
    old, new = (float(e) for e in errors.mean(axis=0))
    growth = np.log(errors[:, 1] / errors[:, 0])
    is_worse = not growth.mean() <= np.log1p(_WORSE)
    if len(growth) > 1 and np.isfinite(new):
        error = growth.std(ddof=1) / np.sqrt(len(growth))
        is_worse &= bool(growth.mean() > stdtrit(len(growth) - 1, 0.95) * error)
    elif np.isfinite(new):
        is_worse &= bool(new - old > _ABOVE_NOISE * noise)  # of one noise alone
    return LoopGain(
        controller=controller,
        reference=reference,
        before=old,
        after=new,
        is_worse=bool(is_worse),
        is_visible=not new - old <= noise,
    )


def warning_of(loops: Sequence[LoopGain], of: str = "rad") -> str:
    """Where the correction makes a loop worse, and what to use there; empty if nowhere.

    ``of``: unit of the errors.
    """
    unit, scale = small_unit(of)
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
        if not worse.is_visible:
            figures += " (less than its sensors' noise)"
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
    errors = {
        name: float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
        for name, values in differences.items()
    }
    return errors, noise


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

    # whether the usual control period suits the rig is said when it is driven
    is_bench = experiment.model.bench_sizes
    with np.errstate(all="ignore"), nullcontext() if is_bench else notes_to(lambda text: None):
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
    before: Mapping[str, float],
    after: Mapping[str, float],
    noise: Mapping[str, float],
    name: str,
    units: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """The sentence: by how much each angle is followed closer by the controller of that name.

    ``noise``: standard deviation of each angle's sensor. ``units``: of all; rad where none is told.
    """
    parts, is_better, is_worse = [], False, False
    for axis, old in before.items():
        new = after[axis]
        share = 1 - new / old if old > 0 else 0.0
        same = abs(share) < _CHANGED or abs(new - old) < _ABOVE_NOISE * noise.get(axis, 0.0)
        is_better |= share > 0 and not same
        is_worse |= share < 0 and not same
        unit, scale = small_unit(units.get(axis, "rad"))
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
