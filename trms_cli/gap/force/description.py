"""A missing force in sentences, for a gap that no named effect closes.

Each sentence is about one question and stands only where the answer is beyond chance: offset, band,
memory, direction of motion, drift and change, region, what it depends on. Chance is judged over
blocks longer than the force remembers.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import rel_entr

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.core.wording import listing
from trms_cli.gap.diagnosis import RegionShare
from trms_cli.gap.force.exogenous import exogenous
from trms_cli.gap.force.laws import LAWS, ForceRecord, explained_shares
from trms_cli.models.rig_parts import RigParts

#: How many are told at most.
MOST = 3
#: Chance that a force without any region is given one.
_FALSE_ALARM = 0.02
_DRAWS = 600
#: Length of a block in memories of the force, and how many there are at least.
_BLOCK, _FEWEST_BLOCKS = 1.0, 10
#: Hz. Regions are seconds wide.
_REGION_RATE = 10.0
#: Shares of time that a condition may hold over.
_RAREST, _COMMONEST = 0.03, 0.75
#: By how much, and how many times, the share of energy must exceed that of time.
_EXCESS, _LIFT = 0.12, 1.3
#: Energy of the force over its mean square below which nothing can be said.
_LEAST_ENERGY = 0.2
#: Part of a rotor's largest speed, or of the largest command, that counts as none.
_STANDSTILL = 0.1
_HIGH, _LOW = (0.5, 0.7, 0.85), (0.5, 0.3, 0.15)
_ROUND = np.array([1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10])


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A condition on what the rig does."""

    text: str  #: In an engineer's words
    about: str  #: The variable that it is about
    holds: BoolArray  #: (k,) array of bool; where it holds


def regions(record: ForceRecord) -> tuple[RegionShare, ...]:
    """The most telling regions of a missing force.

    Returns tuple of RegionShare: at most :data:`MOST`, the most telling first: by what is learnt of
    the energy's whereabouts (Kullback–Leibler divergence of its share from that of time).
    """
    record = record.thinned(_REGION_RATE)
    energy = record.force**2 - record.sd**2
    total = float(energy.sum())
    if total <= _LEAST_ENERGY * float(np.sum(record.force**2)) or total <= 0:
        return ()
    conditions = [
        condition
        for condition in all_conditions(record)
        if _RAREST <= condition.holds.mean() <= _COMMONEST
    ]
    if not conditions:
        return ()
    holds = np.array([condition.holds for condition in conditions], dtype=np.float64)
    in_time = holds.mean(axis=1)
    in_energy = np.clip(holds @ energy / total, 0.0, 1.0)
    chance = np.maximum([in_time, 1 - in_time], 1e-12)
    telling = rel_entr([in_energy, 1 - in_energy], chance).sum(axis=0)
    beyond_chance = _significant(record, energy, holds - in_time[:, None])
    clear = beyond_chance & (in_energy > in_time + _EXCESS) & (in_energy > _LIFT * in_time)
    selection: list[int] = []
    for i in np.argsort(-telling):
        if len(selection) < MOST and clear[i] and _adds(i, selection, conditions, energy):
            selection.append(int(i))
    return tuple(
        RegionShare(
            location=record.location, condition=conditions[i].text, share=float(in_energy[i])
        )
        for i in selection
    )


def change_time(record: ForceRecord) -> float | None:
    """When the strength of the force changed for good, s; None where nothing shows it.

    The time that makes two constant variances most likely. It counts if time is among the regions:
    the states that the rig visits change too, and a force of the state with them.
    """
    when = ("before t", "after t", "first third", "last third")
    if not any(region.condition.startswith(when) for region in regions(record)):
        return None
    return _most_likely_change(record.thinned(_REGION_RATE))


def all_conditions(record: ForceRecord) -> tuple[Condition, ...]:
    """All conditions that are tried, thresholds at quantiles of the recording, rounded."""
    conditions: list[Condition] = []
    for axis, values in record.angles.items():
        conditions += _about_an_angle(record.parts, axis, values)
    for axis, values in record.rates.items():
        conditions += _about_a_rate(record.parts, axis, values)
    for rotor, values in record.speeds.items():
        conditions += _about_a_rotor(rotor, values)
    for rotor, values in record.commands.items():
        conditions += _about_a_command(rotor, values, record)
    conditions += _about_time(record)
    unique = {condition.text: condition for condition in conditions}
    return tuple(unique.values())


