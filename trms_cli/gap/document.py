"""``trms.diagnosis/1``: a diagnosis as one JSON document."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from trms_cli.gap.diagnosis import SCHEMA, Diagnosis

#: Fields of a diagnosis that only the report shows.
_NOT_IN_THE_FILE = ("traces",)
#: Fields by channel and horizon.
_BY_HORIZON = ("gap", "shrink")


def document_of(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of ``diagnosis.json``.

    Keys are the fields of :class:`~trms_cli.gap.diagnosis.Diagnosis` in their order, after the
    schema; horizons are keys in s with a decimal (``"2.0"``); what is not finite is None.
    """
    content: dict[str, Any] = {"schema": SCHEMA}
    for field in fields(diagnosis):
        if field.name not in _NOT_IN_THE_FILE:
            content[field.name] = _plain(getattr(diagnosis, field.name))
    for name in _BY_HORIZON:
        content[name] = {
            channel: {horizon_key(h): row for h, row in sorted(rows.items(), key=_seconds)}
            for channel, rows in content[name].items()
        }
    return content


def horizon_key(horizon: float | str) -> str:
    """A horizon as the document has it: ``2.0`` for 2 s."""
    return repr(float(horizon))


def _seconds(item: tuple[str, Any]) -> float:
    return float(item[0])


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
