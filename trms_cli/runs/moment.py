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

    Attributes
    ----------
    name, unit : str
    reference, measured, state, estimate : float
        Now; `state` is the simulated rig's true one.
    error : float
        Reference minus state (or measurement, where no state is known), now.
    rmse : float
        Of the error, from the run's beginning until now.
    time : (n,) array
        s, of the last samples.
    wanted, shown : (n,) array
        The reference, and the state or measurement, on them.
    """

    name: str
    unit: str
    reference: float
    measured: float
    state: float
    estimate: float
    error: float
    rmse: float
    time: FloatArray
    wanted: FloatArray
    shown: FloatArray


@dataclass(frozen=True)
class Input:
    """A command as applied.

    Attributes
    ----------
    name, unit : str
    value : float
        Now.
    lower, upper : float
        Its limits; infinite where the log has none.
    saturated : bool
        Whether it is at one of them now.
    share : float
        Share of the samples until now at a limit, 0 to 1.
    """

    name: str
    unit: str
    value: float
    lower: float
    upper: float
    saturated: bool
    share: float


@dataclass(frozen=True)
class Solver:
    """The controller's own words.

    Attributes
    ----------
    now_ms, p99_ms : float
        Wall time of the latest control step, and the 99th percentile of those until now.
    deadline_ms : float
        The control period.
    steps, misses, fallbacks : int
        Control steps until now, those that took longer, those on which a fall-back acted or the
        solve failed.
    iterations : float
        Of the latest step.
    status, message : str
        Of the latest step.
    mode, reasons : str
        Of the supervisor: normal, degraded or landing, and why.
    """

    now_ms: float
    p99_ms: float
    deadline_ms: float
    steps: int
    misses: int
    fallbacks: int
    iterations: float
    status: str
    message: str
    mode: str
    reasons: str


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes
    ----------
    time : float
        s.
    kind, source, message : str
    """

    time: float
    kind: str
    source: str
    message: str


@dataclass(frozen=True)
class Moment:
    """A run at one moment.

    Attributes
    ----------
    time : float
        s.
    speed : float
        How many times as fast as real time the run went, around this moment; NaN if unknown.
    axes : tuple of Axis
    inputs : tuple of Input
    solver : Solver or None
        None before the first control step, and in recordings.
    events : tuple of Event
        The latest ones until now, the last one last.
    event_count : int
        All of them until now.
    """

    time: float
    speed: float
    axes: tuple[Axis, ...]
    inputs: tuple[Input, ...]
    solver: Solver | None
    events: tuple[Event, ...]
    event_count: int
