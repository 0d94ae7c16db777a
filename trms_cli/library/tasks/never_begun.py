"""Tells of faults and disturbances that are set to begin after a run has ended.

Such a run is as sound as the rig without them, and would be taken for one that withstood them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition
    from trms_cli.simulation.closed_loop import Experiment

_TO_THE_END = 1e-9  # s; what begins so shortly before the end has no sample either


def tell_of_never_begun(composition: Composition, experiment: Experiment) -> None:
    """Write a note for each; in a sweep with its first job only."""
    if composition.job in (None, 0):
        for what in never_begun(experiment.plant, experiment.duration):
            sys.stderr.write(f"note   {what}\n")


def never_begun(plant: Any, duration: float) -> Iterator[str]:
    """A sentence for each fault and each disturbance of a rig that has no part in a run.

    Parameters
    ----------
    plant : Plant
        One without faults and disturbances has nothing to tell.
    duration : float
        Of the run, s.
    """
    end = f"after the end of the run ({duration:g} s)"
    for name, fault in _named(plant, "faults"):
        start = getattr(fault, "start", None)
        if _is_after(start, duration):
            yield f"fault {name} begins at {start:g} s, {end}"
    for name, disturbance in _named(plant, "disturbances"):
        torque = getattr(disturbance, "torque", None)
        start = getattr(torque, "start", None)
        # A signal rests at its offset before it begins; a file's first value holds before it.
        silent = getattr(torque, "offset", 0.0) == 0.0 and not hasattr(torque, "file")
        if silent and _is_after(start, duration):
            yield f"disturbance {name} begins at {start:g} s, {end}"


def _named(plant: Any, key: str) -> Iterator[tuple[str, Any]]:
    found = getattr(plant, key, None)
    if isinstance(found, Mapping):
        yield from found.items()


def _is_after(start: Any, duration: float) -> bool:
    return isinstance(start, (int, float)) and start >= duration - _TO_THE_END
