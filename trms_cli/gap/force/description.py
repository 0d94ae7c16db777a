"""A missing force in sentences, for a gap that no named effect closes.

Each sentence is about one question and stands only where the answer is beyond chance: offset, band,
memory, direction of motion, drift and change, region, what it depends on. Chance is judged over
blocks longer than the force remembers.
"""

from __future__ import annotations

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.gap.force.exogenous import exogenous
from trms_cli.gap.force.laws import LAWS, explained_shares
from trms_cli.gap.force.record import (
    ForceRecord,
    blocks,
    correlation_time,
    sample_time,
    segments,
    signal_power,
    thinned,
)
from trms_cli.gap.force.regions import change_time, regions

#: t-value of what is told, from about a dozen blocks or more.
_TOLD = 4.0
#: Share of the energy from which an offset is worth a sentence.
_OFFSET = 0.1
#: Force over noise, root mean square, under which there is nothing to describe.
_NOTHING = 1.15
#: Width of a band over its middle under which it is an oscillation.
_NARROW = 0.5
#: Width under which it is an oscillation at one frequency.
_LINE = 0.1
#: Predictable share from which a force is the rig's own, and up to which it is from outside.
_OWN, _OUTSIDE = 0.5, 0.15
#: Share from which a law's form is called the closest.
_CLOSE = 0.5
#: Hz, of means, works and trends.
_RATE = 25.0


def description(record: ForceRecord, seed: int = 0) -> tuple[str, ...]:
    """What the force looks like.

    ``seed``: of the test against a force from outside. Returns tuple of str: sentences; a single
    one where the force does not stand out of its noise.
    """
    rms = float(np.sqrt(np.mean(record.force**2)))
    noise = float(np.sqrt(np.mean(record.sd**2)))
    place, unit = record.location, record.unit
    if rms <= _NOTHING * noise or rms == 0:
        return (
            f"Nothing stands out of the noise at {place}: {rms:.2g} {unit} RMS, "
            f"of which noise alone explains {noise:.2g}.",
        )
    fine = thinned(record, _RATE)
    told = [
        f"A missing contribution at {place} of {rms:.2g} {unit} RMS (noise {noise:.2g} {unit}).",
        _offset(fine),
        _band(record),
        _direction(fine),
        _trend(fine),
        _change(record),
        *_where(record),
        _origin(record, seed),
        _closest_form(record),
    ]
    return tuple(sentence for sentence in told if sentence)


def _offset(record: ForceRecord) -> str:
    mean = float(record.force.mean())
    energy = signal_power(record, float(np.mean(record.force**2)))
    if abs(_block_t(record, record.force)) < _TOLD or mean**2 < _OFFSET * energy:
        return ""
    share = min(mean**2 / energy, 1.0)
    return f"A constant offset of {mean:.2g} {record.unit} is {share:.0%} of its energy."


def _band(record: ForceRecord) -> str:
    """Where 80 % of the power lies, the offset apart, and how long the force remembers."""
    force = record.force - record.force.mean()
    if not np.any(force):
        return ""
    step = sample_time(record)
    longest = max(part.stop - part.start for part in segments(record))
    frequency = np.fft.rfftfreq(longest, step)
    power = np.zeros(frequency.size)
    for part in segments(record):
        power += np.abs(np.fft.rfft(force[part] * np.hanning(part.stop - part.start), longest)) ** 2
    below = np.cumsum(power) / power.sum()
    low, high = (float(frequency[np.searchsorted(below, share)]) for share in (0.1, 0.9))
    middle = (low + high) / 2
    if high - low < _NARROW * middle and low > 3 / (longest * step):
        if high - low < _LINE * middle:
            return f"It oscillates at {middle:.2g} Hz."
        return f"It oscillates: 80 % of its power lies between {low:.2g} and {high:.2g} Hz."
    memory = correlation_time(record, record.force)
    return f"90 % of its power lies below {high:.2g} Hz; it forgets itself over {memory:.2g} s."