def nearest_round_number(value: float) -> float:
    """To the nearest of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten."""
    if value == 0 or not np.isfinite(value):
        return 0.0
    power = 10.0 ** np.floor(np.log10(abs(value)))
    nearest = _ROUND[np.argmin(np.abs(np.log(_ROUND * power / abs(value))))]
    return float(f"{np.sign(value) * nearest * power:.3g}")


def _limits(
    text: str, about: str, values: FloatArray, quantiles: tuple[float, ...]
) -> Iterator[Condition]:
    """Values above, or with a ``<`` in the text below, rounded quantiles of themselves."""
    for at in map(nearest_round_number, np.quantile(values, quantiles).tolist()):
        holds = values < at if "<" in text else values > at
        yield Condition(text=text.format(f"{at:g}"), about=about, holds=holds)


def _about_an_angle(parts: RigParts, axis: str, values: FloatArray) -> Iterator[Condition]:
    about, size = parts.angle(axis), np.abs(values)
    symbol, unit = parts.axes[axis].angle, parts.unit(axis)
    low, high = ("beam low: ", "beam high: ") if axis == parts.beam else ("", "")
    yield from _limits(f"|{symbol}| > {{}} {unit}", about, size, _HIGH)
    yield from _limits(f"|{symbol}| < {{}} {unit}", about, size, _LOW[1:])
    yield from _limits(f"{high}{symbol} > {{}} {unit}", about, values, _HIGH)
    yield from _limits(f"{low}{symbol} < {{}} {unit}", about, values, _LOW)


def _about_a_rate(parts: RigParts, axis: str, values: FloatArray) -> Iterator[Condition]:
    about, size = parts.rate(axis), np.abs(values)
    unit = f"{parts.unit(axis)}/s"
    yield from _limits(f"{about} near zero (|rate| < {{}} {unit})", about, size, _LOW)
    yield from _limits(f"{axis} moving fast (|rate| > {{}} {unit})", about, size, _HIGH)
    yield Condition(text=f"{about} positive", about=about, holds=values > 0)
    yield Condition(text=f"{about} negative", about=about, holds=values < 0)


def _about_a_rotor(rotor: str, values: FloatArray) -> Iterator[Condition]:
    name, size = f"{rotor} rotor", np.abs(values)
    about = f"{name} speed"
    still = nearest_round_number(_STANDSTILL * float(size.max(initial=0.0)))
    text = f"{name} near standstill (|speed| < {still:g} rad/s)"
    yield Condition(text=text, about=about, holds=size < still)
    yield Condition(text=f"{name} turning backwards", about=about, holds=values < -0.3 * still)
    yield Condition(text=f"{name} turning forwards", about=about, holds=values > 0.3 * still)
    yield from _limits(f"{name} fast (|speed| > {{}} rad/s)", about, size, _HIGH)
    yield from _limits(f"{name} slow (|speed| < {{}} rad/s)", about, size, _LOW)


def _about_a_command(rotor: str, values: FloatArray, record: ForceRecord) -> Iterator[Condition]:
    about, size = f"{rotor} command", np.abs(values)
    unit = f" {record.parts.command_unit(rotor)}".rstrip()
    zero = nearest_round_number(_STANDSTILL * float(size.max(initial=0.0)))
    yield Condition(
        text=f"{about} near zero (|u| < {zero:g} {unit})", about=about, holds=size < zero
    )
    yield from _limits(f"{about} |u| > {{}} {unit}", about, size, _HIGH)
    # A step's effect on a slow force shows for about half a second.
    ago = max(round(0.5 / record.sample_time), 1)
    command_change = np.zeros(values.size)
    command_change[ago:] = np.abs(values[ago:] - values[:-ago])
    text = f"{about} changing (by over {{}}{unit} in 0.5 s)"
    yield from _limits(text, f"change of the {about}", command_change, _HIGH[1:])


