"""What a reference's steps tell: overshoot, rise, settling and steady-state error.

A *hold* is a stretch of at least ``MINIMUM_HOLD`` seconds in which the reference does not
change. A *step* is a jump of the reference by at least ``SMALLEST_STEP`` from a value at rest to
a hold; the begin of a run is one if the response is not where the first hold wants it.
References that only move (sines, ramps, sawteeth, fast binary sequences, shaped steps) have no
steps, and their step metrics do not exist.

With several steps the figure of a run is that of its worst step: one bad step out of six is what
a user of the rig would notice. The median over steps stands beside it. A step that never settles
(or rises) within its hold counts as infinitely slow, so that neither figure exists if the worst,
or the median, step did not arrive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trms_cli.scoring.metrics import Array

#: s. What is held for less cannot be judged on a rig whose motions take seconds.
MINIMUM_HOLD = 1.0
#: rad, a few quanta of an encoder: below it noise would pass for a step.
SMALLEST_STEP = 0.01
#: Half width of the settling band as a fraction of the step.
SETTLING_BAND = 0.02
#: The last part of each hold, over which the steady-state error is averaged.
STEADY_PART = 0.2


@dataclass(frozen=True)
class StepMetrics:
    """Metrics of one step; ``inf`` for what did not happen within the hold."""

    overshoot_percent: float  #: ``100 · max((y − r)·sign(Δr), 0)/|Δr|``
    #: s from the first crossing of 10 % of the step to that of 90 %, interpolated linearly
    rise_time: float
    #: s from the step to the first sample from which the response stays within ±2 % of the step
    #: around the reference until the hold ends
    settling_time: float


def holds(time: Array, reference: Array) -> list[tuple[int, int]]:
    """Stretches of constant reference as half-open ranges of samples."""
    if reference.size < 2:
        return []
    tolerance = 1e-9 * (1.0 + float(np.nanmax(np.abs(reference), initial=0.0)))
    # not ≤ instead of >: a missing reference ends a hold
    changes = np.flatnonzero(~(np.abs(np.diff(reference)) <= tolerance)) + 1
    begins = np.concatenate([[0], changes])
    ends = np.concatenate([changes, [reference.size]])
    span = time[np.minimum(ends, reference.size - 1)] - time[begins]
    long_enough = (span >= MINIMUM_HOLD - 1e-9) & ~np.isnan(reference[begins])
    return list(zip(begins[long_enough].tolist(), ends[long_enough].tolist(), strict=True))


def steps(time: Array, reference: Array, response: Array) -> list[StepMetrics]:
    """Metrics of every step of the reference, in order.

    Parameters
    ----------
    time : (n,) s
    reference, response : (n,) rad
    """
    found = []
    for begin, end in holds(time, reference):
        origin = _origin(reference, response, begin)
        size = float(reference[begin]) - origin
        part = slice(begin, end)
        present = ~np.isnan(response[part])
        if abs(size) >= SMALLEST_STEP and present.any():
            fraction = (response[part][present] - origin) / size
            found.append(_step_metrics(time[part][present] - time[begin], fraction))
    return found


def steady_state_error(time: Array, reference: Array, response: Array) -> float:
    """Largest magnitude, over the holds, of the mean error in the last fifth of the hold.

    Of all holds, also those that no step led to; NaN if the reference never rests.
    """
    means = []
    for begin, end in holds(time, reference):
        last = time[end - 1]
        late = time[begin:end] >= last - STEADY_PART * (last - time[begin])
        error = (reference[begin:end] - response[begin:end])[late]
        present = error[~np.isnan(error)]
        if present.size:
            means.append(abs(float(np.mean(present))))
    return max(means, default=math.nan)


def _origin(reference: Array, response: Array, begin: int) -> float:
    """Where a step comes from; NaN if the reference was moving, which makes it no step."""
    if begin == 0:
        present = response[~np.isnan(response)]
        return float(present[0]) if present.size else math.nan
    if begin > 1 and reference[begin - 2] != reference[begin - 1]:
        return math.nan
    return float(reference[begin - 1])


def _step_metrics(elapsed: Array, fraction: Array) -> StepMetrics:
    """``fraction`` is the response from 0 (before the step) to 1 (arrived)."""
    outside = np.flatnonzero(np.abs(fraction - 1.0) > SETTLING_BAND)
    if not outside.size:
        settling = 0.0
    elif outside[-1] == fraction.size - 1:
        settling = math.inf
    else:
        settling = float(elapsed[outside[-1] + 1])
    rise = math.inf
    if np.max(fraction) >= 0.9:
        rise = _first_crossing(elapsed, fraction, 0.9) - _first_crossing(elapsed, fraction, 0.1)
    return StepMetrics(
        overshoot_percent=100.0 * max(float(np.max(fraction)) - 1.0, 0.0),
        rise_time=rise,
        settling_time=settling,
    )


def _first_crossing(elapsed: Array, fraction: Array, level: float) -> float:
    """Interpolated time at which a level that is reached is reached first."""
    index = int(np.argmax(fraction >= level))
    if index == 0:
        return float(elapsed[0])
    share = (level - fraction[index - 1]) / (fraction[index] - fraction[index - 1])
    return float(elapsed[index - 1] + share * (elapsed[index] - elapsed[index - 1]))
