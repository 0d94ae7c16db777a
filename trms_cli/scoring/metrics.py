"""Metrics of sampled signals, each a pure function of arrays.

Conventions of every function here: ``time: (n,) s`` strictly rising, signals ``(n,)`` in their
own unit, NaN where a sample is missing. Missing samples are left out: an integral goes from one
sample that there is to the next, as a sensor slower than the loop wants it. What cannot be
computed is NaN; :mod:`trms_cli.scoring.score` turns it into null.

Step responses: a *hold* is a stretch of at least ``MINIMUM_HOLD`` seconds in which the reference
does not change. A *step* is a jump of the reference by at least ``SMALLEST_STEP`` from a value at
rest to a hold; the begin of a run is one if the response is not where the first hold wants it.
A first hold that is shorter than each that follows is none of this: the reference waits there for
its first step while the rig still comes from its rest, and neither figure is of it.
References that only move (sines, ramps, sawteeth, fast binary sequences, shaped steps) have no
steps, and their step metrics do not exist. With several steps the figure of a run is that of its
worst step: one bad step out of six is what a user of the rig would notice. The median over steps
stands beside it. A step that never settles (or rises) within its hold counts as infinitely slow, so
that neither figure exists if the worst, or the median, step did not arrive.

Whether an observer believes the right amount: NEES, NIS and whiteness of the innovations. Sources:
Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with applications to tracking and navigation",
section 5.4; G. M. Ljung, G. E. P. Box, "On a measure of lack of fit in time series models",
Biometrika 65(2), 1978.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from trms_cli.core.arrays import FloatArray as Array


def rmse(error: Array) -> float:
    """``sqrt(mean(e²))`` over the samples that there are."""
    present = error[~np.isnan(error)]
    return math.sqrt(float(np.mean(present**2))) if present.size else math.nan


def max_abs_error(error: Array) -> float:
    """``max |e|``."""
    present = error[~np.isnan(error)]
    return float(np.max(np.abs(present))) if present.size else math.nan


def integral(time: Array, values: Array) -> float:
    """``∫ values dt`` by the trapezoidal rule."""
    present = ~np.isnan(values)
    if np.count_nonzero(present) < 2:
        return math.nan
    samples, times = values[present], time[present]
    return float(np.sum((samples[1:] + samples[:-1]) / 2 * np.diff(times)))


def iae(time: Array, error: Array) -> float:
    """Integral of the absolute error, ``∫ |e| dt``."""
    return integral(time, np.abs(error))


def ise(time: Array, error: Array) -> float:
    """Integral of the squared error, ``∫ e² dt``."""
    return integral(time, error**2)


def itae(time: Array, error: Array) -> float:
    """Time-weighted integral of the absolute error, ``∫ (t − t_0) |e| dt``.

    ``t_0`` is the first sample of the run, also when the reference steps later: the measure
    stays one number per run, and compares runs of the same reference only.
    """
    if time.size == 0:
        return math.nan
    return integral(time, (time - time[0]) * np.abs(error))


def input_effort(time: Array, command: Array) -> float:
    """``∫ u² dt`` of a command that is held between samples."""
    present = ~np.isnan(command)
    if np.count_nonzero(present) < 2:
        return math.nan
    return float(np.sum(command[present][:-1] ** 2 * np.diff(time[present])))


def total_variation(command: Array) -> float:
    """``Σ |u_k − u_{k−1}|``."""
    present = command[~np.isnan(command)]
    return float(np.sum(np.abs(np.diff(present)))) if present.size else math.nan


def saturation_share(command: Array, lower: float, upper: float) -> float:
    """Share of the samples at a limit, 0 to 1: within 1e-6 of the range of it, or beyond."""
    present = command[~np.isnan(command)]
    if not present.size:
        return math.nan
    close = 1e-6 * (upper - lower) if math.isfinite(upper - lower) else 0.0
    return float(np.mean((present <= lower + close) | (present >= upper - close)))


def excess(values: Array, lower: float, upper: float) -> Array:
    """How far each present value is outside its limits, 0 inside; shorter if some are NaN."""
    present = values[~np.isnan(values)]
    return np.maximum(np.maximum(lower - present, present - upper), 0.0)


def worst(values: Iterable[float]) -> float:
    """The largest; NaN without any."""
    return max(values, default=math.nan)


def median(values: Iterable[float]) -> float:
    """The median; NaN without any."""
    present = list(values)
    return float(np.median(present)) if present else math.nan


def quantile(values: Array, share: float) -> float:
    """A quantile of the samples that there are."""
    present = values[~np.isnan(values)]
    return float(np.quantile(present, share)) if present.size else math.nan


class Columns(Protocol):
    """Signals over time, as a log's table has them."""

    @property
    def time(self) -> Array:
        """(n,) s, rising."""

    @property
    def columns(self) -> Mapping[str, Any]:
        """(n,) arrays by name."""

    @property
    def units(self) -> Mapping[str, str]:
        """Units by name; a signal that it lacks is scored without one."""


