"""A missing force, sample by sample, and laws that it may follow.

The smoother of the pipeline estimates the force; all that describes it reads the record and nothing
else. Several recordings of one rig stand one after another.

A law is the form of an effect without its size, as a few columns of a regression: ``rate·|rate|``
for quadratic damping. What enters nonlinearly, such as the width of a dead zone, is spread over a
few columns. The share of the force's variation, its noise apart, that a regression on the columns
explains, less what as many columns explain by chance, says which law comes nearest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from trms_cli.core.arrays import FloatArray, IntArray
from trms_cli.models.rig_parts import BEAM, RigParts

#: The largest part of a mean square that is taken for noise, whatever the smoother says of it.
MOST_NOISE = 0.8


@dataclass(frozen=True, kw_only=True)
class ForceRecord:
    """A smoothed force at one place of the block diagram.

    Raises ValueError: Series of different lengths.
    """

    location: str  #: See :mod:`trms_cli.effects.places`
    unit: str  #: Of the force: N*m, V, rad, rad/s
    time: FloatArray  #: (k,) array; s, rising within a recording
    recording: IntArray  #: (k,) array; of which recording; the samples of one stand together
    force: FloatArray  #: (k,) array; smoothed estimate
    sd: FloatArray  #: (k,) array; its standard deviation
    #: dict of str to (k,) array; by axis (``pitch``), rad or m, and the same by s
    angles: Mapping[str, FloatArray] = field(default_factory=dict)
    rates: Mapping[str, FloatArray] = field(default_factory=dict)  #: likewise
    #: dict of str to (k,) array; by rotor (``main``), rad/s; may be absent
    speeds: Mapping[str, FloatArray] = field(default_factory=dict)
    #: dict of str to (k,) array; by rotor, or by the name of an input without one
    commands: Mapping[str, FloatArray] = field(default_factory=dict)
    parts: RigParts = BEAM  #: What the model calls its parts

    def __post_init__(self) -> None:
        series = [self.time, self.recording, self.force, self.sd]
        for group in (self.angles, self.rates, self.speeds, self.commands):
            series.extend(group.values())
        lengths = {np.shape(values) for values in series}
        if len(lengths) != 1 or len(next(iter(lengths))) != 1:
            raise ValueError(f"series of a force record differ in shape: {sorted(lengths)}")

    @property
    def axis(self) -> str:
        """Axis that a force at this place moves."""
        return self.parts.axis_at(self.location)

    @property
    def drive(self) -> str:
        """The drive of the place: its own, or the one that moves its axis."""
        part = self.parts.part_of(self.location)
        return part if part in self.parts.drives else self.parts.drive_of(self.axis)

    @property
    def kind(self) -> str:
        """What the place is: ``moment``, ``motor``, ``actuator``, ``thrust``, ``sensor``."""
        return self.parts.kind_of(self.location)

    @property
    def variables(self) -> dict[str, FloatArray]:
        """All that the force may depend on, by the names that sentences use."""
        parts = self.parts
        return {
            **{parts.angle(axis): values for axis, values in self.angles.items()},
            **{parts.rate(axis): values for axis, values in self.rates.items()},
            **{f"{rotor} rotor speed": values for rotor, values in self.speeds.items()},
            **{f"{name} command": values for name, values in self.commands.items()},
        }

    def subset(self, rows: IntArray) -> ForceRecord:
        """Only these samples of it."""
        fields: dict[str, Any] = {}
        for name in ("time", "recording", "force", "sd"):
            fields[name] = getattr(self, name)[rows]
        for name in ("angles", "rates", "speeds", "commands"):
            fields[name] = {key: values[rows] for key, values in getattr(self, name).items()}
        return replace(self, **fields)

    @cached_property
    def sample_time(self) -> float:
        """Median step between samples of one recording, s; 1 for a single sample."""
        steps = np.diff(self.time)[np.diff(self.recording) == 0]
        return float(np.median(steps)) if steps.size else 1.0

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """Stretches without a gap: within one recording, steps under 1.5 sample times."""
        is_break = np.diff(self.time) > 1.5 * self.sample_time
        is_break |= np.diff(self.recording) != 0
        edges = [0, *(np.flatnonzero(is_break) + 1).tolist(), self.time.size]
        return tuple(slice(a, b) for a, b in pairwise(edges) if b > a)

    def thinned(self, rate: float) -> ForceRecord:
        """Every so-manieth sample, at least ``rate`` [Hz] of them; a smoothed force has no more.

        Samples are picked, not averaged, so that their standard deviation stays what it is.
        """
        stride = max(int(1.0 / (rate * self.sample_time) + 1e-9), 1)
        rows = [np.arange(part.start, part.stop, stride) for part in self.segments]
        return self.subset(np.concatenate(rows))

    def blocks(self, length: float) -> IntArray:
        """Number of the block that each sample belongs to, rising, about ``length`` [s] each.

        A stretch is cut into equal blocks, one at least.
        """
        number = np.empty(self.time.size, dtype=np.int64)
        first = 0
        for part in self.segments:
            samples = part.stop - part.start
            count = max(round(samples * self.sample_time / length), 1)
            number[part] = first + np.arange(samples) * count // samples
            first += count
        return number

    def correlation_time(self, values: FloatArray, power: int = 1) -> float:
        """Time over which a series forgets itself, s: the integral of its autocorrelation.

        Up to where that first falls below a tenth; not below one sample time. With ``power`` 2, of
        the autocorrelation's square: what decides how much of one series another explains by chance
        when both remember alike (Bartlett 1946).
        """
        longest = max((part.stop - part.start for part in self.segments), default=1)
        size = 1 << (2 * longest - 1).bit_length()
        spectrum = np.zeros(size // 2 + 1)
        for part in self.segments:
            spectrum += np.abs(np.fft.rfft(values[part] - values.mean(), size)) ** 2
        correlation = np.fft.irfft(spectrum)[:longest]
        if correlation[0] <= 0:
            return self.sample_time
        correlation = correlation / correlation[0]
        below = np.flatnonzero(correlation < 0.1)
        end = int(below[0]) if below.size else longest
        return float(self.sample_time * max(2 * np.sum(correlation[:end] ** power) - 1, 1.0))

    def signal_power(self, mean_square: float) -> float:
        """A mean square of the force less that of its noise; a fifth of it is always left."""
        noise = float(np.mean(self.sd**2))
        return mean_square - min(noise, MOST_NOISE * mean_square)


Columns = list[FloatArray]

#: Hz, of the regression.
_RATE = 25.0
#: Largest share that is put down to chance.
_MOST_CHANCE = 0.4
#: Relative ridge that keeps columns that say the same from an exact tie.
_RIDGE = 1e-7

#: A column that varies by less than this share of its size is constant.
_CONSTANT = 1e-9

#: Parts of a rate's or a speed's spread within which its sign turns.
_SHARP = (0.03, 0.15)
#: rad, of travel after a reversal.
_WIDTHS = (0.05, 0.1, 0.2, 0.35)
#: s, of delays and lags.
_DELAYS = (0.03, 0.1, 0.3)
#: s, standard deviations of kernels as a smoother has them.
_SMOOTHERS = (0.04, 0.1, 0.2)
#: s, of the warming of a drive; zero sags at once.
_WARMING = (0.0, 3.0, 15.0, 60.0, 300.0)
#: Parts of the largest command.
_DEAD = (0.01, 0.025, 0.05, 0.1)
#: Heights of the cushion over the arm, and sin of the pitch at the table.
_CUSHIONS, _TABLE = (0.12, 0.3, 0.8), -0.6
#: s, of a rotor whose speed is not known, and of one between a command and a thrust.
_ROTORS = (0.2, 0.8)


@dataclass(frozen=True)
class LawInputs:
    """The motion about a force as laws take it: its own axis, its rotor, the other ones."""

    record: ForceRecord

    @property
    def axis(self) -> str:
        return self.record.axis

    @property
    def rotor(self) -> str:
        """The rotor that moves the axis; the command, where none does."""
        return self.record.drive

    @property
    def other_rotor(self) -> str:
        return self.record.parts.other_drive(self.rotor)

    @property
    def other_axis(self) -> str:
        return self.record.parts.other_axis(self.axis)

    @property
    def one(self) -> FloatArray:
        return np.ones_like(self.record.force)

    def angle(self, axis: str) -> Columns:
        """The angle of an axis, or nothing."""
        return [self.record.angles[axis]] if axis in self.record.angles else []

    def rate(self, axis: str) -> Columns:
        """The rate of an axis, from its angle if need be, or nothing."""
        if axis in self.record.rates:
            return [self.record.rates[axis]]
        return [self.slope(angle) for angle in self.angle(axis)]

    def command(self, rotor: str) -> Columns:
        return [self.record.commands[rotor]] if rotor in self.record.commands else []

    def speeds(self, rotor: str) -> Columns:
        """The speed of a rotor; in its stead the command after lags that rotors have."""
        if rotor in self.record.speeds:
            return [self.record.speeds[rotor]]
        if rotor not in self.record.parts.rotors:
            return []
        return [self.lagged(u, time) for u in self.command(rotor) for time in _ROTORS]

    @property
    def cosine(self) -> FloatArray:
        tilt = self.angle(self.record.parts.tilting)
        return np.cos(tilt[0]) if tilt else self.one

    @property
    def sine(self) -> FloatArray:
        tilt = self.angle(self.record.parts.tilting)
        return np.sin(tilt[0]) if tilt else 0 * self.one

    @property
    def lever(self) -> FloatArray:
        """Of a thrust on the axis: that of an axis which another one tilts shrinks with it."""
        tilting = self.record.parts.tilting
        return self.cosine if self.axis != tilting and self.angle(tilting) else self.one

    def slope(self, values: FloatArray) -> FloatArray:
        """Derivative by time, within stretches."""
        result = np.zeros_like(values)
        for part in self.record.segments:
            if part.stop - part.start > 1:
                result[part] = np.gradient(values[part], self.record.sample_time)
        return result

    def lagged(self, values: FloatArray, time: float) -> FloatArray:
        """Values after a first-order lag, each stretch from its first value."""
        from scipy.linalg import solve_banded  # scipy.signal takes a second to import

        keep = float(np.exp(-self.record.sample_time / time))
        result = np.empty_like(values)
        for part in self.record.segments:
            right_side = (1 - keep) * values[part]
            right_side[0] = values[part.start]
            bands = np.vstack([np.ones_like(right_side), np.full_like(right_side, -keep)])
            result[part] = solve_banded((1, 0), bands, right_side)
        return result

    def smoothed(self, values: FloatArray, sd: float) -> FloatArray:
        """Values under a Gaussian kernel, within stretches."""
        reach = int(np.ceil(3 * sd / self.record.sample_time))
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * self.record.sample_time / sd) ** 2)
        result = np.empty_like(values)
        for part in self.record.segments:
            padded_values = np.pad(values[part], reach, mode="edge")
            result[part] = np.convolve(padded_values, kernel / kernel.sum(), mode="valid")
        return result


def _sign(values: FloatArray) -> Columns:
    spread = float(np.sqrt(np.mean(values**2))) + 1e-12
    return [np.tanh(values / (width * spread)) for width in _SHARP]


def _sign_of_rate(at: LawInputs) -> Columns:
    return [column for rate in at.rate(at.axis) for column in _sign(rate)]


def _rest(at: LawInputs) -> Columns:
    """At rest friction holds against whatever drives: thrust, cable, weight."""
    columns: Columns = []
    for rate in at.rate(at.axis):
        resting = np.exp(-((rate / (_SHARP[1] * float(rate.std()) + 1e-12)) ** 2))
        drives = [speed * np.abs(speed) for speed in at.speeds(at.rotor)]
        drives += [] if at.rotor in at.record.parts.rotors else at.command(at.rotor)
        tilts = at.axis == at.record.parts.tilting
        drives += [at.sine, at.cosine] if tilts else at.angle(at.axis)
        columns += [resting * (drive - drive.mean()) for drive in drives]
    return columns


def _quadratic(at: LawInputs) -> Columns:
    return [rate * np.abs(rate) for rate in at.rate(at.axis)]


def _cubic_stiffness(at: LawInputs) -> Columns:
    return [angle**3 for angle in at.angle(at.axis)]


def _hysteresis(at: LawInputs) -> Columns:
    return [column for angle in at.angle(at.axis) for column in hysteresis(at.record, angle)]


def hysteresis(record: ForceRecord, angle: FloatArray) -> Columns:
    """Memory of the travel, Bouc–Wen with β = 1/2 and n = 1, for some widths."""
    width = np.array(_WIDTHS)
    travel = np.diff(angle, prepend=angle[0])
    for part in record.segments:
        travel[part.start] = 0.0
    # Loading bends towards ±1, unloading is straight: exact over a step of one direction. Plain
    # numbers, since each step needs the one before it.
    loading = (1 - np.exp(-np.abs(travel) / width[:, None])).tolist()
    unloading = (travel / width[:, None]).tolist()
    sign = np.sign(travel).tolist()
    columns: Columns = []
    for bends, steps in zip(loading, unloading, strict=True):
        now, memory = 0.0, []
        for towards, bend, step in zip(sign, bends, steps, strict=True):
            now += (towards - now) * bend if now * towards >= 0 else step
            memory.append(now)
        columns.append(np.array(memory))
    return columns


def _imbalance(at: LawInputs) -> Columns:
    return [at.cosine, at.sine] if at.angle(at.record.parts.tilting) else []


def _reaction(at: LawInputs) -> Columns:
    """Drag and acceleration of the other axis's rotor."""
    columns: Columns = []
    for speed in at.speeds(at.other_rotor):
        columns += [at.lever * speed * np.abs(speed), at.lever * at.slope(speed)]
    return columns


