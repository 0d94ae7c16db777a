"""A sample time at which no model can be simulated: most often ms under a header that says s."""

from __future__ import annotations

from trms_cli.core.errors import RecordingError
from trms_cli.identification.admission_by_model import Finding, time_scales
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model

#: s; up to here a sample time is slow, no more.
_SLOW = 1.0
#: Samples that a period of the fastest mode needs.
SAMPLES_A_PERIOD = 6.0


def far_too_slow(dataset: Dataset, model: Model) -> Finding | None:
    """What to say of a sample longer than 1 s and than a period of the model's fastest mode.

    None for any other, and for a model that steps by a time of its own.
    """
    step = dataset.sample_time
    if step <= _SLOW or model.sample_time is not None:
        return None
    scale = time_scales(dataset, model)
    if scale is None or step <= scale.fastest:
        return None
    return Finding(
        "sample time", "",
        f"{step:.4g} s a sample, and the fastest mode of model {model.name!r} has a period of "
        f"{scale.fastest:.2g} s",
        "is t in ms? Then write t[ms] into the header; if it is not, record at least every "
        f"{scale.fastest / SAMPLES_A_PERIOD:.2g} s", True,
    )  # fmt: skip


def require_sample_time(dataset: Dataset, model: Model) -> None:
    """Refuse a recording between whose samples nothing can be simulated.

    Raises RecordingError: See :func:`far_too_slow`.
    """
    finding = far_too_slow(dataset, model)
    if finding is not None:
        raise RecordingError(finding.problem, where=dataset.source, remedy=finding.remedy)
