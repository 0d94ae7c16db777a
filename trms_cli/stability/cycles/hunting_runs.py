"""A loop with friction in simulation: when the axis sticks, and whether it hunts.

The axis sticks at a sample where its rate is zero to rounding: friction acts as an impulse that
stops it exactly (:mod:`trms_cli.models.dry_friction`). What lies between two sticks is a slip. The
loop hunts if slips go on to and fro after the transient without dying out.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.closed_loop import LoopRun, run_loop
from trms_cli.stability.subject import LoopParts

Verdict = Literal["hunting", "rest", "dying out", "undecided", "oscillating", "unstable"]

#: rad/s: slower than this the axis sticks.
_STUCK = 1e-6
#: rad: shorter slips are creep.
_SHORTEST = 1e-5
#: Slips whose last is smaller than this part of the first are dying out.
_KEEPS = 0.8
#: rad: an axis that never sticks and swings less than this rests all the same.
_CALM = 1e-4


@dataclass(frozen=True)
class AxisRun:
    """A run of a loop, one axis of it, and what its second half shows."""

    #: ``time``, ``angle``, ``rate``: (n,) arrays; s, rad (the deviation from the reference), rad/s
    time: FloatArray
    angle: FloatArray
    rate: FloatArray
    command: FloatArray  #: (n,) array; V, of the rotor that holds the axis
    is_stuck: BoolArray  #: (n,) bool array
    #: ``hunting``; ``rest``: no slips any more; ``dying out``: slips, each smaller; ``undecided``:
    #: a slip or two, too few to tell; ``oscillating``: a steady swing that never sticks;
    #: ``unstable``: the run had to end, or the swing grows
    verdict: Verdict
    period: float | None  #: s, mean of whole cycles
    swing: float  #: Peak to peak of the angle, rad: over the last cycle where it hunts
    stuck_share: float  #: Of the time, at rest
    at_limit: bool  #: Whether a command reached its bound
    failures: int  #: Control samples whose solve failed

    @property
    def hunts(self) -> bool:
        return self.verdict == "hunting"

    @property
    def sticks(self) -> tuple[FloatArray, FloatArray]:
        """Sizes of the errors at a stick and at the next one, over the whole run, rad."""
        edges = np.diff(self.is_stuck.astype(int))
        errors = np.abs(self.angle[np.flatnonzero(edges == 1) + 1])
        return errors[:-1], errors[1:]


@dataclass(frozen=True)
class HuntingLevel:
    """A level of friction or of integral action: what is predicted and what simulation gives."""

    factor: float  #: On the size of the friction, or on k_i
    predicted: float | None  #: Swing, rad; None where the loop does not hunt
    run: AxisRun


@dataclass(frozen=True)
class LevelSweep:
    """Levels of one quantity."""

    name: str  #: ``torques`` or ``integrals``
    label: str  #: Of the axis of the figure
    #: sequence of (words, (n,) array); swings, rad, that are predicted over a range of factors
    curves: Sequence[tuple[str, FloatArray]]
    levels: Sequence[HuntingLevel]  #: That were simulated


def axis_run(
    model: Model,
    loop: LoopParts,
    point: OperatingPoint,
    axis: str,
    push: float,
    duration: float,
    channel: int = 0,
) -> AxisRun:
    """Run the loop from an axis pushed beside its reference, by rad, for some s.

    ``channel`` is the command that is kept beside the angle.
    """
    run = run_loop(model, loop, point, duration, offset={model.axes[axis].angle: push})
    row = model.state_index(model.axes[axis].angle)
    angle = run.x[:, row] - point.x[row]
    rate = VectorField(model).rates(run.x, run.applied)[:, row]
    is_stuck = np.abs(rate) < _STUCK
    tail = slice(len(angle) // 2, None)
    swing = float(np.ptp(angle[tail])) if len(angle) > 1 else math.nan
    verdict, period = _verdict(run, angle, is_stuck)
    if verdict == "hunting" and period is not None:
        # The last cycle alone: slips of the transient may still be larger.
        since = run.time[-1] - 1.05 * period
        swing = float(np.ptp(angle[max(len(angle) // 2, int(np.searchsorted(run.time, since))) :]))
    _, bound = model.input_bounds()
    return AxisRun(
        run.time,
        angle,
        rate,
        run.applied[:, channel],
        is_stuck,
        verdict,
        period,
        swing,
        float(is_stuck[tail].mean()),
        bool(np.any(np.abs(run.applied[tail]) >= bound - 1e-9)),
        run.failures,
    )


def slips(time: FloatArray, angle: FloatArray, is_stuck: BoolArray) -> list[tuple[float, float]]:
    """Beginning (s) and travel (rad) of each whole slip, creep left out."""
    edges = np.diff(is_stuck.astype(int))
    begins, ends = np.flatnonzero(edges == -1), np.flatnonzero(edges == 1)
    ends = ends[ends > begins[0]] if begins.size else ends[:0]
    pairs = zip(begins, ends, strict=False)  # a run may end within a slip
    whole = [(float(time[b]), float(angle[e + 1] - angle[b])) for b, e in pairs]
    return [slip for slip in whole if abs(slip[1]) > _SHORTEST]


def _verdict(run: LoopRun, angle: FloatArray, is_stuck: BoolArray) -> tuple[Verdict, float | None]:
    if run.stop_reason:
        return "unstable", None
    half = len(angle) // 2
    tail, last = angle[half:], angle[len(angle) * 3 // 4 :]
    if not is_stuck[half:].any():
        if np.ptp(last) < _CALM:
            return "rest", None
        if np.ptp(last) > 1.2 * np.ptp(tail[: len(tail) // 2]):
            return "unstable", None
        steady = np.ptp(last) > _KEEPS * np.ptp(tail[: len(tail) // 2])
        swing = tail - tail.mean()
        rising = np.flatnonzero((swing[:-1] < 0) & (swing[1:] >= 0))
        period = float(np.mean(np.diff(run.time[half:][rising]))) if len(rising) > 2 else None
        return ("oscillating" if steady else "dying out"), period
    motions = slips(run.time[half:], tail, is_stuck[half:])
    travels = np.array([travel for _, travel in motions])
    if not len(travels) or np.abs(travels).max() < _CALM:
        return "rest", None
    if len(travels) < 3:
        return "undecided", None
    both = bool((travels > 0).any() and (travels < 0).any())
    if not both or abs(travels[-2:]).max() < _KEEPS * abs(travels[:2]).max():
        return "dying out", None
    return "hunting", _period_of_slips(motions)


def _period_of_slips(motions: list[tuple[float, float]]) -> float | None:
    """Twice the mean time between slips that turn back."""
    turns, last = list[float](), 0.0
    for begin, travel in motions:
        if travel * last < 0:
            turns.append(begin)
        last = travel
    if len(turns) < 2:
        return None
    # Whole periods where there are any: rest to either side may differ in length.
    whole = turns[: 2 * ((len(turns) - 1) // 2) + 1]
    if len(whole) > 2:
        return 2.0 * (whole[-1] - whole[0]) / (len(whole) - 1)
    return 2.0 * (turns[-1] - turns[0])


def with_sizes(model: Model, values: Mapping[str, float]) -> Model:
    """A model with other values of some parameters."""
    other = copy.copy(model)
    other.parameters = model.parameters.replaced(values)
    return other
