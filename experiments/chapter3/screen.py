"""One line on the screen that says how far a training is."""

from __future__ import annotations

import sys

from trms_cli.identification.problem import SilentProgress


class Screen(SilentProgress):
    """Progress of a training, on a terminal only.

    Parameters
    ----------
    name : str
        Of what is trained.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def update(self, fraction: float, cost: float, message: str) -> bool:
        if sys.stderr.isatty():
            end = "\n" if fraction >= 1.0 else ""
            sys.stderr.write(f"\r\033[K{self._name}: {100 * fraction:3.0f} %, {message}{end}")
        return True
