"""A progress that stops a fit when it was told enough, and keeps what the fit saves."""

import json
from collections.abc import Mapping
from typing import Any

from trms_cli.identification.problem import SilentProgress


class Watched(SilentProgress):
    """Asks to stop at report number ``after``; gives back what an earlier one has ``kept``."""

    def __init__(self, after: int = 10**6, kept: Mapping[str, Any] | None = None) -> None:
        self.after, self.kept = after, kept
        self.fractions: list[float] = []

    def update(self, fraction: float, cost: float, message: str) -> bool:
        self.fractions.append(fraction)
        return len(self.fractions) < self.after

    def save(self, state: Mapping[str, Any]) -> None:
        self.kept = json.loads(json.dumps(state))

    def saved(self) -> Mapping[str, Any] | None:
        return self.kept
