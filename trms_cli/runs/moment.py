"""What there is to see of a run at one moment of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
NAN = float("nan")


@dataclass(frozen=True)
class Axis:
    """A controlled angle, or one that is watched in a run without a reference.

    Values are NaN where the run has none.
    """

    name: str
    unit: str
    reference: float  #: Now; `state` is the simulated rig's true one
    measured: float  #: Now; `state` is the simulated rig's true one
    state: float  #: Now; `state` is the simulated rig's true one
    estimate: float  #: Now; `state` is the simulated rig's true one
    error: float  #: Reference minus state (or measurement, where no state is known), now
    rmse: float  #: Of the error, from the run's beginning until now
    time: FloatArray  #: (n,) array; s, of the last samples
    #: ``wanted``, ``shown``: (n,) array; the reference, and the state or measurement, on them
    wanted: FloatArray
    shown: FloatArray


@dataclass(frozen=True)
class Input:
    """A command as applied."""

    name: str
    unit: str
    value: float  #: Now
    lower: float  #: Its limits
    upper: float  #: infinite where the log has none
    saturated: bool  #: Whether it is at one of them now
    share: float  #: Share of the samples until now at a limit, 0 to 1


@dataclass(frozen=True)
class Solver:
    """The controller's own words."""

    #: ``now_ms``, ``p99_ms``: Wall time of the latest control step, and the 99th percentile of
    #: those until now
    now_ms: float
    p99_ms: float
    deadline_ms: float  #: The control period
    #: ``steps``, ``misses``, ``fallbacks``: Control steps until now, those that took longer, those
    #: on which a fall-back acted or the solve failed
    steps: int
    misses: int
    fallbacks: int
    iterations: float  #: Of the latest step
    status: str  #: Of the latest step
    message: str  #: Of the latest step
    #: ``mode``, ``reasons``: Of the supervisor: normal, degraded or landing, and why
    mode: str
    reasons: str


@dataclass(frozen=True)
class Event:
    """Something that happened."""

    time: float  #: s
    kind: str
    source: str
    message: str


@dataclass(frozen=True)
class Moment:
    """A run at one moment."""

    time: float  #: s
    #: How many times as fast as real time the run went, around this moment; NaN if unknown
    speed: float
    axes: tuple[Axis, ...]
    inputs: tuple[Input, ...]
    solver: Solver | None  #: None before the first control step, and in recordings
    events: tuple[Event, ...]  #: The latest ones until now, the last one last
    event_count: int  #: All of them until now