@dataclass(frozen=True)
class Series:
    """Signals over time that were never in a file: what the closed loop has in memory."""

    time: Array  #: (n,) s
    columns: Mapping[str, Any]  #: dict of str to (n,) arrays
    units: Mapping[str, str] = field(default_factory=dict)


def hold_at(table: Columns, name: str, time: Array) -> Array:
    """A signal at other times: its last sample until then, NaN before the first one."""
    values = floats(table, name)
    if np.array_equal(table.time, time):
        return values
    index = np.searchsorted(table.time, time + 1e-9, side="right") - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], np.nan)


def floats(table: Columns, name: str) -> Array:
    return np.asarray(table.columns[name], dtype=float)


def unit(table: Columns, name: str) -> str:
    """The unit that the log's schema tells; a name alone tells none."""
    return table.units.get(name, "")


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
    rise_time: float  #: s between the first crossings of 10 and 90 % of the step, interpolated
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


def judged_holds(time: Array, reference: Array) -> list[tuple[int, int]]:
    """The holds without the wait for the first step: a first one that is shorter than all others.

    Of a reference that is 0 for one second and then steps, the rise of the beam from its rest is no
    response to that 0.
    """
    stretches = holds(time, reference)
    if len(stretches) < 2 or stretches[0][0] > 0:
        return stretches
    spans = [time[min(end, time.size - 1)] - time[begin] for begin, end in stretches]
    return stretches[1:] if spans[0] < min(spans[1:]) - 1e-9 else stretches


def steps(time: Array, reference: Array, response: Array) -> list[StepMetrics]:
    """Metrics of every step of the reference, in order; ``time``: (n,) s, the others (n,) rad."""
    results = []
    for begin, end in judged_holds(time, reference):
        origin = _origin(reference, response, begin)
        size = float(reference[begin]) - origin
        part = slice(begin, end)
        present = ~np.isnan(response[part])
        if abs(size) >= SMALLEST_STEP and present.any():
            fraction = (response[part][present] - origin) / size
            results.append(_step_metrics(time[part][present] - time[begin], fraction))
    return results


def steady_state_error(time: Array, reference: Array, response: Array) -> float:
    """Largest magnitude, over the holds, of the mean error in the last fifth of the hold.

    Of all holds but the wait for a first step (:func:`judged_holds`), also those that a ramp led
    to; NaN if the reference never rests.
    """
    means = []
    for begin, end in judged_holds(time, reference):
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


#: Lags of the Ljung–Box statistic. Even: the tail of χ² then has a closed form.
LAGS = 20
#: Fewer innovations than this say nothing about LAGS correlations.
MINIMUM_SAMPLES = 5 * LAGS


def nees(error: Array, standard_deviation: Array) -> Array:
    """Normalised estimation error squared of each sample, by the diagonal of the covariance.

    ``Σ_i (e_i / σ_i)²``. The log holds standard deviations and no covariances. The mean over
    samples of a consistent filter is the number of states all the same, because
    ``E e_i² = σ_i²`` whatever the correlations; only its spread differs from the full form's.

    Both are (n, n_x), each column in its state's unit, deviations above 0. Gives (n,) -, NaN where
    a state is missing.
    """
    return np.sum((error / standard_deviation) ** 2, axis=1)


