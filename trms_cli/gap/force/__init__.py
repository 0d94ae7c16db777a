"""What a missing force looks like: where and when it acts, and what it depends on."""

from __future__ import annotations

from trms_cli.gap.force.exogenous import Exogenous, exogenous
from trms_cli.gap.force.record import ForceRecord
from trms_cli.gap.force.regions import change_time, regions

__all__ = ["Exogenous", "ForceRecord", "change_time", "exogenous", "regions"]