def _gyroscopic(at: LawInputs) -> Columns:
    return [
        speed * rate * lever
        for speed in at.speeds(at.record.parts.drive_of(at.record.parts.tilting))
        for rate in at.rate(at.other_axis)
        for lever in (at.sine, at.cosine)
    ]


def _inflow(at: LawInputs) -> Columns:
    return [np.abs(speed) * rate for speed in at.speeds(at.rotor) for rate in at.rate(at.axis)]


def _thrust(at: LawInputs) -> Columns:
    lever = at.lever if at.record.kind == "moment" else at.one
    return [lever * speed * np.abs(speed) for speed in at.speeds(at.rotor)]


def _reverse_thrust(at: LawInputs) -> Columns:
    return [
        thrust * (speed < 0) for speed, thrust in zip(at.speeds(at.rotor), _thrust(at), strict=True)
    ]


def _near_table(at: LawInputs) -> Columns:
    if at.axis != at.record.parts.tilting:
        return []
    return [
        np.maximum(thrust, 0) * np.exp(-(at.sine - _TABLE) / cushion)
        for thrust in _thrust(at)
        for cushion in _CUSHIONS
    ]


def _rotor_friction(at: LawInputs) -> Columns:
    return _downstream(at, [column for speed in at.speeds(at.rotor) for column in _sign(speed)])