def normalised_square(innovation: Array, standard_deviation: Array) -> float:
    """Mean of (ν/σ)² of one channel: 1 for a filter that believes the right amount.

    Samples without a deviation above 0 are left out; NaN if that leaves none.
    """
    present = ~np.isnan(innovation) & (standard_deviation > 0)
    share = innovation[present] / standard_deviation[present]
    return float(np.mean(share**2)) if share.size else math.nan


def neighbour_correlation(values: Array) -> float:
    """Correlation of each value with the next one; pairs that lack one are left out."""
    centred = values - np.nanmean(values) if np.any(~np.isnan(values)) else values
    product = centred[1:] * centred[:-1]
    power = centred**2
    if np.all(np.isnan(product)) or not np.nansum(power) > 0:
        return math.nan
    return float(np.nanmean(product) / np.nanmean(power))


def whiteness_p(innovation: Array) -> float:
    """p-value of the Ljung–Box test: small if the innovations are correlated in time.

    ``Q = n(n + 2) Σ_{k=1}^{20} ρ_k²/(n − k)``, compared with χ² of 20 degrees of freedom.
    Missing innovations are left out as if the others followed each other, as they do when a
    sensor is slower than the loop.
    """
    present = innovation[~np.isnan(innovation)]
    n = present.size
    if n < MINIMUM_SAMPLES:
        return math.nan
    centred = present - np.mean(present)
    power = float(centred @ centred)
    if power <= 1e-24 * n * float(np.max(np.abs(present)) ** 2):
        return math.nan  # constant: there is nothing to correlate
    correlation = np.array([float(centred[lag:] @ centred[:-lag]) for lag in range(1, LAGS + 1)])
    statistic = (
        n * (n + 2) * float(np.sum((correlation / power) ** 2 / (n - np.arange(1, LAGS + 1))))
    )
    return chi_square_tail(statistic, LAGS)


def chi_square_tail(statistic: float, degrees: int) -> float:
    """``P(χ² > statistic)``: each two degrees more than one or two add a term to the tail.

    ``e^{−x} Σ x^i / i!`` over ``i < degrees/2`` with ``x = statistic/2``; of an odd number of
    degrees i is ½, 1½, … and ``erfc √x`` the first term. Importing SciPy for it would take longer
    than scoring a run.
    """
    x = statistic / 2
    if x <= 0:
        return 1.0
    exponents = [
        (k / 2) * math.log(x) - math.lgamma(k / 2 + 1) - x for k in range(degrees % 2, degrees, 2)
    ]
    first = math.erfc(math.sqrt(x)) if degrees % 2 else 0.0
    return min(1.0, first + math.fsum(map(math.exp, exponents)))


def chi_square_interval(degrees: int, share: float = 0.95) -> tuple[float, float]:
    """Bounds between which χ² lies with probability ``share``, as often below as above.

    By bisection of the tail: a quantile has no closed form, and SciPy is slow to import.
    """
    beyond = (1.0 - share) / 2.0
    return _chi_square_quantile(1.0 - beyond, degrees), _chi_square_quantile(beyond, degrees)


def _chi_square_quantile(tail: float, degrees: int) -> float:
    """The value that χ² exceeds with probability ``tail``."""
    low, high = 0.0, 1.0
    while chi_square_tail(high, degrees) > tail:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = (low + high) / 2.0
        if chi_square_tail(middle, degrees) > tail:
            low = middle
        else:
            high = middle
    return (low + high) / 2.0


def joint_p(p_values: list[float]) -> float:
    """One p-value of several tests: the smallest, times their number (Bonferroni).

    It holds whatever the dependence between the channels. NaN without any test.
    """
    present = [p for p in p_values if not math.isnan(p)]
    return min(1.0, len(present) * min(present)) if present else math.nan
