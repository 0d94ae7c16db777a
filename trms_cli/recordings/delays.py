"""Delays between channels: estimated from what drives what, and taken out on request.

A rotor's acceleration follows its command and speed at once, and an angle's acceleration follows
the thrust at once; lags that physics knows lie between command and speed, and between force and
angle, not here. So the delay is the shift at which a regression of the measured acceleration on
the shifted cause, and on what else acts, leaves least over. Cross-correlation of the raw channels
would find the lags of the physics instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.core.plugins import nearest
from trms_cli.recordings.recording import Recording, on_grid

#: s, the range of delays that is looked at.
_EARLIEST, _LATEST = -0.1, 0.4
#: s, the windows over which speeds and angles are differentiated.
_ROTOR_WINDOW, _ANGLE_WINDOW = 0.06, 0.4
#: Blocks for the spread of the estimate: each is left out once (jackknife).
_BLOCKS = 10
_LEAST_SAMPLES = 200
#: Of the variance of the acceleration that the cause must explain for a delay to be told.
_LEAST_EXPLAINED = 0.05
#: The same for an angle's delay to be worth a word.
_MOST_EXPLAINED = 0.6
_PAIRS = (("u_v", "omega_v"), ("u_h", "omega_h"), ("omega_v", "alpha_v"), ("omega_h", "alpha_h"))


@dataclass(frozen=True)
class Delay:
    """How late one channel is recorded after what drives it."""

    cause: str  #: Channels
    effect: str  #: Channels
    #: Positive: the effect comes later than physics has it. A held command acts from its row on.
    seconds: float
    deviation: float  #: Standard deviation of the estimate, s
    explained: float  #: Share of the acceleration's variance that the cause explains at this delay
    sample_time: float  #: s, of the recording

    @property
    def clear(self) -> bool:
        """Whether it is worth a word: more than half a sample and three deviations.

        For an angle more is asked, since physics that is left out here (inflow, friction,
        coupling) shifts the estimate by a few samples.
        """
        if self.effect.startswith("omega_"):
            return abs(self.seconds) > max(0.5 * self.sample_time, 3 * self.deviation)
        large = abs(self.seconds) > max(2 * self.sample_time, 5 * self.deviation)
        return large and self.explained > _MOST_EXPLAINED

    def sentence(self) -> str:
        """For people."""
        relation = "after" if self.seconds >= 0 else "before"
        text = (
            f"{self.effect} follows {self.cause} {abs(self.seconds) * 1e3:.3g} ms {relation} what "
            f"physics has it (± {2 * self.deviation * 1e3:.2g} ms, "
            f"{abs(self.seconds) / self.sample_time:.2g} samples)"
        )
        if not self.effect.startswith("omega_"):
            text += ": a delay, or a lag of the thrust"
        return text


def estimate_delays(recording: Recording, jitter: float = 0.2) -> list[Delay]:
    """Delays from each command to its rotor's speed, and from each speed to its axis' angle.

    Pairs whose cause explains too little are left out, as are unevenly sampled recordings.
    """
    try:
        grid = on_grid(recording, jitter)
    except RecordingError:
        return []
    pairs = [p for p in _PAIRS if p[0] in grid.channels and p[1] in grid.channels]
    found = (_delay(grid.channels, grid.sample_time, cause, effect) for cause, effect in pairs)
    return [delay for delay in found if delay is not None]


def _delay(
    channels: Mapping[str, np.ndarray], step: float, cause: str, effect: str
) -> Delay | None:
    from scipy.signal import savgol_filter

    of_rotor = cause.startswith("u_")
    width = (_ROTOR_WINDOW if of_rotor else _ANGLE_WINDOW) / step
    window = max(5 if of_rotor else 7, 2 * int(width / 2) + 1)
    if len(channels[effect]) < max(_LEAST_SAMPLES, 4 * window):
        return None

    def smooth(values: np.ndarray, derivative: int = 0) -> np.ndarray:
        order = 2 if of_rotor else 3
        return np.asarray(
            savgol_filter(values, window, order, deriv=derivative, delta=step, mode="constant")
        )

    driver, driven = channels[cause], channels[effect]
    if of_rotor:
        driver = _held(driver)
        target = smooth(driven, 1)
        others = [driven, driven * np.abs(driven)]
        causes = [driver, driver * np.abs(driver)]
    else:
        target = smooth(driven, 2)
        others = [smooth(driven, 1), np.sin(driven), np.cos(driven)]
        causes = [driver * np.abs(driver)]
        other = "omega_h" if cause == "omega_v" else "omega_v"
        if other in channels and effect == "alpha_h":
            # Yaw feels the main rotor's acceleration and drag as well.
            others += [channels[other] * np.abs(channels[other]), smooth(channels[other], 1)]
    fixed = np.column_stack([np.ones(len(target)), *(smooth(o) for o in others)])
    moving = np.column_stack([smooth(c) for c in causes])
    shifts = np.arange(round(_EARLIEST / step), round(_LATEST / step) + 1)
    edge = int(np.abs(shifts).max()) + window
    rows = np.arange(edge, len(target) - edge)
    if len(rows) < _LEAST_SAMPLES:
        return None
    good = np.isfinite(target[rows]) & np.isfinite(fixed[rows]).all(axis=1)
    for shift in shifts:
        good &= np.isfinite(moving[rows - shift]).all(axis=1)
    rows = rows[good]
    if len(rows) < _LEAST_SAMPLES:
        return None
    without, left = _left_over(target, fixed, moving, rows, shifts)
    best = _lowest(left.sum(axis=0), shifts)
    variance = float(np.sum((target[rows] - target[rows].mean()) ** 2))
    explained = (without - float(left.sum(axis=0).min())) / max(variance, 1e-300)
    if explained < _LEAST_EXPLAINED or best is None:
        return None
    partial = [_lowest(left.sum(axis=0) - block, shifts) for block in left]
    told = np.array([p for p in partial if p is not None])
    if len(told) < len(partial):
        return None
    deviation = float(np.sqrt((len(told) - 1) * np.var(told)))
    # A held command acts on average half a sample after its row.
    lead = 0.5 if of_rotor else 0.0
    return Delay(cause, effect, (best - lead) * step, max(deviation, 0.05) * step, explained, step)


def _left_over(
    target: np.ndarray, fixed: np.ndarray, moving: np.ndarray, rows: np.ndarray, shifts: np.ndarray
) -> tuple[float, np.ndarray]:
    """Squares that remain: without the cause, and per block and shift with it."""
    scale = np.maximum(np.abs(fixed[rows]).max(axis=0), 1e-300)
    base, _ = np.linalg.qr(fixed[rows] / scale)
    y = target[rows] - base @ (base.T @ target[rows])
    left = np.empty((_BLOCKS, len(shifts)))
    for i, shift in enumerate(shifts):
        x = moving[rows - shift]
        x = x / np.maximum(np.abs(x).max(axis=0), 1e-300)
        x = x - base @ (base.T @ x)
        error = y - x @ np.linalg.lstsq(x, y, rcond=1e-9)[0]
        left[:, i] = [float(block @ block) for block in np.array_split(error, _BLOCKS)]
    return float(y @ y), left


def _lowest(left: np.ndarray, shifts: np.ndarray) -> float | None:
    """The shift of the lowest remainder, by a parabola; None at the edge of the range."""
    i = int(np.argmin(left))
    if i in (0, len(left) - 1):
        return None
    a, b, c = left[i - 1 : i + 2]
    return float(shifts[i] + 0.5 * (a - c) / max(a - 2 * b + c, 1e-300))


def _held(values: np.ndarray) -> np.ndarray:
    there = np.isfinite(values)
    latest = np.maximum.accumulate(np.where(there, np.arange(len(values)), 0))
    return values[latest]


def shift_channels(recording: Recording, delays: Mapping[str, float]) -> Recording:
    """Move channels earlier by the time by which they are recorded late.

    Whole samples are moved; a rest is interpolated by straight lines for measurements, and
    refused for commands and references, which are held. The ends for which a channel has no
    value any more are cut.

    ``delays``: s, by channel; negative for one that is recorded early (a command that acts later).
    Raises RecordingError for an unknown channel, a delay longer than the recording, or a part of a
    sample for a held channel.
    """
    step = recording.sample_time
    held = {*recording.names("input"), *recording.names("reference")}
    first, last = recording.time[0], recording.time[-1]
    channels = dict(recording.channels)
    for name, delay in delays.items():
        if name not in channels:
            raise RecordingError(
                f"the recording has no {name!r} to shift",
                where=f"delays.{name}",
                remedy=nearest(name, channels),
            )
        whole = round(delay / step)
        if name in held and abs(delay - whole * step) > 0.01 * step:
            raise RecordingError(
                f"{delay:g} s is {delay / step:.3g} samples, and {name} is held from row to row",
                where=f"delays.{name}",
                remedy=f"give whole samples of {step:g} s, or resample first to a step that fits",
            )
        first = max(first, recording.time[0] - delay)
        last = min(last, recording.time[-1] - delay)
        values, at = channels[name], recording.time - delay
        if name in held:
            row = np.searchsorted(at, recording.time + 0.01 * step, side="right") - 1
            channels[name] = values[np.clip(row, 0, len(values) - 1)]
        else:
            channels[name] = _interpolated(at, values, recording.time, step)
    keep = (recording.time >= first - 0.01 * step) & (recording.time <= last + 0.01 * step)
    if np.count_nonzero(keep) < 2:
        raise RecordingError(
            "the delays leave nothing of the recording",
            where="delays",
            remedy=f"it lasts {recording.duration_s:g} s",
        )
    words = ", ".join(f"{name} by {delay:g} s" for name, delay in delays.items())
    return replace(
        recording,
        time=recording.time[keep],
        channels={name: values[keep] for name, values in channels.items()},
        remarks=(*recording.remarks, f"moved earlier: {words}"),
    )


def _interpolated(at: np.ndarray, values: np.ndarray, time: np.ndarray, step: float) -> np.ndarray:
    """Straight lines between samples; missing where either neighbour is, or far away."""
    row = np.clip(np.searchsorted(at, time + 0.01 * step, side="right") - 1, 0, len(at) - 1)
    after = np.minimum(row + 1, len(at) - 1)
    width = np.maximum(at[after] - at[row], 1e-300)
    share = np.clip((time - at[row]) / width, 0.0, 1.0)
    share[np.abs(time - at[row]) <= 0.01 * step] = 0.0
    mixed = np.where(share == 0.0, values[row], (1 - share) * values[row] + share * values[after])
    return np.where((share > 0) & (width > 1.5 * step), np.nan, mixed)
