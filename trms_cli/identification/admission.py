"""Whether recordings can tell what is asked of them, before any fit or comparison.

What makes every result wrong is an error, with what to record or to change instead; what is a
matter of degree is a warning that stands in the report. Nothing is mended here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import RecordingError
from trms_cli.identification.admission_by_model import (
    SAMPLES_A_PERIOD,
    AdmissionCheck,
    findings_by_model,
    time_scales,
    too_slow,
)
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, names

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


def together(admissions: Mapping[str, Admission]) -> Admission:
    """What was found with several models; what does not hold for all names those that it is of.

    ``admissions``: by the name that the model is shown with.
    """
    holders: dict[Issue, list[str]] = {}
    for name, admission in admissions.items():
        for issue in admission.issues:
            holders.setdefault(issue, []).append(name)
    return ordered(
        issue
        if len(models) == len(admissions)
        else replace(issue, problem=f"{', '.join(models)}: {issue.problem}")
        for issue, models in holders.items()
    )


def ordered(issues: Iterable[Issue]) -> Admission:
    """Errors first, each kind in its order."""
    return Admission(tuple(sorted(issues, key=lambda issue: issue.severity != "error")))


Purpose = Literal["fit", "validation"]

#: Samples below which nothing is fitted, and samples a free parameter.
_LEAST_SAMPLES, _SAMPLES_A_PARAMETER = 50, 10
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


def admit(
    datasets: Sequence[Dataset],
    model: Model,
    free_parameters: int = 0,
    purpose: Purpose = "fit",
) -> Admission:
    """Check recordings against what is to be done with them.

    Parameters
    ----------
    datasets : sequence of Dataset
        As loaded for the model: before rotor speeds are made inputs.
    model : Model
        Roughly right is enough. Signs and swapped channels are only looked for where it has
        equations (not for a black box).
    free_parameters : int
        How many are to be fitted.
    purpose : {"fit", "validation"}
        A validation demands no length, and commands or axes that rest are worth a word only,
        unless nothing moves at all.
    """
    issues: list[Issue] = []
    for dataset in datasets:
        slow = too_slow(dataset, model)
        if slow is not None:  # nothing can be simulated between such samples
            issues += _from([slow], dataset, model)
            continue
        found = [*_inputs(dataset, model), *_outputs(dataset, model)]
        broken = {issue.check for issue in found if issue.severity == "error"}
        told = dataset
        if purpose == "validation" and "constant" in broken:
            told = _moving_part(dataset)
            broken.discard("constant")
        if not broken:
            found += _from(findings_by_model(told, model), told, model)
        issues += found
    if purpose == "fit":
        issues += _length(datasets, model, free_parameters)
    else:
        issues = [_as_warning(i) if i.check in _ONLY_FOR_A_FIT else i for i in issues]
        issues += _still(datasets)
    issues += _rates(datasets, model)
    return ordered(issues)


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
            "excitation", "error", "", "",
            f"nothing moves in {', '.join(d.source for d in datasets)}",
            "record the rig while its commands step or sweep over the range that matters",
        )  # fmt: skip


def _from(findings: Sequence[AdmissionCheck], dataset: Dataset, model: Model) -> Iterator[Issue]:
    """Findings as issues: less certain, or none, where the recording is short for the model.

    Over less than a period of the slowest mode an axis may swing against its thrust for other
    reasons (what it did before): in one of sixteen parts of half a period of simulated rigs.
    """
    scales = time_scales(dataset, model) if findings else None
    periods = dataset.duration / scales.slowest if scales is not None else np.inf
    for f in findings:
        certain = f.certain
        if f.check in ("sign", "swapped") and not f.channel.startswith("omega"):
            if periods < _LEAST_PERIODS:
                continue
            certain = certain and periods >= _TELLING_PERIODS
        yield Issue(
            f.check, "error" if certain else "warning", dataset.name, f.channel, f.problem,
            f.remedy,
        )  # fmt: skip


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
                "unit", "error", dataset.name, name,
                f"{name} reaches {largest:.4g} {unit}, {largest / limit:.3g} times the limit of "
                f"{limit:g} {unit} of model {model.name!r}",
                remedy,
            )  # fmt: skip
            continue
        if largest > _UNCUT * limit:
            beyond = float(np.mean(np.abs(u) > limit))
            yield Issue(
                "limit", "warning", dataset.name, name,
                f"{name} is beyond the limit of {limit:g} {unit} for {beyond:.1%} of the time, up "
                f"to {largest:.4g} {unit}",
                "record what reaches the rig, after its limits; models do not cut what is recorded",
            )  # fmt: skip
        elif largest < _TINY * limit:
            yield Issue(
                "unit", "warning", dataset.name, name,
                f"{name} never exceeds {largest:.3g} {unit}, {largest / limit:.1%} of its limit",
                "is it in another unit? data.input_scale tells what a recorded 1 is",
            )  # fmt: skip
        share = float(np.mean(np.abs(u) >= 0.98 * limit))
        steady = bool(np.mean(np.diff(u) == 0) > _SATURATED) and share > _SATURATED
        saturated.append(steady)
        if not steady and share > _OFTEN_SATURATED and len(np.unique(np.abs(u))) > 3:
            yield Issue(
                "saturation", "warning", dataset.name, name,
                f"{name} is at its limit for {share:.0%} of the time",
                "smaller references or slower control tell more about the rig",
            )  # fmt: skip
    rotors = ", ".join(names(dataset.inputs))
    if saturated and all(saturated) and len(saturated) == len(commanded):
        yield Issue(
            "saturation", "error", dataset.name, "",
            f"{', '.join(commanded)}: at the limit throughout",
            "record with commands within their limits, as `trms excite` designs them",
        )  # fmt: skip
    elif not any(moving):
        moved = any(_moved(dataset, s.name) > _SEEN_WELL for s in dataset.outputs)
        free = not commanded and moved
        yield Issue(
            "excitation", "warning" if free else "error", dataset.name, "",
            f"the inputs never move ({rotors} constant)"
            + (": only the free motion can be told, nothing of the rotors" if free else ""),
            "record with commands that move, as `trms excite` designs them",
        )  # fmt: skip
    else:
        for signal, moves in zip(dataset.inputs, moving, strict=True):
            if not moves:
                yield Issue(
                    "excitation", "warning", dataset.name, signal.name,
                    f"{signal.name} never moves",
                    "nothing can be told of its rotor from this; move both, or fix its parameters",
                )  # fmt: skip


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
                "constant", "error", dataset.name, name,
                f"{name} is constant at {there[0]:.4g} {signal.unit}",
                f"look at its sensor and record again; if the axis was locked, choose a model of "
                f"the other axis alone; or {leave}",
            )  # fmt: skip
            continue
        missing = 1 - len(there) / len(y)
        if missing > _MOST_MISSING:
            yield Issue(
                "missing", "warning", dataset.name, name, f"{name} is missing for {missing:.0%}",
                f"look at its sensor, or {leave}",
            )  # fmt: skip
        stop = model.stops.get(name, np.inf)
        farthest = min(_BEYOND_STOPS * stop, _FARTHEST) if signal.unit == "rad" else np.inf
        largest = float(np.abs(there).max())
        if largest > farthest:
            limit = f"the stops are at ±{stop:.3g} rad" if np.isfinite(stop) else "no rig turns so"
            hint = ""
            if np.radians(largest) <= farthest:
                hint = f": as degrees it were {np.radians(largest):.3g} rad"
            yield Issue(
                "unit", "error", dataset.name, name,
                f"{name} reaches {largest:.4g} rad, and {limit}{hint}",
                f"write the unit that it is in into the header, as {name}[deg]",
            )  # fmt: skip
            continue
        seen = _moved(dataset, name)
        if seen < _SEEN:
            yield Issue(
                "excitation", "warning", dataset.name, name,
                f"{name} hardly moves: {np.std(there):.3g} {signal.unit}, "
                f"{seen:.2g} times its noise",
                "record with larger commands, as `trms excite` designs them",
            )  # fmt: skip


def _length(datasets: Sequence[Dataset], model: Model, free: int) -> Iterator[Issue]:
    samples = sum(len(d) for d in datasets)
    needed = max(_LEAST_SAMPLES, _SAMPLES_A_PARAMETER * free)
    if samples < needed:
        asked = f" for {free} free parameters" if free else ""
        yield Issue(
            "length", "error", "", "", f"{samples} samples in all{asked}",
            f"record at least {needed} samples",
        )  # fmt: skip
        return
    scales = [s for s in (time_scales(d, model) for d in datasets) if s is not None]
    if not scales:
        return
    slowest = max(scale.slowest for scale in scales)
    longest = max(d.duration for d in datasets)
    if longest < _GOOD_PERIODS * slowest:
        certain = longest < _LEAST_PERIODS * slowest
        yield Issue(
            "length", "error" if certain else "warning", "", "",
            f"the longest recording has {longest:.3g} s, and the slowest mode of model "
            f"{model.name!r} a period of {slowest:.3g} s",
            f"record at least {_GOOD_PERIODS * slowest:.0f} s at a stretch",
        )  # fmt: skip


def _rates(datasets: Sequence[Dataset], model: Model) -> Iterator[Issue]:
    steps = sorted({round(d.sample_time, 9) for d in datasets})
    own = model.sample_time
    for dataset in datasets:
        ratio = dataset.sample_time / own if own else 1.0
        if own and (round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio):
            yield Issue(
                "sample time", "error", dataset.name, "",
                f"sampled every {dataset.sample_time:g} s, and model {model.name!r} steps by "
                f"{own:g} s",
                f"resample: data.resample={own:g}",
            )  # fmt: skip
        scale = time_scales(dataset, model)
        slow = scale is not None and dataset.sample_time > scale.fastest / SAMPLES_A_PERIOD
        if scale and slow and too_slow(dataset, model) is None:
            yield Issue(
                "sample time", "warning", dataset.name, "",
                f"sampled every {dataset.sample_time:g} s, and the fastest mode of model "
                f"{model.name!r} has a period of {scale.fastest:.2g} s",
                f"record at least every {scale.fastest / SAMPLES_A_PERIOD:.2g} s",
            )  # fmt: skip
    if len(steps) > 1:
        words = ", ".join(f"{step:g}" for step in steps)
        yield Issue(
            "sample time", "warning", "", "", f"the recordings have sample times of {words} s",
            f"methods that need one take them with data.resample={steps[-1]:g}",
        )  # fmt: skip


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
