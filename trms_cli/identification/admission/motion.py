"""Signs, units and places of channels by what a model makes of the recorded motion.

A rotor's speed must follow its command, and an axis' acceleration its rotor's thrust, with the sign
that the model gives. How much is left to chance: a channel is only called wrong where the
measurement is explained well the other way round.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.admission.issues import Issue, Severity
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.recorded_motion import RecordedMotion, RecordedMotions, smooth_motion
from trms_cli.models.model import Model, names
from trms_cli.models.rig_parts import parts_of

#: Correlation of a speed with what the command makes of it: clear, and none.
_CLEAR, _NONE = 0.6, 0.4
#: rpm in one rad/s, and what ratio counts as that.
_RPM, _RPM_SPREAD = 60 / (2 * np.pi), 2.0
_DEGREES, _DEGREES_SPREAD = 180 / np.pi, 2.5
#: Ratios of a rotor's speed to the model's within which a model is roughly right.
_ROUGHLY = 2.5
#: Share of the acceleration's variance that a thrust explains: clear, and little.
_EXPLAINS, _LITTLE = 0.3, 0.15
#: By how much a swapped reading must explain more.
_BETTER = 0.3
#: rad/s of the model's speed below which a rotor is at rest.
_TURNS = 5.0
_LEAST_SAMPLES = 100
#: rad by which a beam may be off the model's: counterweights of the priors move rest by some 0.1.
_OFF_LEVEL = 0.25
#: Zeros of its angle that are looked for, rad, and how finely.
_FARTHEST_ZERO, _ZERO_STEP = 1.5, 0.01
#: Share of the squared error of the acceleration that another zero must take away.
_ZERO_EXPLAINS = 0.5
#: Samples of a recording on which weight is evaluated.
_SPARSE = 1000


@dataclass(frozen=True)
class _Thrust:
    """How an axis answers to its rotor: ``α̈ = a·passive + b·thrust + c``."""

    factor: float  #: b
    share: float  #: of what the rest leaves, that the thrust explains
    explained: float  #: of the acceleration's variance, by all


def issues_by_model(dataset: Dataset, model: Model) -> list[Issue]:
    """What does not fit; empty where the model has no accelerations or the data are too few."""
    motions = RecordedMotions.possible(model)
    if motions is None or len(dataset) < _LEAST_SAMPLES:
        return []
    motion = motions.of(dataset)
    thrusts = _thrusts(dataset, motion)
    swapped = list(_swapped(dataset, motions, motion, thrusts))
    if swapped:
        return swapped
    speeds = list(_speeds(dataset, model, motion))
    issues = [*speeds, *_angles(dataset, motions, thrusts, {issue.channel for issue in speeds})]
    return issues or list(_zero(dataset, motions, motion))


def _speeds(dataset: Dataset, model: Model, motion: RecordedMotion) -> Iterator[Issue]:
    commands = {rotor.speed: rotor.input for rotor in model.rotors.values()}
    for name, (correlation, ratio) in _followed(dataset, motion).items():
        command, follows = commands[name], correlation > _CLEAR
        times = f"times what {command} makes of it"
        header = f"write the unit into the header: {name}"
        checks: tuple[tuple[bool, str, Severity, str, str], ...] = (
            (
                abs(correlation) < _NONE,
                "speed",
                "warning",
                f"{name} does not follow {command} (correlation {correlation:.2f})",
                "look at which channel is which, and at the tacho",
            ),
            (
                correlation < -_CLEAR,
                "sign",
                "error",
                f"{name} turns the other way than {command} makes it turn",
                f"one of the two has the wrong sign: turn round {name} or {command} in the file",
            ),
            (
                follows and _near(ratio, _RPM, _RPM_SPREAD),
                "unit",
                "error",
                f"{name} is {ratio:.3g} {times}: rpm read as rad/s",
                f"{header}[rpm]",
            ),
            (
                follows and _near(ratio, 1 / _RPM, _RPM_SPREAD),
                "unit",
                "error",
                f"{name} is {ratio:.3g} {times}: rad/s read as rpm",
                f"{header}[rad/s]",
            ),
            (
                follows and not 1 / _ROUGHLY < ratio < _ROUGHLY,
                "unit",
                "warning",
                f"{name} is {ratio:.2g} times what the model makes of {command}",
                f"is the model that of this rig? Are the units of {name} and {command} right?",
            ),
        )
        for applies, check, severity, problem, remedy in checks:
            if applies:
                yield Issue(check, severity, dataset.name, name, problem, remedy)
                break


def _angles(
    dataset: Dataset, motions: RecordedMotions, thrusts: dict[str, _Thrust], wrong: set[str]
) -> Iterator[Issue]:
    """``wrong``: speeds that are; what these rotors turn is not judged."""
    parts = parts_of(motions.model)
    for name, thrust in thrusts.items():
        axis = next(own for own, one in parts.axes.items() if one.angle == name)
        rotor = parts.rotors.get(parts.drive_of(axis))
        if rotor is None or rotor.speed in wrong:
            continue
        command = rotor.input
        upwards = f" ({parts.beam} is positive upwards)" if parts.beam else ""
        if thrust.factor < 0 and (
            thrust.share > _EXPLAINS or _turned_round(dataset, motions, name, thrust)
        ):
            yield Issue(
                "sign",
                "error",
                dataset.name,
                name,
                f"{name} moves the other way than {command} drives it in the model",
                f"turn round the sign of {name}{upwards} or of {command} in the file",
            )
        elif thrust.share < _EXPLAINS:
            continue
        elif _near(thrust.factor, _DEGREES, _DEGREES_SPREAD):
            yield Issue(
                "unit",
                "error",
                dataset.name,
                name,
                f"{name} moves {thrust.factor:.3g} times as far as it should: degrees read as rad",
                f"write the unit into the header: {name}[deg]",
            )


def _zero(dataset: Dataset, motions: RecordedMotions, motion: RecordedMotion) -> Iterator[Issue]:
    """Whether the angle of a beam is counted from another zero than that of the level beam.

    Over a recording it goes nowhere, so its mean acceleration is that of weight and thrust
    in balance; the angle that must be added for it is where zero is.
    """
    parts = parts_of(motions.model)
    name = parts.axes[parts.beam].angle if parts.beam else ""
    if name not in motion.accelerations:
        return
    off = _imbalance(dataset, motion, name)
    if off is None:
        return
    angle = dataset.output(name)
    angle = angle[np.isfinite(angle)]
    angle = angle[:: max(1, len(angle) // _SPARSE)]
    count = round(_FARTHEST_ZERO / _ZERO_STEP)
    shifts = _ZERO_STEP * np.arange(-count, count + 1)
    weight = motions.at_rest(name, np.add.outer(shifts, angle).ravel())
    mean = weight.reshape(len(shifts), len(angle)).mean(axis=1)
    # Only where weight draws back: the other root is the beam upside down.
    balance = np.mean(off) + mean[count] - mean
    roots = np.flatnonzero((balance[:-1] < 0) & (balance[1:] >= 0))
    if not len(roots):
        return
    k = int(roots[np.argmin(np.abs(shifts[roots]))])
    shift = float(shifts[k] - balance[k] * _ZERO_STEP / (balance[k + 1] - balance[k]))
    if abs(shift) < _OFF_LEVEL:
        return
    measurements = dataset.measurements.copy()
    measurements[:, names(dataset.outputs).index(name)] += shift
    candidate = replace(dataset, measurements=measurements)
    again = _imbalance(candidate, motions.of(candidate), name)
    if again is None or again @ again > (1 - _ZERO_EXPLAINS) * (off @ off):
        return
    rest = float(motions.model.rest()[motions.model.state_index(name)])
    hanging = ""
    if abs(shift - rest) < _OFF_LEVEL:
        hanging = ", as an encoder that was switched on while the beam hung"
    yield Issue(
        "zero",
        "warning",
        dataset.name,
        name,
        f"{name} is off by a constant {-shift:.2f} rad: the model counts {parts.beam} from the "
        f"level beam and hangs at {rest:.2f} rad without thrust{hanging}",
        f"if so: 'data.offset={{{name}: {rest if hanging else shift:.2f}}}' adds it; if the beam "
        "is balanced otherwise or the thrusts are, leave it",
    )


def _imbalance(dataset: Dataset, motion: RecordedMotion, name: str) -> FloatArray | None:
    """Measured acceleration less the model's, rad/s², where it can be told."""
    measured, modelled = motion.accelerations[name], motion.passive[name] + motion.thrust[name]
    rows = np.isfinite(measured)
    if np.count_nonzero(rows) < _LEAST_SAMPLES or not np.isfinite(modelled).all():
        return None
    return np.asarray(measured - smooth_motion(modelled, dataset.sample_time))[rows]


