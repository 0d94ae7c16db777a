"""What a sensor's readings alone tell, and no simulation: coarse steps, samples that were lost.

Rounding is told by comparison with the other sensors of its kind. A sensor whose samples are lost
shows the last one again, to the last bit, while what it measures moves on by many steps. These
readings say nothing of the rig: a diagnosis takes them for what they are, samples that are missing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.wording import percent
from trms_cli.gap.belief import DROPOUT, QUANTISATION
from trms_cli.gap.diagnosis import NO_EFFECT
from trms_cli.gap.problem import CandidateEffect, GapProblem, is_coarser, quantum_of
from trms_cli.identification.dataset import Dataset

#: Belief that a sensor whose readings show an effect has it.
_MARKED = 0.95
#: Steps of the sensor a sample, from which on it moves for sure; samples before and after over
#: which that is judged; readings lost, and their share, that are none by chance.
_MOVING, _AROUND, _FEWEST, _LEAST_SHARE = 4.0, 3, 10, 0.01


def repeated_readings(values: FloatArray) -> tuple[BoolArray, float]:
    """Readings that repeat the one before although the signal moves on, (k,), and their share.

    Of a moving signal as many readings lie one step from the one before as lie on it, by chance;
    only repetitions beyond that are losses (Poisson: three standard errors). ``values``: (k,),
    not finite where nothing was measured. None, and a share of zero, where there are few.
    """
    none: BoolArray = np.zeros(len(values), dtype=bool)
    quantum = quantum_of(values, "")
    step = np.diff(values, prepend=np.nan)
    least = _MOVING * max(quantum, 1e-12 * float(np.nanmax(np.abs(values), initial=0.0))) * _AROUND
    far = np.abs(values[_AROUND:] - values[:-_AROUND])
    before, after = none.copy(), none.copy()
    before[_AROUND + 1 :] = far[:-1] > least  # up to the reading that is repeated
    after[:-_AROUND] = far > least
    moving = before & after & np.isfinite(step)
    repeats = int(np.sum(step[moving] == 0))
    near = int(np.sum(np.abs(np.abs(step[moving]) - quantum) < 0.5 * quantum)) / 2
    lost, count = repeats - near, int(moving.sum())
    if lost < max(_FEWEST, 3 * np.sqrt(repeats + near), _LEAST_SHARE * count):
        return none, 0.0
    # wherever the next other reading is some steps away: elsewhere a loss does not matter
    ends = np.flatnonzero(np.append(step[1:] != 0, True))
    end = ends[np.searchsorted(ends, np.arange(len(values)))]
    begin = np.maximum.accumulate(np.where(step != 0, np.arange(len(values)), 0))
    following = np.append(values, np.nan)[end + 1]
    jump = np.abs(following - values) > _MOVING * quantum * (end - begin)
    return (step == 0) & jump, lost / count


def without_lost_samples(
    datasets: Sequence[Dataset], candidates: Mapping[str, CandidateEffect]
) -> tuple[tuple[Dataset, ...], dict[str, float]]:
    """Recordings without readings that were shown again, and the share lost by name of the effect.

    Of sensors alone that have such an effect among the candidates.
    """
    cleaned, shares = [], dict[str, list[float]]()
    for dataset in datasets:
        measurements, remarks = dataset.measurements.copy(), dataset.remarks
        for i, signal in enumerate(dataset.outputs):
            if f"{signal.name}{DROPOUT}" in candidates:
                lost, share = repeated_readings(measurements[:, i])
                shares.setdefault(f"{signal.name}{DROPOUT}", []).append(share)
                if lost.any():
                    measurements[lost, i] = np.nan
                    remarks = (*remarks, f"{signal.name}: {percent(share)} of the readings lost")
        cleaned.append(replace(dataset, measurements=measurements, remarks=remarks))
    means = {name: float(np.mean(of_each)) for name, of_each in shares.items()}
    return tuple(cleaned), {name: share for name, share in means.items() if share > 0}


def sensor_marks(problem: GapProblem, candidates: Mapping[str, CandidateEffect]) -> tuple[str, ...]:
    """Names of the effects that readings alone show, none twice."""
    coarse = coarse_sensor(problem, candidates)
    return (*([coarse] if coarse else []), *problem.lost_shares)


def coarse_sensor(problem: GapProblem, candidates: Mapping[str, CandidateEffect]) -> str:
    """A sensor that rounds coarser than the other shows in its steps, and in nothing else.

    The name of its effect; empty where there is none.
    """
    quanta, units = {}, set()
    for axis, definition in problem.model.axes.items():
        for dataset in problem.datasets[:1]:
            names_ = [s.name for s in dataset.outputs]
            if definition.angle in names_:
                quanta[axis] = quantum_of(dataset.measurements[:, names_.index(definition.angle)])
                units.add(dataset.outputs[names_.index(definition.angle)].unit)
    if len(units) > 1:  # of other kinds, with steps of their own
        return ""
    coarse = [
        axis
        for axis, quantum in quanta.items()
        if f"{axis}_quantisation" in candidates and is_coarser(quantum, min(quanta.values()))
    ]
    return f"{coarse[0]}{QUANTISATION}" if coarse and len(quanta) > 1 else ""


def with_marked_sensors(
    probabilities: Mapping[tuple[str, ...], float], marked: Sequence[str]
) -> dict[tuple[str, ...], float]:
    """Give each effect that readings show its share of every answer but that of no name."""
    shares = dict(probabilities)
    for effect in marked:
        before, shares = shares, {}
        for names, probability in before.items():
            if names == ("none_of_these",):
                shares[names] = shares.get(names, 0.0) + probability
                continue
            joined = (effect,) if names[0] in NO_EFFECT else tuple(sorted((*names, effect)))
            shares[joined] = shares.get(joined, 0.0) + _MARKED * probability
            shares[names] = shares.get(names, 0.0) + (1 - _MARKED) * probability
    return dict(sorted(shares.items(), key=lambda item: -item[1]))