def _dead_zone(at: LawInputs) -> Columns:
    columns: Columns = []
    for u in at.command(at.rotor):
        widths = [part * float(np.abs(u).max()) for part in _DEAD]
        columns += [np.clip(u, -width, width) for width in widths]
    return _downstream(at, columns)


def _input_change(at: LawInputs) -> Columns:
    """As a lag leaves it, and as a smoother that looks both ways shows it: on both sides."""
    columns = [u - at.lagged(u, time) for u in at.command(at.rotor) for time in _DELAYS]
    columns += [at.smoothed(at.slope(u), sd) for u in at.command(at.rotor) for sd in _SMOOTHERS]
    return _downstream(at, columns)


def _derating(at: LawInputs) -> Columns:
    columns: Columns = []
    for u in at.command(at.rotor):
        load = (u / (float(np.abs(u).max()) + 1e-12)) ** 2
        columns += [u * (at.lagged(load, time) if time else load) for time in _WARMING]
        columns.append(u * (at.record.time - at.record.time.mean()))
    return _downstream(at, columns)


def _downstream(at: LawInputs, columns: Columns) -> Columns:
    """What volts before the motor are in the thrust: after the rotor's lag, times its speed."""
    if at.record.kind in ("actuator", "motor") or at.rotor not in at.record.parts.rotors:
        return columns
    speed = at.speeds(at.rotor)
    if not speed:
        return []
    return [np.abs(speed[-1]) * at.lagged(column, time) for column in columns for time in _ROTORS]