def _turned_round(dataset: Dataset, motions: RecordedMotions, name: str, thrust: _Thrust) -> bool:
    """Whether an angle is explained well with its sign turned round, and poorly as it is."""
    measurements = dataset.measurements.copy()
    measurements[:, names(dataset.outputs).index(name)] *= -1
    other = replace(dataset, measurements=measurements)
    again = _thrusts(other, motions.of(other)).get(name)
    if again is None or again.factor < 0 or again.share < _EXPLAINS:
        return False
    return again.explained - thrust.explained > _BETTER


def _swapped(
    dataset: Dataset, motions: RecordedMotions, motion: RecordedMotion, thrusts: dict[str, _Thrust]
) -> Iterator[Issue]:
    """Whether two inputs, or the two angles, are in each other's place."""
    inputs, parts = names(dataset.inputs), parts_of(motions.model)
    rotors = {rotor.input: own for own, rotor in parts.rotors.items()}
    axes = {axis.angle: own for own, axis in parts.axes.items()}
    poor = [t for t in thrusts.values() if t.share < _LITTLE or t.factor < 0]
    followed = _followed(dataset, motion)
    weak_correlations = [c for c, _ in followed.values() if c < _CLEAR]
    is_weak = bool(weak_correlations or (not followed and poor))
    if len(rotors) == 2 and set(rotors) <= set(inputs) and is_weak:
        one, two = rotors
        i, j = inputs.index(one), inputs.index(two)
        other = replace(dataset, commands=_exchanged(dataset.commands, i, j))
        other_motion = motions.of(other)
        again = _followed(other, other_motion)
        if followed:
            gain = min(c for c, _ in again.values()) - min(c for c, _ in followed.values())
            better = len(again) == len(followed) and min(c for c, _ in again.values()) > _CLEAR
        else:
            gain = _mean_explained(_thrusts(other, other_motion)) - _mean_explained(thrusts)
            better = all(
                t.factor > 0 and t.share > _EXPLAINS for t in _thrusts(other, other_motion).values()
            )
        if better and gain > _BETTER:
            yield Issue(
                "swapped",
                "error",
                dataset.name,
                one,
                f"{one} and {two} are in each other's place: the motion follows them the other way "
                "round",
                f"swap the two columns' names ({one} is the {rotors[one]} rotor); if the speeds "
                "are recorded, theirs may be swapped instead",
            )
            return
    if len(poor) == len(axes) == 2 and set(axes) == set(thrusts):
        one, two = axes
        i, j = (names(dataset.outputs).index(name) for name in axes)
        other = replace(dataset, measurements=_exchanged(dataset.measurements, i, j))
        again_thrusts = _thrusts(other, motions.of(other))
        right = all(t.factor > 0 and t.share > _EXPLAINS for t in again_thrusts.values())
        if right and _mean_explained(again_thrusts) - _mean_explained(thrusts) > _BETTER:
            yield Issue(
                "swapped",
                "error",
                dataset.name,
                one,
                f"{one} and {two} are in each other's place: each moves as the other should",
                f"swap the two columns' names ({one} is {axes[one]})",
            )


