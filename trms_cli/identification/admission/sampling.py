"""Whether recordings last long enough, and are sampled finely enough, for what a model does."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.identification.admission.issues import Issue
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model
from trms_cli.models.vector_field import VectorField

#: Samples below which nothing is fitted, and samples a free parameter.
_LEAST_TO_FIT, _SAMPLES_A_PARAMETER = 50, 10
#: Share of the slowest mode's period that the recordings must last; and that they should.
LEAST_PERIODS, _GOOD_PERIODS = 0.5, 2.0
#: 1/s: faster modes are armature currents, slower ones integrate.
_FASTEST_MODE, _SLOWEST_MODE = 100.0, 0.02
#: s; up to here a sample time is slow, no more.
_SLOW = 1.0
#: Samples that a period of the fastest mode needs.
_SAMPLES_A_PERIOD = 6.0


@dataclass(frozen=True)
class TimeScales:
    """Periods of a model's slowest and fastest mode, s (2π over the pole's distance from 0)."""

    slowest: float
    fastest: float


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


def length_issues(datasets: Sequence[Dataset], model: Model, free: int) -> Iterator[Issue]:
    samples = sum(len(d) for d in datasets)
    minimum = max(_LEAST_TO_FIT, _SAMPLES_A_PARAMETER * free)
    if samples < minimum:
        demand = f" for {free} free parameters" if free else ""
        yield Issue(
            "length",
            "error",
            "",
            "",
            f"{samples} samples in all{demand}",
            f"record at least {minimum} samples",
        )
        return
    scales = [s for s in (time_scales(d, model) for d in datasets) if s is not None]
    if not scales:
        return
    slowest = max(scale.slowest for scale in scales)
    longest = max(d.duration for d in datasets)
    if longest < _GOOD_PERIODS * slowest:
        certain = longest < LEAST_PERIODS * slowest
        yield Issue(
            "length",
            "error" if certain else "warning",
            "",
            "",
            f"the longest recording has {longest:.3g} s, and the slowest mode of model "
            f"{model.name!r} a period of {slowest:.3g} s",
            f"record at least {_GOOD_PERIODS * slowest:.0f} s at a stretch",
        )


def rate_issues(datasets: Sequence[Dataset], model: Model) -> Iterator[Issue]:
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
