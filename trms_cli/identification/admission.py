"""Whether recordings can tell what is asked of them, before any fit or comparison.

What makes every result wrong is an error, with what to record or to change instead; what is a
matter of degree is a warning that stands in the report. Nothing is mended here.

Signs, units and places of channels are told by what a model makes of the recorded motion: a rotor's
speed must follow its command, and an axis' acceleration its rotor's thrust, with the sign that the
model gives. How much is left to chance: a channel is only called wrong where the measurement is
explained well the other way round.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import RecordingError
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.recorded_motion import RecordedMotion, RecordedMotions, smooth_motion
from trms_cli.models.model import Model, names
from trms_cli.models.vector_field import VectorField

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Issue:
    """Something that is wrong with a recording, or not as good as it might be."""

    check: str  #: What was looked at, in one word or two
    severity: Severity  #: "error" or "warning"
    dataset: str  #: Name; empty for all together
    channel: str  #: Input or output; empty for the whole recording
    problem: str  #: A sentence
    remedy: str  #: What to record or to change instead

    def __str__(self) -> str:
        place = f"{self.dataset}: " if self.dataset else ""
        return f"{place}{self.problem} ({self.remedy})"


@dataclass(frozen=True)
class Admission:
    """What was found."""

    issues: tuple[Issue, ...]  #: Errors first

    @property
    def errors(self) -> tuple[Issue, ...]:
        return tuple(issue for issue in self.issues if issue.severity == "error")

    @property
    def warnings(self) -> tuple[Issue, ...]:
        return tuple(issue for issue in self.issues if issue.severity == "warning")

    def require(self) -> None:
        """Raise if there is an error.

        Raises RecordingError: Of the first error; the others are listed below its remedy.
        """
        errors = self.errors
        if not errors:
            return
        first, *others = errors
        remedy = "\n".join([first.remedy, *(f"also: {issue}" for issue in others)])
        raise RecordingError(first.problem, where=first.dataset or "real", remedy=remedy)

    def as_data(self) -> list[dict[str, str]]:
        """For a JSON document."""
        return [asdict(issue) for issue in self.issues]


def merge_admissions(admissions: Mapping[str, Admission]) -> Admission:
    """What was found with several models; what does not hold for all names those that it is of.

    ``admissions``: by the name that the model is shown with.
    """
    holders: dict[Issue, list[str]] = {}
    for name, admission in admissions.items():
        for issue in admission.issues:
            holders.setdefault(issue, []).append(name)
    return by_severity(
        issue
        if len(models) == len(admissions)
        else replace(issue, problem=f"{', '.join(models)}: {issue.problem}")
        for issue, models in holders.items()
    )


def by_severity(issues: Iterable[Issue]) -> Admission:
    """Errors first, each kind in its order."""
    return Admission(tuple(sorted(issues, key=lambda issue: issue.severity != "error")))


Purpose = Literal["fit", "validation"]

#: Samples below which nothing is fitted, and samples a free parameter.
_LEAST_TO_FIT, _SAMPLES_A_PARAMETER = 50, 10
#: Share of the slowest mode's period that the recordings must last; and that they should.
_LEAST_PERIODS, _GOOD_PERIODS = 0.5, 2.0
#: Share of that period from which on the motion of an axis tells its sign for certain.
_TELLING_PERIODS = 1.0
#: What keeps a model from being fitted, and yet may be held against one.
_ONLY_FOR_A_FIT = ("constant", "excitation", "saturation")
#: Share of the time at the limits: throughout, and worth a word.
_SATURATED, _OFTEN_SATURATED = 0.95, 0.3
#: Commands beyond the limit by this factor are another unit; by the lesser one, not yet cut.
_OTHER_UNIT, _UNCUT = 3.0, 1.05
#: Angles beyond the stops by this factor are another unit.
_BEYOND_STOPS = 1.5
#: rad; without stops, no axis goes farther.
_FARTHEST = 4 * np.pi
#: Commands whose largest is below this share of the limit.
_TINY = 0.02
_MOST_MISSING = 0.5
#: Standard deviations of its noise that an output must move by to be seen at all, and well.
_SEEN, _SEEN_WELL = 5.0, 20.0
#: Largest command that may be per cent of the limit.
_PER_CENT = 105.0
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
#: 1/s: faster modes are armature currents, slower ones integrate.
_FASTEST_MODE, _SLOWEST_MODE = 100.0, 0.02
_LEAST_SAMPLES = 100
#: rad by which pitch may be off the model's: counterweights of the priors move rest by some 0.1.
_OFF_PITCH = 0.25
#: Zeros of pitch that are looked for, rad, and how finely.
_FARTHEST_ZERO, _ZERO_STEP = 1.5, 0.01
#: Share of the squared error of the acceleration that another zero must take away.
_ZERO_EXPLAINS = 0.5
#: Samples of a recording on which weight is evaluated.
_SPARSE = 1000
#: s; up to here a sample time is slow, no more.
_SLOW = 1.0
#: Samples that a period of the fastest mode needs.
_SAMPLES_A_PERIOD = 6.0


def admit(
    datasets: Sequence[Dataset], model: Model, free_parameters: int = 0, purpose: Purpose = "fit"
) -> Admission:
    """Check recordings against what is to be done with them.

    ``datasets``: as loaded for the model, before rotor speeds are made inputs. ``model``: roughly
    right is enough; signs and swapped channels are only looked for where it has equations (not for
    a black box). ``free_parameters``: how many are to be fitted. A validation demands no length,
    and commands or axes that rest are worth a word only, unless nothing moves at all.
    """
    issues: list[Issue] = []
    for dataset in datasets:
        slow = too_slow(dataset, model)
        if slow is not None:  # nothing can be simulated between such samples
            issues.append(slow)
            continue
        own = [*_inputs(dataset, model), *_outputs(dataset, model)]
        broken = {issue.check for issue in own if issue.severity == "error"}
        moving = dataset
        if purpose == "validation" and "constant" in broken:
            moving = _moving_part(dataset)
            broken.discard("constant")
        if not broken:
            own += _by_model(moving, model)
        issues += own
    if purpose == "fit":
        issues += _length(datasets, model, free_parameters)
    else:
        issues = [_as_warning(i) if i.check in _ONLY_FOR_A_FIT else i for i in issues]
        issues += _still(datasets)
    issues += _rates(datasets, model)
    return by_severity(issues)


def _as_warning(issue: Issue) -> Issue:
    return replace(issue, severity="warning")


def _moving_part(dataset: Dataset) -> Dataset:
    """Without the outputs that are constant: the motion of the others tells their places."""
    kept = [i for i, y in enumerate(dataset.measurements.T) if np.nanmax(y) > np.nanmin(y)]
    return replace(
        dataset,
        outputs=tuple(dataset.outputs[i] for i in kept),
        measurements=np.ascontiguousarray(dataset.measurements[:, kept]),
        noise_sd=dataset.noise_sd[kept],
    )


def _still(datasets: Sequence[Dataset]) -> Iterator[Issue]:
    """Where nothing moves, every model that rests is right."""
    columns = [y[np.isfinite(y)] for d in datasets for y in d.measurements.T]
    if not any(len(y) and np.ptp(y) > 0 for y in columns):
        yield Issue(
            "excitation",
            "error",
            "",
            "",
            f"nothing moves in {', '.join(d.source for d in datasets)}",
            "record the rig while its commands step or sweep over the range that matters",
        )


def _by_model(dataset: Dataset, model: Model) -> Iterator[Issue]:
    """Issues by the model: less certain, or none, where the recording is short for it.

    Over less than a period of the slowest mode an axis may swing against its thrust for other
    reasons (what it did before): in one of sixteen parts of half a period of simulated rigs.
    """
    issues = issues_by_model(dataset, model)
    scales = time_scales(dataset, model) if issues else None
    periods = dataset.duration / scales.slowest if scales is not None else np.inf
    for issue in issues:
        if issue.check in ("sign", "swapped") and not issue.channel.startswith("omega"):
            if periods < _LEAST_PERIODS:
                continue
            if periods < _TELLING_PERIODS:
                issue = _as_warning(issue)
        yield issue


def _inputs(dataset: Dataset, model: Model) -> Iterator[Issue]:
    limits = [model.input_limits.get(signal.name, np.inf) for signal in dataset.inputs]
    moving, saturated, commanded = [], [], []
    for signal, limit, u in zip(dataset.inputs, limits, dataset.commands.T, strict=True):
        largest = float(np.abs(u).max())
        name, unit = signal.name, signal.unit
        moving.append(float(np.ptp(u)) > 1e-6 * limit if np.isfinite(limit) else np.ptp(u) > 0)
        if largest == 0:
            continue
        commanded.append(name)
        if largest > _OTHER_UNIT * limit:
            remedy = "correct the unit in the file's header, or tell what a recorded 1 is"
            if largest <= _PER_CENT:  # of any other unit nothing is known
                scale = f"{{{name}: {limit / 100:.4g}}}"
                remedy += f"; if it is per cent of the limit: 'data.input_scale={scale}'"
            else:
                remedy += f" with data.input_scale.{name}"
            yield Issue(
                "unit",
                "error",
                dataset.name,
                name,
                f"{name} reaches {largest:.4g} {unit}, {largest / limit:.3g} times the limit of "
                f"{limit:g} {unit} of model {model.name!r}",
                remedy,
            )
            continue
        if largest > _UNCUT * limit:
            beyond = float(np.mean(np.abs(u) > limit))
            yield Issue(
                "limit",
                "warning",
                dataset.name,
                name,
                f"{name} is beyond the limit of {limit:g} {unit} for {beyond:.1%} of the time, up "
                f"to {largest:.4g} {unit}",
                "record what reaches the rig, after its limits; models do not cut what is recorded",
            )
        elif largest < _TINY * limit:
            yield Issue(
                "unit",
                "warning",
                dataset.name,
                name,
                f"{name} never exceeds {largest:.3g} {unit}, {largest / limit:.1%} of its limit",
                "is it in another unit? data.input_scale tells what a recorded 1 is",
            )
        share = float(np.mean(np.abs(u) >= 0.98 * limit))
        steady = bool(np.mean(np.diff(u) == 0) > _SATURATED) and share > _SATURATED
        saturated.append(steady)
        if not steady and share > _OFTEN_SATURATED and len(np.unique(np.abs(u))) > 3:
            yield Issue(
                "saturation",
                "warning",
                dataset.name,
                name,
                f"{name} is at its limit for {share:.0%} of the time",
                "smaller references or slower control tell more about the rig",
            )
    rotors = ", ".join(names(dataset.inputs))
    if saturated and all(saturated) and len(saturated) == len(commanded):
        yield Issue(
            "saturation",
            "error",
            dataset.name,
            "",
            f"{', '.join(commanded)}: at the limit throughout",
            "record with commands within their limits, as `trms excite` designs them",
        )
    elif not any(moving):
        moved = any(_moved(dataset, s.name) > _SEEN_WELL for s in dataset.outputs)
        free = not commanded and moved
        yield Issue(
            "excitation",
            "warning" if free else "error",
            dataset.name,
            "",
            f"the inputs never move ({rotors} constant)"
            + (": only the free motion can be told, nothing of the rotors" if free else ""),
            "record with commands that move, as `trms excite` designs them",
        )
    else:
        for signal, moves in zip(dataset.inputs, moving, strict=True):
            if not moves:
                yield Issue(
                    "excitation",
                    "warning",
                    dataset.name,
                    signal.name,
                    f"{signal.name} never moves",
                    "nothing can be told of its rotor from this; move both, or fix its parameters",
                )


def _outputs(dataset: Dataset, model: Model) -> Iterator[Issue]:
    for signal, y in zip(dataset.outputs, dataset.measurements.T, strict=True):
        name, there = signal.name, y[np.isfinite(y)]
        leave = _without(dataset, name)
        if len(there) < 2:
            count = "only a" if len(there) else "not a"
            yield Issue(
                "missing", "error", dataset.name, name, f"{name} has {count} single value", leave
            )
            continue
        if float(np.ptp(there)) == 0:
            yield Issue(
                "constant",
                "error",
                dataset.name,
                name,
                f"{name} is constant at {there[0]:.4g} {signal.unit}",
                f"look at its sensor and record again; if the axis was locked, choose a model of "
                f"the other axis alone; or {leave}",
            )
            continue
        missing = 1 - len(there) / len(y)
        if missing > _MOST_MISSING:
            yield Issue(
                "missing",
                "warning",
                dataset.name,
                name,
                f"{name} is missing for {missing:.0%}",
                f"look at its sensor, or {leave}",
            )
        stop = model.stops.get(name, np.inf)
        farthest = min(_BEYOND_STOPS * stop, _FARTHEST) if signal.unit == "rad" else np.inf
        largest = float(np.abs(there).max())
        if largest > farthest:
            limit = f"the stops are at ±{stop:.3g} rad" if np.isfinite(stop) else "no rig turns so"
            hint = ""
            if np.radians(largest) <= farthest:
                hint = f": as degrees it were {np.radians(largest):.3g} rad"
            yield Issue(
                "unit",
                "error",
                dataset.name,
                name,
                f"{name} reaches {largest:.4g} rad, and {limit}{hint}",
                f"write the unit that it is in into the header, as {name}[deg]",
            )
            continue
        seen = _moved(dataset, name)
        if seen < _SEEN:
            yield Issue(
                "excitation",
                "warning",
                dataset.name,
                name,
                f"{name} hardly moves: {np.std(there):.3g} {signal.unit}, "
                f"{seen:.2g} times its noise",
                "record with larger commands, as `trms excite` designs them",
            )


def _length(datasets: Sequence[Dataset], model: Model, free: int) -> Iterator[Issue]:
    samples = sum(len(d) for d in datasets)
    needed = max(_LEAST_TO_FIT, _SAMPLES_A_PARAMETER * free)
    if samples < needed:
        demand = f" for {free} free parameters" if free else ""
        yield Issue(
            "length",
            "error",
            "",
            "",
            f"{samples} samples in all{demand}",
            f"record at least {needed} samples",
        )
        return
    scales = [s for s in (time_scales(d, model) for d in datasets) if s is not None]
    if not scales:
        return
    slowest = max(scale.slowest for scale in scales)
    longest = max(d.duration for d in datasets)
    if longest < _GOOD_PERIODS * slowest:
        certain = longest < _LEAST_PERIODS * slowest
        yield Issue(
            "length",
            "error" if certain else "warning",
            "",
            "",
            f"the longest recording has {longest:.3g} s, and the slowest mode of model "
            f"{model.name!r} a period of {slowest:.3g} s",
            f"record at least {_GOOD_PERIODS * slowest:.0f} s at a stretch",
        )


def _rates(datasets: Sequence[Dataset], model: Model) -> Iterator[Issue]:
    steps = sorted({round(d.sample_time, 9) for d in datasets})
    own = model.sample_time
    for dataset in datasets:
        ratio = dataset.sample_time / own if own else 1.0
        if own and (round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio):
            yield Issue(
                "sample time",
                "error",
                dataset.name,
                "",
                f"sampled every {dataset.sample_time:g} s, and model {model.name!r} steps by "
                f"{own:g} s",
                f"resample: data.resample={own:g}",
            )
        scale = time_scales(dataset, model)
        slow = scale is not None and dataset.sample_time > scale.fastest / _SAMPLES_A_PERIOD
        if scale and slow and too_slow(dataset, model) is None:
            yield Issue(
                "sample time",
                "warning",
                dataset.name,
                "",
                f"sampled every {dataset.sample_time:g} s, and the fastest mode of model "
                f"{model.name!r} has a period of {scale.fastest:.2g} s",
                f"record at least every {scale.fastest / _SAMPLES_A_PERIOD:.2g} s",
            )
    if len(steps) > 1:
        words = ", ".join(f"{step:g}" for step in steps)
        yield Issue(
            "sample time",
            "warning",
            "",
            "",
            f"the recordings have sample times of {words} s",
            f"methods that need one take them with data.resample={steps[-1]:g}",
        )


def _without(dataset: Dataset, name: str) -> str:
    others = [other for other in names(dataset.outputs) if other != name]
    if not others:
        return "record another output"
    return f"leave it out: 'data.channels=[{', '.join(others)}]'"


def _moved(dataset: Dataset, name: str) -> float:
    """Standard deviation of an output over that of its noise."""
    index = names(dataset.outputs).index(name)
    y: FloatArray = dataset.measurements[:, index]
    if not np.isfinite(y).any():
        return 0.0
    return float(np.nanstd(y) / max(float(dataset.noise_sd[index]), 1e-9))


@dataclass(frozen=True)
class TimeScales:
    """Periods of a model's slowest and fastest mode, s (2π over the pole's distance from 0)."""

    slowest: float
    fastest: float


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
    speeds = list(_speeds(dataset, motion))
    named = {finding.channel[-2:] for finding in speeds}
    found = [*speeds, *_angles(dataset, motions, thrusts, named)]
    return found or list(_zero(dataset, motions, motion))


def time_scales(dataset: Dataset, model: Model) -> TimeScales | None:
    """From the model's poles where the recording is on average; None for a black box."""
    if model.sample_time is not None:
        return None
    point = model.rest().copy()
    for i, signal in enumerate(dataset.outputs):
        values = dataset.measurements[:, i]
        if signal.name in model.state_names and np.isfinite(values).any():
            size = values if signal.unit == "rad" else np.abs(values)
            point[model.state_index(signal.name)] = float(np.nanmean(size))
    a, _ = VectorField(model).linearised(point, dataset.commands.mean(axis=0))
    if not np.isfinite(a).all():
        return None
    sizes = np.abs(np.linalg.eigvals(a))
    sizes = sizes[(sizes > _SLOWEST_MODE) & (sizes < _FASTEST_MODE)]
    if not len(sizes):
        return None
    return TimeScales(2 * np.pi / float(sizes.min()), 2 * np.pi / float(sizes.max()))