def _spin_up(at: LawInputs) -> Columns:
    return [at.lagged(at.slope(speed), 0.05) for speed in at.speeds(at.rotor)]


#: In words, and what a regression takes, by name.
LAWS: dict[str, tuple[str, Callable[[LawInputs], Columns]]] = {
    "sign_of_rate": ("the sign of the {rate} (dry friction)", _sign_of_rate),
    "rest": ("what holds the axis at rest (stiction)", _rest),
    "quadratic_damping": ("the {rate} squared", _quadratic),
    "stiffness": ("the {angle} (a spring)", lambda at: at.angle(at.axis)),
    "cubic_stiffness": ("the {angle} cubed (a hardening spring)", _cubic_stiffness),
    "hysteresis": ("the travel since the last reversal (hysteresis)", _hysteresis),
    "imbalance": ("cosine and sine of the {tilting} (a mass out of balance)", _imbalance),
    "reaction": ("drag and acceleration of the other rotor", _reaction),
    "gyroscopic": ("rotor speed times the rate of the other axis", _gyroscopic),
    "inflow": ("rotor speed times the {rate} (inflow)", _inflow),
    "thrust": ("the thrust itself", _thrust),
    "reverse_thrust": ("the thrust in reverse", _reverse_thrust),
    "near_table": ("the thrust near the table", _near_table),
    "rotor_friction": ("the direction in which the rotor turns", _rotor_friction),
    "dead_zone": ("the command near zero (a dead zone)", _dead_zone),
    "input_change": ("changes of the command (a delay or lag)", _input_change),
    "derating": ("the command times its load or time (derating)", _derating),
    "spin_up": ("the rotor's acceleration", _spin_up),
}


