"""Whether recordings can tell what is asked of them, before any fit or comparison.

What makes every result wrong is an error, with what to record or to change instead; what is a
matter of degree is a warning that stands in the report. Nothing is mended here.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from trms_cli.identification.admission.channels import input_issues, output_issues
from trms_cli.identification.admission.issues import Admission, Issue, by_severity
from trms_cli.identification.admission.motion import issues_by_model
from trms_cli.identification.admission.sampling import (
    LEAST_PERIODS,
    length_issues,
    rate_issues,
    time_scales,
    too_slow,
)
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model

Purpose = Literal["fit", "validation"]
#: Share of that period from which on the motion of an axis tells its sign for certain.
_TELLING_PERIODS = 1.0
#: What keeps a model from being fitted, and yet may be held against one.
_ONLY_FOR_A_FIT = ("constant", "excitation", "saturation")


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
        own = [*input_issues(dataset, model), *output_issues(dataset, model)]
        broken = {issue.check for issue in own if issue.severity == "error"}
        moving = dataset
        if purpose == "validation" and "constant" in broken:
            moving = _moving_part(dataset)
            broken.discard("constant")
        if not broken:
            own += _by_model(moving, model)
        issues += own
    if purpose == "fit":
        issues += length_issues(datasets, model, free_parameters)
    else:
        issues = [_as_warning(i) if i.check in _ONLY_FOR_A_FIT else i for i in issues]
        issues += _still(datasets)
    issues += rate_issues(datasets, model)
    return by_severity(issues)


def _as_warning(issue: Issue) -> Issue:
    return replace(issue, severity="warning")


def _moving_part(dataset: Dataset) -> Dataset:
    """Without the outputs that are constant: the motion of the others tells their places."""
    columns = [i for i, y in enumerate(dataset.measurements.T) if np.nanmax(y) > np.nanmin(y)]
    return replace(
        dataset,
        outputs=tuple(dataset.outputs[i] for i in columns),
        measurements=np.ascontiguousarray(dataset.measurements[:, columns]),
        noise_sd=dataset.noise_sd[columns],
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
    speeds = set(model.rotor_speeds.values())
    for issue in issues:
        if issue.check in ("sign", "swapped") and issue.channel not in speeds:
            if periods < LEAST_PERIODS:
                continue
            if periods < _TELLING_PERIODS:
                issue = _as_warning(issue)
        yield issue