def _exchanged(values: FloatArray, i: int, j: int) -> FloatArray:
    order = list(range(values.shape[1]))
    order[i], order[j] = j, i
    return np.ascontiguousarray(values[:, order])


def _followed(dataset: Dataset, motion: RecordedMotion) -> dict[str, tuple[float, float]]:
    """Correlation and ratio of each measured speed to the model's, where the rotor turns."""
    statistics = {}
    for name, modelled in motion.speeds.items():
        if name not in names(dataset.outputs):
            continue
        measured = dataset.output(name)
        rows = np.isfinite(measured)
        y, x = measured[rows], modelled[rows]
        if len(y) < _LEAST_SAMPLES or not np.isfinite(x).all():
            continue
        if np.std(x) < _TURNS or np.std(y) == 0:
            continue
        statistics[name] = (float(np.corrcoef(y, x)[0, 1]), float(y @ x / (x @ x)))
    return statistics


def _thrusts(dataset: Dataset, motion: RecordedMotion) -> dict[str, _Thrust]:
    thrusts = {}
    for name, acceleration in motion.accelerations.items():
        rows = np.isfinite(acceleration)
        step = dataset.sample_time
        if np.count_nonzero(rows) < _LEAST_SAMPLES:
            continue
        modelled = (motion.passive[name], motion.thrust[name])
        if not np.isfinite(modelled).all():  # the model's rotors ran away
            continue
        passive, thrust = (smooth_motion(values, step)[rows] for values in modelled)
        if np.std(thrust) == 0:
            continue
        y = acceleration[rows]
        others = np.column_stack([passive, np.ones(len(y))])
        residual = _remainder(y, others)
        rest, error = residual, _remainder(y, np.column_stack([others, thrust]))
        beside = _remainder(thrust, others)
        factor = float(beside @ residual / max(float(beside @ beside), 1e-300))
        spread = max(float(np.sum((y - y.mean()) ** 2)), 1e-300)
        thrusts[name] = _Thrust(
            factor,
            1 - float(error @ error) / max(float(rest @ rest), 1e-300),
            1 - float(error @ error) / spread,
        )
    return thrusts


def _mean_explained(thrusts: dict[str, _Thrust]) -> float:
    """Mean share that is explained with the right sign; 0 for none."""
    if not thrusts:
        return 0.0
    return float(np.mean([t.explained if t.factor > 0 else 0.0 for t in thrusts.values()]))


def _remainder(y: FloatArray, regressors: FloatArray) -> FloatArray:
    scale = np.maximum(np.abs(regressors).max(axis=0), 1e-300)
    return y - regressors / scale @ np.linalg.lstsq(regressors / scale, y, rcond=1e-9)[0]


def _near(ratio: float, value: float, spread: float) -> bool:
    return value / spread < ratio < value * spread