def explained_shares(record: ForceRecord) -> dict[str, float]:
    """Share of the force's variation about its mean that each law explains, 0 to 1, by name."""
    record = record.thinned(_RATE)
    at = LawInputs(record)
    of_law: dict[str, list[int]] = {}
    columns: Columns = []
    for name, (_, law) in LAWS.items():
        own = [column for column in law(at) if np.any(column)]
        of_law[name] = list(range(len(columns), len(columns) + len(own)))
        columns += own
    force = record.force - record.force.mean()
    energy = float(force @ force)
    if energy <= 0 or not columns:
        return dict.fromkeys(LAWS, 0.0)
    raw = np.column_stack(columns)
    phi = raw - raw.mean(axis=0)
    size = np.linalg.norm(phi, axis=0)
    # what is constant up to rounding must not come back as something; each column has a unit of
    # its own, so that only its own size says what rounding is
    varies = size > _CONSTANT * np.linalg.norm(raw, axis=0)
    unit = np.where(varies, phi / np.maximum(size, 1e-300), 0.0)
    gram, product = unit.T @ unit, unit.T @ force
    noise = min(float(np.sum(record.sd**2)) / energy, MOST_NOISE)
    memory = record.correlation_time(force, power=2)
    chance = min(memory / (force.size * record.sample_time), 0.2)

    def share(rows: list[int]) -> float:
        if not rows:
            return 0.0
        inner = gram[np.ix_(rows, rows)] + _RIDGE * np.eye(len(rows))
        explained_energy = product[rows] @ np.linalg.solve(inner, product[rows])
        by_chance = min(chance * len(rows), _MOST_CHANCE)
        beyond = (explained_energy / energy - by_chance) / (1 - by_chance)
        return float(np.clip(beyond / (1 - noise), 0.0, 1.0))

    return {name: share(rows) for name, rows in of_law.items()}
