"""What may have changed, one thing at a time, simulated along the recordings in question."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import logsumexp

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.threads import SYMBOLS
from trms_cli.effects.constant_torque import ConstantTorque
from trms_cli.effects.effect import Effect, SensorEffect
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.gap.known_state import KnownState
from trms_cli.gap.problem import CandidateEffect, is_amplitude, variants
from trms_cli.gap.short_runs import MissingForces, ShortRuns
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FreeParameter
from trms_cli.models.model import names
from trms_cli.models.parameters import Parameter


@dataclass(frozen=True)
class NewRecordings:
    """Recordings in question, with nothing changed."""

    known_state: KnownState
    runs: ShortRuns
    starts: FloatArray  #: (m, n) array; of the runs
    forces: MissingForces  #: That are missing

    @classmethod
    def of(cls, known_state: KnownState, datasets: Sequence[Dataset]) -> "NewRecordings":
        """From recordings."""
        runs = ShortRuns(known_state.model, datasets)
        p = known_state.model.parameters.values
        starts = runs.starts(p)
        return cls(known_state, runs, starts, runs.forces(p, starts))


@dataclass(frozen=True)
class SensorJump:
    """What the window in which a sensor goes wrong shows, by the sample from which on it does."""

    equation: int
    change: FloatArray  #: (k, m, c) array; added to its force, as of :class:`DifferenceFamily`
    slope: FloatArray  #: (k, m, c) array


@dataclass(frozen=True)
class DifferenceFamily:
    """A difference in one shape, by stretches of its amplitude between values that are simulated.

    Within a stretch what it adds to the missing forces is ``change + part · slope``, part 0 to 1:
    exact for a torque, and for a friction too small or large enough to hold.
    """

    low: FloatArray  #: (k, n_s) array; all sizes where a stretch begins
    high: FloatArray  #: (k, n_s) array; and where it ends
    prior: FloatArray  #: (k,) array; log prior
    change: FloatArray  #: (k, m, e) array
    slope: FloatArray  #: (k, m, e) array
    jump: SensorJump | None = None  #: Where it is a sensor's; None: a force that begins


@dataclass(frozen=True)
class Difference:
    """One thing that may have changed."""

    name: str  #: Of the effect, of the parameter, or ``{axis}_disturbance``
    kind: Literal["effect", "parameter", "torque"]
    labels: tuple[str, ...]  #: Of its sizes
    units: tuple[str, ...]
    locations: tuple[str, ...]
    families: tuple[DifferenceFamily, ...]
    may_begin: bool = True  #: Within recordings; see :class:`~trms_cli.effects.effect.Effect`


def differences(
    questioned: NewRecordings,
    candidates: Mapping[str, CandidateEffect],
    *,
    only: Collection[str] | None = None,
    jobs: int = 1,
) -> Iterator[Difference]:
    """Everything that may have changed, simulated along the recordings in question.

    What diverges at every size is left out. ``only``: names of those that are wanted; None: all.
    """
    return (d for d in _every_difference(questioned, candidates, only, jobs) if d.families)


def _every_difference(
    questioned: NewRecordings,
    candidates: Mapping[str, CandidateEffect],
    only: Collection[str] | None,
    jobs: int,
) -> Iterator[Difference]:
    known_state, runs = questioned.known_state, questioned.runs
    for axis, mechanism in known_state.model.axes.items():
        name = f"{axis}_disturbance"
        is_measured = any(e.location == mechanism.moment for e in runs.equations)
        if is_measured and (only is None or name in only):
            effect = ConstantTorque(axis=axis)
            yield _of_effect(questioned, name, effect, (mechanism.moment,), "torque")
    for f in known_state.free:
        if only is None or f.name in only:
            yield _of_parameter(questioned, f)
    simulated = [c for c in candidates.values() if c.simulated and (only is None or c.name in only)]
    with ThreadPoolExecutor(max(1, jobs)) as pool:
        yield from pool.map(
            lambda c: _of_effect(questioned, c.name, c.effect, c.locations, "effect"), simulated
        )


def _of_parameter(questioned: NewRecordings, f: FreeParameter) -> Difference:
    runs, model = questioned.runs, questioned.known_state.model
    p = model.parameters.values
    at = model.parameters.names.index(f.name)
    steps = np.array([-x for x in reversed(_CHANGES)] + list(_CHANGES)) * f.scale
    steps = steps[(p[at] + steps > f.lower) & (p[at] + steps < f.upper)]
    if abs(p[at]) > _SURE_OF_SIGN * f.scale:
        steps = steps[p[at] * (p[at] + steps) > 0]
    if len(steps) < 2:  # its bounds leave no room
        return Difference(f.name, "parameter", ("change",), (f.unit,), (), ())
    starts: FloatArray | None = None
    forces: list[MissingForces] = []
    for step in steps:
        own = p.copy()
        own[at] += step
        if not forces:
            first = runs.starts(own)
            if np.max(np.abs(first - questioned.starts)) < _SAME_START:
                starts = questioned.starts
        forces.append(runs.forces(own, starts))
    between = (steps[1:] + steps[:-1]) / 2
    log_prior = np.log(np.diff(steps)) - 0.5 * (between / (_WIDTH * f.scale)) ** 2
    family = _family(steps[:, None], 0, log_prior, forces, questioned.forces)
    # equations of other units are compared by what each errs by in any second
    white = np.array([e.sizes.white for e in questioned.known_state.errors])
    moments = np.abs(family.change).sum(axis=(0, 1)) / white
    location = runs.equations[int(np.argmax(np.nan_to_num(moments)))].location
    families = _normalised([family])
    return Difference(f.name, "parameter", ("change",), (f.unit,), (location,), families)


#: Changes of a parameter that are tried, in deviations of its prior, and the deviation of what is
#: believed of a change: a fault is no draw from what is believed of a rig in order.
_CHANGES, _WIDTH = (0.5, 1.2, 3.0, 7.0, 16.0), 5.0
#: Deviations of its prior from zero on which no change turns a parameter's sign: a thrust that
#: pushes does not come to pull.
_SURE_OF_SIGN = 3.0
#: A parameter that moves no start by more than this moves none.
_SAME_START = 1e-6


def _of_effect(
    questioned: NewRecordings,
    name: str,
    effect: Effect,
    locations: tuple[str, ...],
    kind: Literal["effect", "torque"],
) -> Difference:
    own = effect.parameters()
    inverse = _SensorInverse.of(questioned, effect)
    simulated = inverse.forces if inverse else _simulated(questioned, name, effect)
    families = []
    for shape, at in _shapes(own):
        grid = _grid(own[at])
        rows = np.tile(shape, (len(grid), 1))
        rows[:, at] = grid
        forces = [simulated(row) for row in rows]
        equal = np.zeros(len(grid) - 1)
        family = _family(rows, at, equal, forces, questioned.forces)
        families.append(inverse.jumping(family) if inverse else family)
    labels, units = tuple(q.name for q in own), tuple(q.unit for q in own)
    return Difference(name, kind, labels, units, locations, _normalised(families), effect.may_begin)


@SYMBOLS
def _simulated(
    questioned: NewRecordings, name: str, effect: Effect
) -> Callable[[FloatArray], MissingForces]:
    """Missing forces with an effect in the model, by its sizes (n_s,)."""
    model = ExtendedModel(questioned.known_state.model, name, effect)
    runs = ShortRuns(model, questioned.runs.windows.datasets, like=questioned.runs)
    p = model.parameters.values
    # without states or memory of its own, it begins where the model beneath does
    same = runs.windows.rollout.n_x == questioned.runs.windows.rollout.n_x
    starts = questioned.starts if same else None

    def forces(sizes: FloatArray) -> MissingForces:
        p[-len(sizes) :] = sizes
        return runs.forces(p, starts)

    return forces


@dataclass(frozen=True)
class _SensorInverse:
    """A sensor's error, taken out of the recordings.

    Runs begin where measurements say: what a sensor that is late or biased shows is no start of
    the beam's.
    """

    questioned: NewRecordings
    effect: SensorEffect
    output: int  #: Position of its channel in the model's ``y``
    labels: tuple[str, ...]  #: Of its sizes

    @classmethod
    def of(cls, questioned: NewRecordings, effect: Effect) -> "_SensorInverse | None":
        """None where the effect is none of a sensor, or has no inverse."""
        if not isinstance(effect, SensorEffect):
            return None
        parameters = effect.parameters()
        labels = tuple(q.name for q in parameters)
        inverse = cls(questioned, effect, effect.row(questioned.known_state.model), labels)
        sizes = np.array([q.value for q in parameters])
        return None if None in inverse._corrected_datasets(sizes) else inverse

    def _corrected_datasets(self, sizes: FloatArray) -> list[Dataset | None]:
        of = dict(zip(self.labels, sizes.tolist(), strict=True))
        channel = self.questioned.known_state.model.outputs[self.output].name
        datasets: list[Dataset | None] = []
        for dataset in self.questioned.runs.windows.datasets:
            own: Dataset | None = dataset
            if channel in names(dataset.outputs):
                without = self.effect.inverse(dataset.output(channel), dataset.sample_time, of)
                own = None
                if without is not None:
                    measurements = dataset.measurements.copy()
                    measurements[:, names(dataset.outputs).index(channel)] = without
                    own = replace(dataset, measurements=measurements)
            datasets.append(own)
        return datasets

    def _runs(self, sizes: FloatArray) -> ShortRuns:
        datasets = [d for d in self._corrected_datasets(sizes) if d is not None]
        model = self.questioned.known_state.model
        return ShortRuns(model, datasets, like=self.questioned.runs)

    def forces(self, sizes: FloatArray) -> MissingForces:
        """Missing forces without the error, by its sizes (n_s,)."""
        forces = self._runs(sizes).forces(self.questioned.known_state.model.parameters.values)
        # the last samples of a recording have no later ones: nothing is said there
        unknown = np.isnan(forces.force)
        return MissingForces(
            np.where(unknown, self.questioned.forces.force, forces.force), forces.at_rest
        )

    def jumping(self, family: DifferenceFamily) -> DifferenceFamily:
        """With what the window shows in which the error begins."""
        runs = self.questioned.runs
        equation = next((k for k, e in enumerate(runs.equations) if e.output == self.output), None)
        if equation is None:
            return family
        target = runs.windows.target[..., self.output]
        low, high = (
            np.array(
                [
                    runs.jumps(
                        self._runs(sizes).windows.target[..., self.output] - target, equation
                    )
                    for sizes in values
                ]
            ).reshape(len(values), *target.shape)
            for values in (family.low, family.high)
        )
        return replace(family, jump=SensorJump(equation, low, high - low))


def _shapes(parameters: Sequence[Parameter]) -> list[tuple[FloatArray, int]]:
    """Sizes that give an effect its shape, with the position of the one that is its amplitude."""
    shapes: dict[tuple[float, ...], tuple[FloatArray, int]] = {}
    for row in variants(parameters):
        at = next((i for i in range(len(row)) if row[i] and is_amplitude(parameters, i)), 0)
        shape = row.copy()
        shape[at] = 0.0
        shapes.setdefault((at, *shape), (shape, at))
    return list(shapes.values())


def _grid(parameter: Parameter) -> FloatArray:
    """Amplitudes to simulate, to both sides where both make sense."""
    low, high = parameter.typical or (parameter.value / 3, parameter.value * 3)
    most = max(abs(low), abs(high))
    least = low if low > 0 else most / 10
    one = np.geomspace(least / 5, most * 2.5, _AMPLITUDES)
    both = low < 0 or parameter.lower < 0
    grid = np.concatenate([-one[::-1], one]) if both else one
    within = np.unique(np.clip(grid, parameter.lower, parameter.upper))
    return np.asarray(within[within != 0.0])


#: Amplitudes of an effect that are simulated, to one side.
_AMPLITUDES = 7


def _family(
    values: FloatArray,
    amplitude: int,
    log_prior: FloatArray,
    forces: Sequence[MissingForces],
    base: MissingForces,
) -> DifferenceFamily:
    """From forces at ascending amplitudes; ``log_prior``: of each stretch between two of them."""
    change = np.array([f.force for f in forces]) - base.force
    fine: BoolArray = np.array([np.isfinite(c[np.isfinite(base.force)]).all() for c in change])
    change = np.nan_to_num(change)
    size = values[:, amplitude]
    # what is too small to matter lies between the signs
    mask = fine[1:] & fine[:-1] & (size[1:] * size[:-1] > 0)
    prior = log_prior[mask] - logsumexp(log_prior[mask]) if mask.any() else log_prior[:0]
    slope = np.diff(change, axis=0)[mask]
    return DifferenceFamily(values[:-1][mask], values[1:][mask], prior, change[:-1][mask], slope)


def _normalised(families: Sequence[DifferenceFamily]) -> tuple[DifferenceFamily, ...]:
    nonempty = [f for f in families if len(f.prior)]
    return tuple(replace(f, prior=f.prior - np.log(len(nonempty))) for f in nonempty)
