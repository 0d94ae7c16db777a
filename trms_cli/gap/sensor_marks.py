"""What a sensor's readings alone tell, and no simulation: coarse steps, samples that were lost.

Rounding is told by comparison with the other sensors of its kind. A sensor whose samples are lost
shows the last one again, to the last bit, while what it measures moves on by many steps. These
readings say nothing of the rig: a diagnosis takes them for what they are, samples that are missing.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.wording import percent
from trms_cli.gap.belief import DROPOUT, QUANTISATION
from trms_cli.gap.diagnosis import NO_EFFECT, SizeEstimate
from trms_cli.gap.problem import CandidateEffect, GapProblem, is_coarser, quantum_of
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.scales import scales_of

#: Share of a step by which it is read wrong.
_READ = 1e-3
#: Belief that a sensor whose readings show an effect has it.
_MARKED = 0.95
#: Steps finer than this share of a reading are rounded digits.
_DIGITS = 1e-9
#: Steps of the sensor a sample, from which on it moves for sure; samples before and after over
#: which that is judged; readings lost, and their share, that are none by chance.
_MOVING, _AROUND, _FEWEST, _LEAST_SHARE = 4.0, 3, 10, 0.01
_RARE = 1e-6  #: Probability below which so many losses one after the other are none


def repeated_readings(values: FloatArray) -> tuple[BoolArray, float]:
    """Readings that repeat the one before although the signal moves on, (k,), and their share.

    Of a moving signal as many readings lie one step from the one before as lie on it, by chance;
    only repetitions beyond that are losses (Poisson: three standard errors). ``values``: (k,),
    not finite where nothing was measured. None, and a share of zero, where there are few.
    """
    none: BoolArray = np.zeros(len(values), dtype=bool)
    step = np.diff(values, prepend=np.nan)
    steps = np.abs(step[np.isfinite(step) & (step != 0)])
    if not len(steps):
        return none, 0.0
    # the smallest of all, and no rounding of a file's digits: a coarser one only sees less
    quantum = max(float(steps.min()), _DIGITS * float(np.nanmax(np.abs(values))))
    least = _MOVING * quantum * _AROUND
    far = values[_AROUND:] - values[:-_AROUND]
    past, coming = np.zeros(len(values)), np.zeros(len(values))
    past[_AROUND + 1 :] = far[:-1]  # up to the reading that is repeated
    coming[:-_AROUND] = far
    before = np.abs(past) > least
    # one way: where a motion turns round it rests for a moment
    moving = before & (np.abs(coming) > least) & (past * coming > 0) & np.isfinite(step)
    repeats = int(np.sum(step[moving] == 0))
    near = int(np.sum(np.abs(np.abs(step[moving]) - quantum) < 0.5 * quantum)) / 2
    lost, count = repeats - near, int(moving.sum())
    if lost < max(_FEWEST, 3 * np.sqrt(repeats + near), _LEAST_SHARE * count):
        return none, 0.0
    # wherever it has moved on since, or moved before and rests no longer than chance has it
    ends = np.flatnonzero(np.append(step[1:] != 0, True))
    end = ends[np.searchsorted(ends, np.arange(len(values)))]
    begin = np.maximum.accumulate(np.where(step != 0, np.arange(len(values)), 0))
    following = np.append(values, np.nan)[end + 1]
    moves_on = np.abs(following - values) > _MOVING * quantum * (end - begin)
    moved = np.append(before, False)[begin + 1]
    share = lost / count
    is_chance = (end - begin) * np.log(min(share, 0.99)) > np.log(_RARE)
    return (step == 0) & (moves_on | moved & is_chance), share


def with_sensor_marks(problem: GapProblem, candidates: Mapping[str, CandidateEffect]) -> GapProblem:
    """The problem without readings that were shown again, and with what readings alone show.

    Of sensors alone that have such an effect among the candidates.
    """
    cleaned, shares = [], dict[str, list[float]]()
    for dataset in problem.datasets:
        measurements, remarks = dataset.measurements.copy(), dataset.remarks
        for i, signal in enumerate(dataset.outputs):
            if f"{signal.name}{DROPOUT}" in candidates:
                lost, share = repeated_readings(measurements[:, i])
                shares.setdefault(f"{signal.name}{DROPOUT}", []).append(share)
                if lost.any():
                    measurements[lost, i] = np.nan
                    remarks = (*remarks, f"{signal.name}: {percent(share)} of the readings lost")
        cleaned.append(replace(dataset, measurements=measurements, remarks=remarks))
    marks = {}
    for name, of_each in shares.items():
        mean = float(np.mean(of_each))
        sd = float(np.sqrt(mean * (1 - mean) / sum(map(len, problem.datasets))))
        if mean > 0:
            marks[name] = "share", SizeEstimate(value=mean, sd=sd, unit="1")
    bench = problem.model.bench_sizes
    coarse = _coarser_than_other if bench else _coarser_than_declared
    for name, quantum, unit in coarse(problem.model, problem.datasets[0], problem.quanta):
        if name in candidates:
            size = SizeEstimate(value=quantum, sd=_READ * quantum, unit=unit)
            marks[name] = "quantum", size
    return replace(problem, datasets=tuple(cleaned), marks=marks)


def _coarser_than_declared(
    model: Model, dataset: Dataset, declared: Mapping[str, float]
) -> Iterator[tuple[str, float, str]]:
    """Effects of sensors whose steps are coarser than declared, else than a usual encoder's.

    With each its step and unit.
    """
    travels = scales_of(model.without_effects()).travels
    for signal, values in zip(dataset.outputs, dataset.measurements.T, strict=True):
        quantum, usual = quantum_of(values, signal.unit), declared.get(signal.name, 0.0)
        if is_coarser(quantum, usual, 0.0 if usual else travels[signal.name]):
            yield f"{signal.name}{QUANTISATION}", quantum, signal.unit


def _coarser_than_other(
    model: Model, dataset: Dataset, _: Mapping[str, float]
) -> Iterator[tuple[str, float, str]]:
    """The same of the axes of a bench: one that rounds coarser than the other."""
    outputs = {signal.name: i for i, signal in enumerate(dataset.outputs)}
    rows = {axis: outputs[a.angle] for axis, a in model.axes.items() if a.angle in outputs}
    quanta = {axis: quantum_of(dataset.measurements[:, i]) for axis, i in rows.items()}
    units = {dataset.outputs[i].unit for i in rows.values()}
    if len(quanta) > 1 and len(units) == 1:  # of other kinds, they have steps of their own
        for axis, quantum in quanta.items():
            if is_coarser(quantum, min(quanta.values())):
                yield f"{axis}{QUANTISATION}", quantum, next(iter(units))
                return


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
