"""How late a twin rotor's channels are recorded: commands, rotor speeds, angles.

A rotor's acceleration follows its command and speed at once, and an angle's acceleration follows
the thrust at once; lags that physics knows lie between command and speed, and between force and
angle, not here. So the delay is the shift at which a regression of the measured acceleration on
the shifted cause, and on what else acts, leaves least over. Cross-correlation of the raw channels
would find the lags of the physics instead.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from trms_cli.core.arrays import hold_last
from trms_cli.core.errors import RecordingError
from trms_cli.recordings.recording import Recording, on_grid

#: s, the range of delays that is looked at.
_EARLIEST, _LATEST = -0.1, 0.4
#: s, the windows over which speeds and angles are differentiated.
_ROTOR_WINDOW, _ANGLE_WINDOW = 0.06, 0.4
#: Blocks for the spread of the estimate: each is left out once (jackknife).
_BLOCKS = 10
_LEAST_OF_DELAYS = 200
#: Of the variance of the acceleration that the cause must explain for a delay to be told.
_LEAST_EXPLAINED = 0.05
#: The same for an angle's delay to be worth a word.
_MOST_EXPLAINED = 0.6
_PAIRS = (("u_v", "omega_v"), ("u_h", "omega_h"), ("omega_v", "alpha_v"), ("omega_h", "alpha_h"))


@dataclass(frozen=True)
class RecordedDelay:
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


def estimate_delays(recording: Recording, jitter: float = 0.2) -> list[RecordedDelay]:
    """Delays from each command to its rotor's speed, and from each speed to its axis' angle.

    Pairs whose cause explains too little are left out, as are unevenly sampled recordings.
    """
    try:
        grid = on_grid(recording, jitter)
    except RecordingError:
        return []
    pairs = [p for p in _PAIRS if p[0] in grid.channels and p[1] in grid.channels]
    delays = (_delay(grid.channels, grid.sample_time, cause, effect) for cause, effect in pairs)
    return [delay for delay in delays if delay is not None]


def _delay(
    channels: Mapping[str, np.ndarray], step: float, cause: str, effect: str
) -> RecordedDelay | None:
    from scipy.signal import savgol_filter

    of_rotor = cause.startswith("u_")
    width = (_ROTOR_WINDOW if of_rotor else _ANGLE_WINDOW) / step
    window = max(5 if of_rotor else 7, 2 * int(width / 2) + 1)
    if len(channels[effect]) < max(_LEAST_OF_DELAYS, 4 * window):
        return None

    def smooth(values: np.ndarray, derivative: int = 0) -> np.ndarray:
        order = 2 if of_rotor else 3
        return np.asarray(
            savgol_filter(values, window, order, deriv=derivative, delta=step, mode="constant")
        )

    driver, driven = channels[cause], channels[effect]
    if of_rotor:
        driver = hold_last(driver)
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
    if len(rows) < _LEAST_OF_DELAYS:
        return None
    good = np.isfinite(target[rows]) & np.isfinite(fixed[rows]).all(axis=1)
    for shift in shifts:
        good &= np.isfinite(moving[rows - shift]).all(axis=1)
    rows = rows[good]
    if len(rows) < _LEAST_OF_DELAYS:
        return None
    without, residuals = _left_over(target, fixed, moving, rows, shifts)
    best = _lowest(residuals.sum(axis=0), shifts)
    variance = float(np.sum((target[rows] - target[rows].mean()) ** 2))
    explained = (without - float(residuals.sum(axis=0).min())) / max(variance, 1e-300)
    if explained < _LEAST_EXPLAINED or best is None:
        return None
    partial = [_lowest(residuals.sum(axis=0) - block, shifts) for block in residuals]
    estimates = np.array([p for p in partial if p is not None])
    if len(estimates) < len(partial):
        return None
    deviation = float(np.sqrt((len(estimates) - 1) * np.var(estimates)))
    # A held command acts on average half a sample after its row.
    lead = 0.5 if of_rotor else 0.0
    return RecordedDelay(
        cause, effect, (best - lead) * step, max(deviation, 0.05) * step, explained, step
    )


def _left_over(
    target: np.ndarray, fixed: np.ndarray, moving: np.ndarray, rows: np.ndarray, shifts: np.ndarray
) -> tuple[float, np.ndarray]:
    """Squares that remain: without the cause, and per block and shift with it."""
    scale = np.maximum(np.abs(fixed[rows]).max(axis=0), 1e-300)
    base, _ = np.linalg.qr(fixed[rows] / scale)
    y = target[rows] - base @ (base.T @ target[rows])
    residuals = np.empty((_BLOCKS, len(shifts)))
    for i, shift in enumerate(shifts):
        x = moving[rows - shift]
        x = x / np.maximum(np.abs(x).max(axis=0), 1e-300)
        x = x - base @ (base.T @ x)
        error = y - x @ np.linalg.lstsq(x, y, rcond=1e-9)[0]
        residuals[:, i] = [float(block @ block) for block in np.array_split(error, _BLOCKS)]
    return float(y @ y), residuals


def _lowest(residuals: np.ndarray, shifts: np.ndarray) -> float | None:
    """The shift of the lowest remainder, by a parabola; None at the edge of the range."""
    i = int(np.argmin(residuals))
    if i in (0, len(residuals) - 1):
        return None
    a, b, c = residuals[i - 1 : i + 2]
    return float(shifts[i] + 0.5 * (a - c) / max(a - 2 * b + c, 1e-300))
