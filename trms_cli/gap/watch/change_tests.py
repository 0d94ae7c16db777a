"""Sequential tests for changes: a force on an equation, a bias of a sensor.

Each test is a generalised likelihood ratio over the time of the onset (Willsky & Jones 1976, IEEE
Trans. Autom. Control 21; Basseville & Nikiforov, Detection of Abrupt Changes, 1993, chapter 7): for
every onset of a grid it carries along what a change of unit size would have done to the whitened
innovations, the filter's own adaptation included, and matches them with what was measured.

    T = (Σ s'z)²/J          size = Σ s'z/J          sd = J^−½          J = Σ s's + 1/σ²

σ is the size that is believed possible: what a resting axis shows of friction would else be any.

With the model's usual errors as the filter has them, T is a chi-squared variable of one degree of
freedom; a change makes it grow as time goes on. No model's errors are exactly so. Two things keep
the tests level on a rig that does not change:

- the size of each equation's coloured force is adjusted until T of that equation is one in the
  mean, so that the innovations are as white as the rig allows;
- what is left of that, by test and by time since the onset, divides T.

A sensor that rounds may err by half a step to either side for as long as nothing moves: a bias
counts by what it is beyond a step. Levels and steps are learnt in the first seconds of a run; the
levels follow slowly from then on.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.effects.places import sensor_place
from trms_cli.gap.watch.filter_step import SignatureArrays
from trms_cli.gap.watch.predictor import Predictor, angle_of
from trms_cli.models.model import names
from trms_cli.observers.augmentation import InitialSd

#: s between onsets, and how many: fine ones of the last seconds, coarse ones beyond.
_GRIDS = ((0.25, 16), (1.5, 8))
#: Onsets at which a reading jumped: beside such a jump a grid is coarse.
_JUMPS = 8
#: s since the onset, between the classes whose level is learnt apart.
_AGES = np.array([0.1, 1.3, 3.0, 5.3, np.inf])
_CLASSES = np.arange(len(_AGES) - 1)
_OLDEST = 13.0  #: s; an older onset is no candidate any more
#: s since the onset, of those that say how large the usual force is.
_LEVELLING = (0.4, 6.0)
#: T that counts at most in means: a change is not learnt as if it were usual.
_MOST = 6.0
#: s, time constants: of the usual forces and of the levels, while learning and later.
_FORCE_TIMES, _LEVEL_TIMES = (5.0, 60.0), (8.0, 60.0)
#: Sizes of changes, in an observer's first uncertainties of torques (10 mN m on an axis), angles
#: (0.1 rad) and speeds (20 rad/s).
_LIKELY = 3.0
#: Rate of the axis and speed of the rotor at which friction has three quarters of its size.
_RATE, _SPEED = 0.05, 20.0  # rad/s


@dataclass(frozen=True)
class ChangeTest:
    """One kind of change at one place."""

    location: str  #: By the names of a diagnosis
    form: str  #: ``constant``, ``against_motion`` or ``bias``
    unit: str  #: Of a size


class ChangeEstimate(NamedTuple):
    """The most likely change by all tests."""

    test: int
    statistic: float  #: T, levelled
    size: float
    sd: float
    since: float  #: s before now


class ChangeTests:
    """All tests of a run, beside a filter."""

    def __init__(self, predictor: Predictor, outputs: tuple[str, ...], every: int) -> None:
        model, filter_ = predictor.model, predictor.arrays
        self._predictor, self._every = predictor, every
        self._sample_time = predictor.sample_time
        equations = self._equations(outputs)
        disturbances = names(model.disturbances)
        units = {signal.name: signal.unit for signal in (*model.disturbances, *model.outputs)}
        forces = [
            ChangeTest(disturbances[e], form, units[disturbances[e]])
            for e in equations
            for form in ("constant", "against_motion")
        ]
        biases = [ChangeTest(sensor_place(model, name), "bias", units[name]) for name in outputs]
        self.tests = (*forces, *biases)
        self._equations_of: IntArray = np.array(equations, dtype=np.int64)
        n_f = len(forces)
        self.signatures = SignatureArrays(
            filter_, len(self.tests), sum(n for _, n in _GRIDS) + _JUMPS
        )
        own = self.signatures
        own.on_outputs[n_f:] = np.eye(len(outputs))
        #: (tests, 1) array; sizes up to which a change may come from a sensor's rounding alone
        self._dead_bands: FloatArray = np.zeros((len(self.tests), 1))
        #: (tests, 1) array; of the sizes that are believed possible, about none
        self._precisions: FloatArray = self._likely_sizes(outputs)[:, None] ** -2.0
        n_x = predictor.n_x
        self._constant = own.on_state[0:n_f:2, :n_x]
        self._frictional = own.on_state[1:n_f:2, :n_x]
        self._motion()
        self._periods = [(max(1, round(s / self._sample_time)), count) for s, count in _GRIDS]
        self._begin: FloatArray = np.zeros(own.slots)  #: Sample of each onset
        self.clear()

    def _equations(self, outputs: tuple[str, ...]) -> list[int]:
        """Equations that can be told apart: all with as many channels, else those of the axes."""
        model = self._predictor.model
        if len(outputs) >= model.n_w:
            return list(range(model.n_w))
        equations = enumerate(names(model.disturbances))
        return [e for e, name in equations if angle_of(model, name) is not None]

    def _likely_sizes(self, outputs: tuple[str, ...]) -> FloatArray:
        """Standard deviation of each size beforehand: what is larger is no change of a rig."""
        predictor = self._predictor
        forces = np.repeat(predictor.usual_force[self._equations_of], 2)
        angles = {axis.angle for axis in predictor.model.axes.values()}
        first = InitialSd()
        readings = [first.angle if name in angles else first.rotor for name in outputs]
        return _LIKELY * np.concatenate([forces, readings])

    def _motion(self) -> None:
        """Which state says which way an equation moves: the change of an angle, or a speed."""
        model = self._predictor.model
        states, scales, differences = [], [], []
        equations = names(model.disturbances)
        for e in self._equations_of.tolist():
            angle = angle_of(model, equations[e])
            states.append(self._predictor.pushed[e] if angle is None else angle)
            scales.append(1 / _SPEED if angle is None else 1 / (_RATE * self._sample_time))
            differences.append(0.0 if angle is None else 1.0)
        self._moving: IntArray = np.array(states, dtype=np.int64)
        self._scales, self._differences = np.array(scales), np.array(differences)

    def clear(self) -> None:
        """Forget all onsets and levels; what is usual is learnt anew."""
        self.signatures.clear()
        self._samples = self._jumps = 0
        self._latest_onset: float = np.inf
        #: (tests, ages) array; mean of T
        self.levels: FloatArray = np.ones((len(self.tests), len(_AGES) - 1))

    def forget_onsets(self) -> None:
        """Begin with none again; what is usual stays learnt."""
        self.signatures.clear()
        self._latest_onset = np.inf

    def step(self) -> None:
        """One sample on, after the filter's."""
        predictor, own = self._predictor, self.signatures
        push = predictor.push[:, self._equations_of].T
        x = predictor.x
        motion = x[self._moving] - self._differences * predictor.before[self._moving]
        direction = np.tanh(motion * self._scales)
        self._constant[...] = push
        self._frictional[...] = -direction[:, None] * push
        own.carry()
        self._samples += 1
        first = 0
        for period, count in self._periods:
            if self._samples % period == 0:
                self._begin_at(first + (self._samples // period) % count)
            first += count

    def take_quanta(self, quanta: FloatArray) -> None:
        """Bear with biases of a step of each sensor, (n_y,): so much may its rounding shift."""
        self._dead_bands[-len(quanta) :, 0] = quanta

    def confine_onsets(self, *, to_the_past: bool) -> None:
        """Look for onsets before now alone: what has been noticed has begun; or for all again."""
        self._latest_onset = self._samples if to_the_past else np.inf

    def note_jump(self) -> None:
        """Try this moment as an onset, too; to be called before :meth:`step`."""
        self._begin_at(self.signatures.slots - _JUMPS + self._jumps % _JUMPS)
        self._jumps += 1

    def _begin_at(self, slot: int) -> None:
        self.signatures.begin(slot)
        self._begin[slot] = self._samples

    def judge(self, *, learning: bool) -> ChangeEstimate:
        """The most likely change; levels follow. To be called every so many samples."""
        own = self.signatures
        age = (self._samples - self._begin) * self._sample_time
        age[(own.live == 0.0) | (age > _OLDEST)] = -1.0
        energy = own.energy + self._precisions
        beyond = np.maximum(np.abs(own.product) / energy - self._dead_bands, 0.0)
        t = beyond * beyond * energy
        capped = np.minimum(t, _MOST)
        seconds = self._every * self._sample_time
        self._adapt_forces(capped, age, seconds / _FORCE_TIMES[not learning])
        classes = np.searchsorted(_AGES, age) - 1  # −1: too young, or none
        levels = np.maximum(self.levels, 1.0)[:, classes]
        levelled = t / levels
        levelled *= (classes >= 0) & (self._begin <= self._latest_onset)
        self._adapt_levels(capped, classes, seconds / _LEVEL_TIMES[not learning])
        test, slot = divmod(int(levelled.argmax()), own.slots)
        precision = float(energy[test, slot])
        return ChangeEstimate(
            test=test,
            statistic=float(levelled[test, slot]),
            size=float(own.product[test, slot]) / precision,
            sd=math.sqrt(float(levels[test, slot]) / precision),
            since=float(age[slot]),
        )

    def _adapt_forces(self, capped: FloatArray, age: FloatArray, step: float) -> None:
        weights = ((age > _LEVELLING[0]) & (age <= _LEVELLING[1])).astype(float)
        count = weights.sum()
        if not count:
            return
        mean = capped[: 2 * len(self._equations_of) : 2] @ (weights / count)
        factors = np.ones(self._predictor.n_w)
        factors[self._equations_of] = np.exp(step * np.minimum(mean - 1.0, 3.0))
        self._predictor.adapt_forces(factors)

    def _adapt_levels(self, capped: FloatArray, classes: IntArray, step: float) -> None:
        members = (classes[:, None] == _CLASSES).astype(float)
        counts = members.sum(axis=0)
        mean = (capped @ members) / np.maximum(counts, 1.0)
        self.levels += step * (counts > 0) * (mean - self.levels)