def _about_time(record: ForceRecord) -> Iterator[Condition]:
    numbers = np.unique(record.recording)
    if numbers.size > 1:
        for number in numbers:
            text = f"recording {number + 1}"
            yield Condition(text=text, about="time", holds=record.recording == number)
        return
    start, end = float(record.time[0]), float(record.time[-1])
    third = (end - start) / 3
    first, last = record.time < start + third, record.time > end - third
    yield Condition(text="first third of the recording", about="time", holds=first)
    yield Condition(text="last third of the recording", about="time", holds=last)
    # The grid stands for the search; only the time that was found is put in words.
    grid = [round(at) for at in np.linspace(start, end, 22)[2:-2].tolist()]
    for at in (*grid, _most_likely_change(record)):
        later = record.time >= at
        yield Condition(text=f"after t = {at:g} s", about="time", holds=later)
        yield Condition(text=f"before t = {at:g} s", about="time", holds=~later)


def _most_likely_change(record: ForceRecord) -> float:
    """Time of the one change of variance that is most likely, s, to three digits."""
    square = record.force**2
    samples = square.size
    count = np.arange(1, samples)
    before = np.cumsum(square)[:-1]
    after = max(float(square.sum()), 1e-300) - before
    floor = 1e-12 * float(square.mean()) + 1e-300
    cost = count * np.log(before / count + floor)
    cost += (samples - count) * np.log(np.maximum(after, 0.0) / (samples - count) + floor)
    margin = max(samples // 20, 1)
    at = margin + int(np.argmin(cost[margin:-margin])) if samples > 3 * margin else samples // 2
    return float(f"{record.time[at]:.3g}")


def _adds(i: int, selection: list[int], conditions: list[Condition], energy: FloatArray) -> bool:
    """Whether a condition gathers energy within each of the chosen ones too, and is about more."""
    new = conditions[i]
    for j in selection:
        old = conditions[j]
        if new.about == old.about:
            return False
        in_time = float(new.holds[old.holds].mean())
        in_energy = float(energy[new.holds & old.holds].sum() / energy[old.holds].sum())
        if in_energy < max(in_time + _EXCESS, _LIFT * in_time):
            return False
    return True


def _significant(record: ForceRecord, energy: FloatArray, surplus: FloatArray) -> BoolArray:
    """Which rows of ``surplus`` (condition less its share of time) gather energy beyond chance."""
    # Of the signed force: the energy of one that acts in half of the recording remembers for ever.
    _, first = _blocks_of(record, _BLOCK, _FEWEST_BLOCKS)
    sums = np.add.reduceat(surplus * energy, first, axis=1)
    scale = np.sqrt(np.sum(sums**2, axis=1)) + 1e-300
    sums = sums / scale[:, None]
    sign = np.random.default_rng(0).choice([-1.0, 1.0], size=(_DRAWS, sums.shape[1]))
    largest = np.max(sign @ sums.T, axis=1)
    return np.asarray(sums.sum(axis=1) > np.quantile(largest, 1 - _FALSE_ALARM))


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


def description(record: ForceRecord, foretold: float | None = None) -> tuple[str, ...]:
    """What the force looks like: a single sentence where it does not stand out of its noise.

    ``foretold``: share of it that a residual without a name foretells on held-out blocks, where one
    was fitted; None: a regression on the record judges whether it comes from outside.
    """
    rms = float(np.sqrt(np.mean(record.force**2)))
    noise = float(np.sqrt(np.mean(record.sd**2)))
    place, unit = record.location, record.unit
    if rms <= _NOTHING * noise or rms == 0:
        return (
            f"Nothing stands out of the noise at {place}: {rms:.2g} {unit} RMS, "
            f"of which noise alone explains {noise:.2g}.",
        )
    fine, change = record.thinned(_RATE), change_time(record)
    parts = [
        f"A missing contribution at {place} of {rms:.2g} {unit} RMS (noise {noise:.2g} {unit}).",
        _offset(fine),
        _band(record),
        _direction(fine),
        _trend(fine),
        "" if change is None else f"It changes for good at t = {change:g} s.",
        *(
            f"{region.share:.0%} of its energy lies where: {region.condition}."
            for region in regions(record)
            if " t = " not in region.condition
        ),
        _origin(record) if foretold is None else _predicted_origin(record, foretold),
        _closest_form(record),
    ]
    return tuple(sentence for sentence in parts if sentence)


def _offset(record: ForceRecord) -> str:
    mean = float(record.force.mean())
    energy = record.signal_power(float(np.mean(record.force**2)))
    if abs(_block_t(record, record.force)) < _TOLD or mean**2 < _OFFSET * energy:
        return ""
    share = min(mean**2 / energy, 1.0)
    return f"A constant offset of {mean:.2g} {record.unit} is {share:.0%} of its energy."


def _band(record: ForceRecord) -> str:
    """Where 80 % of the power lies, the offset apart, and how long the force remembers."""
    force = record.force - record.force.mean()
    if not np.any(force):
        return ""
    step = record.sample_time
    longest = max(part.stop - part.start for part in record.segments)
    frequency = np.fft.rfftfreq(longest, step)
    power = np.zeros(frequency.size)
    for part in record.segments:
        power += np.abs(np.fft.rfft(force[part] * np.hanning(part.stop - part.start), longest)) ** 2
    below = np.cumsum(power) / power.sum()
    low, high = (float(frequency[np.searchsorted(below, share)]) for share in (0.1, 0.9))
    middle = (low + high) / 2
    if high - low < _NARROW * middle and low > 3 / (longest * step):
        if high - low < _LINE * middle:
            return f"It oscillates at {middle:.2g} Hz."
        return f"It oscillates: 80 % of its power lies between {low:.2g} and {high:.2g} Hz."
    memory = record.correlation_time(record.force)
    return f"90 % of its power lies below {high:.2g} Hz; it forgets itself over {memory:.2g} s."


def _direction(record: ForceRecord) -> str:
    """Work and memory: whether the force depends on which way the axis goes."""
    axis, unit = record.axis, record.unit
    if axis not in record.rates or record.kind not in ("moment", "thrust"):
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
        noun, per = record.parts.nouns(axis)
        size = f"loop of force against {noun}: {power / travel:.2g} {unit} per {per} of travel"
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


def _origin(record: ForceRecord) -> str:
    dependence = exogenous(record)
    low, high = dependence.ci95
    share = f"{dependence.predictable_share:.0%} of it (95 % interval {low:.0%} to {high:.0%})"
    if dependence.predictable_share >= _OWN:
        return (
            f"It is the rig's own doing: {', '.join(dependence.from_variables)} predict {share} "
            "on held-out data."
        )
    if dependence.predictable_share > _OUTSIDE or high > _OWN:
        of = f" ({', '.join(dependence.from_variables)})" if dependence.from_variables else ""
        return f"What the rig does{of} predicts {share} on held-out data: part may be from outside."
    return (
        f"It comes from outside, or from what is not measured: what the rig does predicts {share}."
    )


def _predicted_origin(record: ForceRecord, share: float) -> str:
    """Where it comes from, by what smooth terms of the motion foretell through simulation."""
    turns = [record.parts.turns(axis) for axis in record.angles] or [True]
    words = ["positions"] * (not all(turns)) + ["angles"] * any(turns)
    words += ["velocities"] * (not all(turns)) + ["rates"] * any(turns)
    words += ["speeds"] * bool(record.parts.rotors) + ["commands"]
    terms = f"smooth terms of {listing(words)} foretell "
    text = f"{terms}{share:.0%} of it on held-out blocks"
    if share >= _OWN:
        return f"It is the rig's own doing: {text}."
    return f"{text.capitalize()}: it comes from outside, or from what they do not remember."


def _closest_form(record: ForceRecord) -> str:
    shares = explained_shares(record)
    best = max(shares, key=lambda name: shares[name])
    if shares[best] < _CLOSE:
        return "No known form comes near it."
    parts, axis = record.parts, record.axis
    form = LAWS[best][0].format(
        rate=parts.rate(axis), angle=parts.angle(axis), tilting=parts.tilting
    )
    return f"The closest known form is {form}: {shares[best]:.0%} of its variance."


def _blocks_of(
    record: ForceRecord, memories: float = 2.0, fewest: int = 12
) -> tuple[IntArray, IntArray]:
    """Block of each sample, and the first sample of each block; blocks forget each other.

    ``memories``: of the force, that one is long at least. ``fewest``: blocks.
    """
    memory = record.correlation_time(record.force)
    duration = record.time.size * record.sample_time
    number = record.blocks(min(max(1.0, memories * memory), duration / fewest))
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
    residual = y - y.mean() - slope * x
    sd = float(np.sqrt(residual @ residual / max(y.size - 2, 1) / (x @ x)))
    return slope, slope / (sd + 1e-300)