def _speeds(dataset: Dataset, motion: RecordedMotion) -> Iterator[Issue]:
    for name, (correlation, ratio) in _followed(dataset, motion).items():
        command, follows = f"u{name[-2:]}", correlation > _CLEAR
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
    dataset: Dataset, motions: RecordedMotions, thrusts: dict[str, _Thrust], told: set[str]
) -> Iterator[Issue]:
    for name, thrust in thrusts.items():
        if name[-2:] in told:
            continue
        command = f"u{name[-2:]}"
        if thrust.factor < 0 and (
            thrust.share > _EXPLAINS or _turned_round(dataset, motions, name, thrust)
        ):
            yield Issue(
                "sign",
                "error",
                dataset.name,
                name,
                f"{name} moves the other way than {command} drives it in the model",
                f"turn round the sign of {name} (pitch is positive upwards) or of {command} in "
                "the file",
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
    """Whether pitch is counted from another zero than the level beam.

    Over a recording pitch goes nowhere, so its mean acceleration is that of weight and thrust
    in balance; the angle that must be added for it is where zero is.
    """
    name = "alpha_v"
    if name not in motion.accelerations:
        return
    off = _imbalance(dataset, motion, name)
    if off is None:
        return
    pitch = dataset.output(name)
    pitch = pitch[np.isfinite(pitch)]
    pitch = pitch[:: max(1, len(pitch) // _SPARSE)]
    count = round(_FARTHEST_ZERO / _ZERO_STEP)
    shifts = _ZERO_STEP * np.arange(-count, count + 1)
    weight = motions.at_rest(name, np.add.outer(shifts, pitch).ravel())
    mean = weight.reshape(len(shifts), len(pitch)).mean(axis=1)
    # Only where weight draws back: the other root is the beam upside down.
    balance = np.mean(off) + mean[count] - mean
    roots = np.flatnonzero((balance[:-1] < 0) & (balance[1:] >= 0))
    if not len(roots):
        return
    k = int(roots[np.argmin(np.abs(shifts[roots]))])
    shift = float(shifts[k] - balance[k] * _ZERO_STEP / (balance[k + 1] - balance[k]))
    if abs(shift) < _OFF_PITCH:
        return
    measurements = dataset.measurements.copy()
    measurements[:, names(dataset.outputs).index(name)] += shift
    moved = replace(dataset, measurements=measurements)
    again = _imbalance(moved, motions.of(moved), name)
    if again is None or again @ again > (1 - _ZERO_EXPLAINS) * (off @ off):
        return
    rest = float(motions.model.rest()[motions.model.state_index(name)])
    hanging = ""
    if abs(shift - rest) < _OFF_PITCH:
        hanging = ", as an encoder that was switched on while the beam hung"
    yield Issue(
        "zero",
        "warning",
        dataset.name,
        name,
        f"{name} is off by a constant {-shift:.2f} rad: the model counts pitch from the level "
        f"beam and hangs at {rest:.2f} rad without thrust{hanging}",
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
    inputs = names(dataset.inputs)
    poor = [t for t in thrusts.values() if t.share < _LITTLE or t.factor < 0]
    followed = _followed(dataset, motion)
    lost = [c for c, _ in followed.values() if c < _CLEAR]
    if "u_v" in inputs and "u_h" in inputs and (lost or (not followed and poor)):
        i, j = inputs.index("u_v"), inputs.index("u_h")
        other = replace(dataset, commands=_exchanged(dataset.commands, i, j))
        moved = motions.of(other)
        again = _followed(other, moved)
        if followed:
            gain = min(c for c, _ in again.values()) - min(c for c, _ in followed.values())
            better = len(again) == len(followed) and min(c for c, _ in again.values()) > _CLEAR
        else:
            gain = _told(_thrusts(other, moved)) - _told(thrusts)
            better = all(
                t.factor > 0 and t.share > _EXPLAINS for t in _thrusts(other, moved).values()
            )
        if better and gain > _BETTER:
            yield Issue(
                "swapped",
                "error",
                dataset.name,
                "u_v",
                "u_v and u_h are in each other's place: the motion follows them the other way "
                "round",
                "swap the two columns' names (u_v is the main rotor); if the speeds are "
                "recorded, theirs may be swapped instead",
            )
            return
    if len(poor) == 2 and "alpha_v" in thrusts and "alpha_h" in thrusts:
        i, j = (names(dataset.outputs).index(name) for name in ("alpha_v", "alpha_h"))
        other = replace(dataset, measurements=_exchanged(dataset.measurements, i, j))
        again_thrusts = _thrusts(other, motions.of(other))
        right = all(t.factor > 0 and t.share > _EXPLAINS for t in again_thrusts.values())
        if right and _told(again_thrusts) - _told(thrusts) > _BETTER:
            yield Issue(
                "swapped",
                "error",
                dataset.name,
                "alpha_v",
                "alpha_v and alpha_h are in each other's place: each moves as the other should",
                "swap the two columns' names (alpha_v is pitch)",
            )


def _exchanged(values: FloatArray, i: int, j: int) -> FloatArray:
    order = list(range(values.shape[1]))
    order[i], order[j] = j, i
    return np.ascontiguousarray(values[:, order])


def _followed(dataset: Dataset, motion: RecordedMotion) -> dict[str, tuple[float, float]]:
    """Correlation and ratio of each measured speed to the model's, where the rotor turns."""
    found = {}
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
        found[name] = (float(np.corrcoef(y, x)[0, 1]), float(y @ x / (x @ x)))
    return found


def _thrusts(dataset: Dataset, motion: RecordedMotion) -> dict[str, _Thrust]:
    found = {}
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
        left = _left(y, others)
        rest, error = left, _left(y, np.column_stack([others, thrust]))
        beside = _left(thrust, others)
        factor = float(beside @ left / max(float(beside @ beside), 1e-300))
        spread = max(float(np.sum((y - y.mean()) ** 2)), 1e-300)
        found[name] = _Thrust(
            factor,
            1 - float(error @ error) / max(float(rest @ rest), 1e-300),
            1 - float(error @ error) / spread,
        )
    return found


def _told(thrusts: dict[str, _Thrust]) -> float:
    """Mean share that is explained with the right sign; 0 for none."""
    if not thrusts:
        return 0.0
    return float(np.mean([t.explained if t.factor > 0 else 0.0 for t in thrusts.values()]))


def _left(y: FloatArray, regressors: FloatArray) -> FloatArray:
    scale = np.maximum(np.abs(regressors).max(axis=0), 1e-300)
    return y - regressors / scale @ np.linalg.lstsq(regressors / scale, y, rcond=1e-9)[0]


def _near(ratio: float, value: float, spread: float) -> bool:
    return value / spread < ratio < value * spread


def too_slow(dataset: Dataset, model: Model) -> Issue | None:
    """What to say of a sample longer than 1 s and than a period of the model's fastest mode.

    None for any other, and for a model that steps by a time of its own.
    """
    step = dataset.sample_time
    if step <= _SLOW or model.sample_time is not None:
        return None
    scale = time_scales(dataset, model)
    if scale is None or step <= scale.fastest:
        return None
    return Issue(
        "sample time",
        "error",
        dataset.name,
        "",
        f"{step:.4g} s a sample, and the fastest mode of model {model.name!r} has a period of "
        f"{scale.fastest:.2g} s",
        "is t in ms? Then write t[ms] into the header; if it is not, record at least every "
        f"{scale.fastest / _SAMPLES_A_PERIOD:.2g} s",
    )


def require_sample_time(dataset: Dataset, model: Model) -> None:
    """Refuse a recording between whose samples nothing can be simulated.

    Raises RecordingError: See :func:`too_slow`.
    """
    finding = too_slow(dataset, model)
    if finding is not None:
        raise RecordingError(finding.problem, where=dataset.source, remedy=finding.remedy)
