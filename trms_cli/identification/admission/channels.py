"""Units, limits and motion of recorded channels, one by one."""

from collections.abc import Iterator

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.admission.issues import Issue
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, names

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


def input_issues(dataset: Dataset, model: Model) -> Iterator[Issue]:
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
        has_motion = any(_motion(dataset, s.name) > _SEEN_WELL for s in dataset.outputs)
        free = not commanded and has_motion
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


def output_issues(dataset: Dataset, model: Model) -> Iterator[Issue]:
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
        motion = _motion(dataset, name)
        if motion < _SEEN:
            yield Issue(
                "excitation",
                "warning",
                dataset.name,
                name,
                f"{name} hardly moves: {np.std(there):.3g} {signal.unit}, "
                f"{motion:.2g} times its noise",
                "record with larger commands, as `trms excite` designs them",
            )


def _without(dataset: Dataset, name: str) -> str:
    others = [other for other in names(dataset.outputs) if other != name]
    if not others:
        return "record another output"
    return f"leave it out: 'data.channels=[{', '.join(others)}]'"


def _motion(dataset: Dataset, name: str) -> float:
    """Standard deviation of an output over that of its noise."""
    index = names(dataset.outputs).index(name)
    y: FloatArray = dataset.measurements[:, index]
    if not np.isfinite(y).any():
        return 0.0
    return float(np.nanstd(y) / max(float(dataset.noise_sd[index]), 1e-9))
