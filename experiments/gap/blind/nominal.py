"""The parameter values of the nominal model, as data: the rigs share nothing else with it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import yaml

from trms_cli.core.resources import config_folder

_SET = "bench"


@cache
def _entries() -> Mapping[str, Mapping[str, float]]:
    text = (config_folder() / "parameters" / f"{_SET}.yaml").read_text(encoding="utf-8")
    entries: Mapping[str, Mapping[str, float]] = yaml.safe_load(text)["parameters"]
    return entries


def nominal() -> dict[str, float]:
    """Values by name, SI units."""
    return {name: float(entry["value"]) for name, entry in _entries().items()}


def relative_sds() -> dict[str, float]:
    """Prior standard deviations as shares of the values, of those that have one."""
    return {
        name: float(entry["prior_sd"]) for name, entry in _entries().items() if "prior_sd" in entry
    }