def _direction(record: ForceRecord) -> str:
    """Work and memory: whether the force depends on which way the axis goes."""
    axis, unit = record.axis, record.unit
    if axis not in record.rates or not record.location.endswith(("moment", "thrust")):
        return ""
    rate = record.rates[axis]
    work = (record.force - record.force.mean()) * rate
    t = _block_t(record, work)
    if abs(t) < _TOLD:
        return ""
    moving = np.abs(rate) > 0.3 * float(rate.std())
    forth, back = record.force[moving & (rate > 0)], record.force[moving & (rate < 0)]
    apart = float(forth.mean() - back.mean()) / 2 if forth.size and back.size else 0.0
    power = float(work.mean())
    if axis in record.angles:
        travel = float(np.mean(np.abs(rate)))
        size = f"loop of force against angle: {power / travel:.2g} {unit} per radian of travel"
    else:
        size = f"on average {power:.2g} W"
    what = "opposes the motion and takes energy out" if t < 0 else "goes with the motion, drives it"
    return (
        f"It {what} of {axis} ({size}, t = {t:.1f}); it differs by ±{abs(apart):.2g} {unit} "
        "between the two directions of motion."
    )


def _trend(record: ForceRecord) -> str:
    """Whether mean or strength drift with time, over the blocks of one recording."""
    if np.any(record.recording != record.recording[0]):
        return ""
    number, first = _blocks_of(record)
    if first.size < 6:
        return ""
    count = np.diff([*first, number.size])
    clock = np.add.reduceat(record.time, first) / count
    force = np.add.reduceat(record.force, first) / count
    strength = np.add.reduceat(np.abs(record.force - record.force.mean()), first) / count
    minutes = float(np.ptp(record.time)) / 60
    slope, t = _line(clock, force)
    if abs(t) > _TOLD:
        return f"It drifts by {slope * 60:.2g} {record.unit} per minute (t = {t:.1f})."
    slope, t = _line(clock, strength)
    if abs(t) > _TOLD:
        change = slope * minutes * 60 / float(strength.mean())
        return f"Its strength changes by {change:+.0%} over the recording (t = {t:.1f})."
    return ""


def _change(record: ForceRecord) -> str:
    when = change_time(record)
    return "" if when is None else f"It changes for good at t = {when:g} s."


def _where(record: ForceRecord) -> list[str]:
    found = [region for region in regions(record) if " t = " not in region.condition]
    return [f"{region.share:.0%} of its energy lies where: {region.condition}." for region in found]


def _origin(record: ForceRecord, seed: int) -> str:
    judged = exogenous(record, seed)
    low, high = judged.ci95
    share = f"{judged.predictable_share:.0%} of it (95 % interval {low:.0%} to {high:.0%})"
    if judged.predictable_share >= _OWN:
        return (
            f"It is the rig's own doing: {', '.join(judged.from_variables)} predict {share} "
            "on held-out data."
        )
    if judged.predictable_share > _OUTSIDE or high > _OWN:
        of = f" ({', '.join(judged.from_variables)})" if judged.from_variables else ""
        return f"What the rig does{of} predicts {share} on held-out data: part may be from outside."
    return (
        f"It comes from outside, or from what is not measured: what the rig does predicts {share}."
    )


def _closest_form(record: ForceRecord) -> str:
    shares = explained_shares(record)
    best = max(shares, key=lambda name: shares[name])
    if shares[best] < _CLOSE:
        return "No known form comes near it."
    form = LAWS[best][0].format(axis=record.axis)
    return f"The closest known form is {form}: {shares[best]:.0%} of its variance."


def _blocks_of(record: ForceRecord) -> tuple[IntArray, IntArray]:
    """Block of each sample, and the first sample of each block; blocks forget each other."""
    memory = correlation_time(record, record.force)
    duration = record.time.size * sample_time(record)
    number = blocks(record, min(max(1.0, 2 * memory), duration / 12))
    return number, np.flatnonzero(np.diff(number, prepend=-1)).astype(np.int64)


def _block_t(record: ForceRecord, values: FloatArray) -> float:
    """t-value of a mean, from the means of blocks."""
    number, first = _blocks_of(record)
    means = np.add.reduceat(values, first) / np.diff([*first, number.size])
    if means.size < 3:
        return 0.0
    return float(means.mean() / (means.std(ddof=1) / np.sqrt(means.size) + 1e-300))


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Slope of a straight line and its t-value."""
    x = x - x.mean()
    slope = float(x @ y / (x @ x))
    left = y - y.mean() - slope * x
    sd = float(np.sqrt(left @ left / max(y.size - 2, 1) / (x @ x)))
    return slope, slope / (sd + 1e-300)
