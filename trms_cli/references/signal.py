"""What a signal is: a pure function of time, evaluated for all times at once.

The vocabulary is the same in every file of this room: ``amplitude`` and ``offset`` in rad,
``frequency`` in Hz, ``phase`` as a fraction of a period (0.25 leads by a quarter), ``start`` in
s. Before ``start`` a signal rests at ``offset``.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.ranges import Positive

Array = NDArray[np.float64]

#: Hz, of anything that repeats.
Frequency = Positive
#: s, a length of time.
Duration = Positive

#: Edges closer to a sample than this belong to it (s, or periods): ``0.1 * 3`` is past 0.3, and
#: an edge must not move by one sample because of that.
EDGE = 1e-9


@runtime_checkable
class ReferenceSignal(Protocol):
    """One scalar reference over time.

    A signal must give the same answer for a time whatever other times are asked for, so that
    a controller may preview it and a run may be repeated.
    """

    def sample(self, times: Array) -> Array:
        """Value at each time.

        Parameters
        ----------
        times : (n,) s
            In any order.

        Returns
        -------
        (n,) rad
        """


def require_signal(value: object, where: str) -> None:
    """Check a nested signal that came from configuration.

    Raises ConfigurationError if the value cannot be sampled.
    """
    if not isinstance(value, ReferenceSignal):
        raise ConfigurationError(
            f"{type(value).__name__} is not a signal",
            where=where,
            remedy="choose one of the group signal (`trms list signal`), or a class with "
            "sample(times)",
        )


def cycles_since_start(times: Array, start: float, frequency: float, phase: float) -> Array:
    """Periods elapsed since the start, plus the phase: ``(t − start)·frequency + phase``.

    Values within ``EDGE`` of a half or whole period are put on it, so that an edge falls on
    the sample that it was meant for.
    """
    cycles = (np.asarray(times, dtype=float) - start) * frequency + phase
    nearest = np.round(2 * cycles) / 2
    return np.where(np.abs(cycles - nearest) < EDGE, nearest, cycles)


def has_started(times: Array, start: float) -> NDArray[np.bool_]:
    """Whether each time is at or after the start."""
    return np.asarray(times, dtype=float) >= start - EDGE
