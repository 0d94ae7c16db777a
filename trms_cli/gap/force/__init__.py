"""What a missing force looks like: where and when it acts, what it depends on, what it is like."""

from __future__ import annotations

from trms_cli.gap.force.description import description
from trms_cli.gap.force.exogenous import Exogenous, exogenous
from trms_cli.gap.force.record import ForceRecord
from trms_cli.gap.force.regions import change_time, regions
from trms_cli.gap.force.signatures import shortlist, signatures

__all__ = [
    "Exogenous",
    "ForceRecord",
    "change_time",
    "description",
    "exogenous",
    "regions",
    "shortlist",
    "signatures",
]
