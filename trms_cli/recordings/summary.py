"""What a recording is like, before anything is done with it: figures, and sentences for people.

Outliers are samples of a measured channel that neither neighbour leads to. A Hampel filter (running
median, and a robust measure of what is usual around; Pearson 2002) finds candidates. A rotor that
turns round within one sample has such a peak too, but both slopes lead up to it, so a candidate
counts only if it lies off the straight lines of both sides.

Whether the loop was open or closed shows where commands answer to what only the sensors know. In
open loop a command is drawn before; no noise of a sensor can be in it. A controller passes
the noise of its measurements on. So the commands are predicted from their own past and the
references, the measurements from the past of all, and the command's surprise is compared with the
measurements' surprises of the same and the earlier samples, which no command made. (Granger
causality with feedback at lag zero; Ljung, System Identification, 2nd ed., section 13.4.)

A rotor's acceleration follows its command and speed at once, and an angle's acceleration follows
the thrust at once; lags that physics knows lie between command and speed, and between force and
angle, not here. So the delay is the shift at which a regression of the measured acceleration on
the shifted cause, and on what else acts, leaves least over. Cross-correlation of the raw channels
would find the lags of the physics instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.recording import Recording, hold_last, on_grid, quantum, runs

#: Half width of the running median, samples; more than half of it wrong is no outlier.
_HALF_WIDTH = 3
#: Samples over which the usual deviation from the median is taken.
_SCALE_WIDTH = 61
#: Deviations of usual size that make an outlier: 6 keep white noise of hours below one.
THRESHOLD = 6.0
#: The share of samples that is usual, and the quantile of it over a normal's deviation. Higher
#: than a median, so that a rotor that turns round at every tenth sample sets the scale.
_USUAL_PERCENT, _QUANTILE_TO_SD = 90, 1 / 1.645


def outliers(values: np.ndarray, threshold: float = THRESHOLD) -> np.ndarray:
    """Which samples are outliers, (n,) bool array.

    Runs of up to three samples. Channels of fewer than 15 samples have none.

    ``values``, (n,) array: evenly spaced but for what is missing (NaN). ``threshold``: in standard
    deviations of what is usual around the sample.
    """
    from scipy.ndimage import median_filter, percentile_filter

    is_outlier = np.zeros(len(values), dtype=bool)
    there = np.flatnonzero(np.isfinite(values))
    y = values[there]
    if len(y) < 2 * (2 * _HALF_WIDTH + 1) + 1:
        return is_outlier
    off = np.abs(y - median_filter(y, 2 * _HALF_WIDTH + 1, mode="reflect"))
    width = min(_SCALE_WIDTH, len(y))
    usual = percentile_filter(off, _USUAL_PERCENT, width, mode="reflect")
    floor = max(
        # Of the samples that are surely none: an outlier need not lie on the sensor's grid.
        (quantum(y[off <= np.percentile(off, 95)]) or 0.0) / _QUANTILE_TO_SD,
        float(np.percentile(off, _USUAL_PERCENT)),
        1e-9 * float(np.ptp(y)),
    )
    limit = threshold * _QUANTILE_TO_SD * np.maximum(usual, floor)
    work = y.copy()
    candidates = set(np.flatnonzero(off > limit).tolist())
    # The farthest first: the median beside a spike is off as well, until the spike is mended.
    for k in sorted(candidates, key=lambda k: -off[k]):
        around = work[max(k - _HALF_WIDTH, 0) : k + _HALF_WIDTH + 1]
        if abs(work[k] - float(np.median(around))) <= limit[k]:
            continue
        run = _run_around(work, k, candidates, limit[k])
        if run is not None:
            is_outlier[there[run.start : run.stop]] = True
            sides = [i for i in (run.start - 1, run.stop) if 0 <= i < len(y)]
            work[run.start : run.stop] = np.interp(run, sides, work[sides])
    return is_outlier


def _run_around(y: np.ndarray, k: int, candidates: set[int], limit: float) -> range | None:
    """The shortest run of candidates around one that stands apart from both sides."""
    for count in range(1, _HALF_WIDTH + 1):
        for first in range(k - count + 1, k + 1):
            run = range(first, first + count)
            if candidates.issuperset(run) and _stands_apart(y, run, limit):
                return run
    return None


def _stands_apart(y: np.ndarray, run: range, limit: float) -> bool:
    """Whether every sample of a run is off the straight lines of both sides."""
    lines = [_beyond(y, run.start, len(run), side) for side in (-1, 1)]
    side_lines = [line for line in lines if line is not None]
    return bool(side_lines) and all(abs(y[k] - line(k)) > limit for k in run for line in side_lines)


def _beyond(y: np.ndarray, first: int, count: int, direction: int) -> Callable[[int], float] | None:
    """The straight line through the two samples before or after a run; None beyond an end."""
    near, far = (first - 1, first - 2) if direction < 0 else (first + count, first + count + 1)
    if min(near, far) < 0 or max(near, far) >= len(y):
        return None
    slope = (y[far] - y[near]) / (far - near)
    return lambda k: float(y[near] + slope * (k - near))


def find_outliers(recording: Recording) -> dict[str, np.ndarray]:
    """Outliers of every measured channel that has any: masks of shape (n,)."""
    measured = (*recording.names("output"), *recording.names("current"))
    masks = {name: outliers(recording.channels[name]) for name in measured}
    return {name: mask for name, mask in masks.items() if mask.any()}


def describe_outliers(recording: Recording, masks: dict[str, np.ndarray]) -> list[str]:
    """A sentence a channel."""
    sentences = []
    for name, mask in masks.items():
        times = ", ".join(f"{t:.6g}" for t in recording.time[mask][:3])
        count = int(mask.sum())
        more = ", …" if count > 3 else ""
        sentences.append(
            f"{name}: {count} outlier{'' if count == 1 else 's'} of {len(mask)} samples "
            f"(at {times}{more} s)"
        )
    return sentences


#: Samples of the past that a prediction uses.
_LAGS = 6
#: Samples of surprises that a command may answer to.
_ANSWERS = 4
#: Share of a command's surprise that measurements explain, above which the loop was closed.
_CLOSED_SHARE = 0.10
#: A share below this is what chance and a model that is not quite linear leave.
_OPEN_SHARE = 0.03
#: Probability below which an answer is no chance.
_CHANCE = 1e-4
#: A command that changes at fewer samples than this is held between its levels.
_LEVELS_SHARE = 0.7
_LEAST_SAMPLES = 300
_OPEN_WORDS, _CLOSED_WORDS = ("open", "open loop"), ("closed", "closed loop")


@dataclass(frozen=True)
class LoopState:
    """What is known of the loop."""

    state: str  #: "open", "closed" or "unknown"
    declared: bool  #: Whether the recording says so itself
    #: By input: the share of its surprise that measurements explain; empty if not estimated
    answered: dict[str, float]

    def sentence(self) -> str:
        """For people."""
        shares = ", ".join(f"{name} {share:.0%}" for name, share in self.answered.items())
        evidence = (
            f" (of what is new in a command, measurements explain: {shares})" if shares else ""
        )
        if self.declared:
            return f"loop: {self.state}, as the recording says{evidence}"
        if self.state == "unknown":
            return f"loop: open or closed cannot be told{evidence}; write `# loop: open` or closed"
        return f"loop: {self.state}, estimated{evidence}"


def find_loop(recording: Recording, jitter: float = 0.2) -> LoopState:
    """Open or closed; what the recording says of itself wins over the estimate."""
    said = recording.metadata.get("loop", "").strip().lower()
    answered = _answered(recording, jitter)
    if said in _OPEN_WORDS or said in _CLOSED_WORDS:
        return LoopState("open" if said in _OPEN_WORDS else "closed", True, answered)
    if not answered:
        return LoopState("unknown", False, answered)
    largest = max(answered.values())
    if largest >= _CLOSED_SHARE:
        return LoopState("closed", False, answered)
    return LoopState("open" if largest <= _OPEN_SHARE else "unknown", False, answered)


def _answered(recording: Recording, jitter: float) -> dict[str, float]:
    """Per input, adjusted for the number of regressors; empty where nothing can be estimated."""
    try:
        grid = on_grid(recording, jitter)
    except RecordingError:
        return {}
    inputs = [n for n in recording.names("input") if _moves(grid.channels[n])]
    outputs = [n for n in recording.names("output") if _moves(grid.channels[n])]
    references = [n for n in recording.names("reference") if _moves(grid.channels[n])]
    if not inputs or not outputs:
        return {}
    u = np.column_stack([grid.channels[n] for n in (*inputs, *references)])
    y = np.column_stack([grid.channels[n] for n in outputs])
    of_inputs = _surprise(u[:, : len(inputs)], [u], u[:, len(inputs) :])
    of_outputs = _surprise(y, [u, y])
    answers = _past(of_outputs, _ANSWERS, latest=0)
    shares = {}
    for i, name in enumerate(inputs):
        target = of_inputs[:, i]
        changed = np.append(False, np.diff(u[:, i]) != 0)
        rows = np.isfinite(target) & np.isfinite(answers).all(axis=1)
        if not rows.any():
            return {}
        if np.mean(changed[rows]) < _LEVELS_SHARE:
            # A signal of levels: it answers, if at all, when it changes.
            rows &= changed
        shares[name] = _explained(target[rows], answers[rows])
    return shares


def _past(table: np.ndarray, lags: int, latest: int) -> np.ndarray:
    """The rows of ``latest``, latest + 1, … samples before, side by side; NaN before the first."""
    columns = []
    for lag in range(latest, latest + lags):
        block = np.full(table.shape, np.nan)
        block[lag:] = table[: max(len(table) - lag, 0)]
        columns.append(block)
    return np.hstack(columns)


def _surprise(
    table: np.ndarray, past_of: list[np.ndarray], current_values: np.ndarray | None = None
) -> np.ndarray:
    """What a linear prediction from the past, and from what is known now, does not tell."""
    parts = [np.ones((len(table), 1)), *(_past(part, _LAGS, latest=1) for part in past_of)]
    x = np.hstack(parts if current_values is None else [*parts, current_values])
    good = np.isfinite(x).all(axis=1) & np.isfinite(table).all(axis=1)
    surprise = np.full(table.shape, np.nan)
    if np.count_nonzero(good) < max(_LEAST_SAMPLES, 4 * x.shape[1]):
        return surprise
    scale = np.maximum(np.abs(x[good]).max(axis=0), 1e-300)
    base, values, _ = np.linalg.svd(x[good] / scale, full_matrices=False)
    base = base[:, values > 1e-9 * values[0]]
    surprise[good] = table[good] - base @ (base.T @ table[good])
    return surprise


def _explained(target: np.ndarray, regressors: np.ndarray) -> float:
    """Adjusted share of the variance, between 0 and 1; 0 where it may be chance.

    A command that jumps with its reference has surprises that nothing explains: those beyond
    four usual ones are left out where they are few.
    """
    from scipy.special import fdtrc

    count, width = len(target), regressors.shape[1]
    if count < width + 10:
        return 0.0
    usual = 1.4826 * float(np.median(np.abs(target)))
    rows = np.abs(target) <= 4 * usual
    if usual <= 0 or np.mean(rows) < 0.8:
        rows[:] = True
    y = target[rows] - target[rows].mean()
    x = regressors[rows] - regressors[rows].mean(axis=0)
    scale = np.maximum(np.abs(x).max(axis=0), 1e-300)
    error = y - (x / scale) @ np.linalg.lstsq(x / scale, y, rcond=1e-9)[0]
    free = len(y) - width - 1
    residual, whole = float(error @ error), float(y @ y)
    if free < 5 or whole <= 0:
        return 0.0
    chance = fdtrc(width, free, max(whole - residual, 0.0) / width / max(residual / free, 1e-300))
    share = 1 - (residual / free) / (whole / (len(y) - 1))
    return float(np.clip(share, 0.0, 1.0)) if chance < _CHANCE else 0.0


def _moves(values: np.ndarray) -> bool:
    there = values[np.isfinite(values)]
    return len(there) > 1 and float(np.ptp(there)) > 0


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
    delays = (_delay(grid.channels, grid.sample_time, cause, effect) for cause, effect in pairs)
    return [delay for delay in delays if delay is not None]


def _delay(
    channels: Mapping[str, np.ndarray], step: float, cause: str, effect: str
) -> Delay | None:
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
    return Delay(cause, effect, (best - lead) * step, max(deviation, 0.05) * step, explained, step)


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


#: A channel with fewer levels is a switched signal: being at its largest is no saturation.
_LEAST_LEVELS = 12
#: A signal that stays as it was at more samples than this is held between levels.
_HELD_SHARE = 0.5
#: A command at its extreme value for more of the time than this is worth a sentence.
_SATURATED_SHARE = 0.02
#: s for which an angle must keep still to be at rest.
_REST_TIME = 0.5
#: Share of the largest size beyond which a change of sign counts.
_CROSSING_SHARE = 0.05
_SMOOTHING_TIME = 0.2


@dataclass(frozen=True)
class ChannelSummary:
    """Figures of a channel."""

    minimum: float | None  #: In the channel's unit
    maximum: float | None  #: None for a channel without a value
    quantum: float | None  #: Distance between levels, where they lie on a grid
    missing: int  #: Samples without a value among the rows
    outliers: int  #: Samples that neither neighbour leads to
    constant: bool  #: Whether it never changes
    #: Inputs: share of the time at the largest or smallest value taken, when many are taken
    extreme_share: float | None = None
    #: Angles: share of the time at which it keeps still for half a second around
    rest_share: float | None = None
    #: Angles: how often the rate changes its sign. Rotor speeds: how often the rotor reverses.
    turns: int | None = None


@dataclass(frozen=True)
class RecordingSummary:
    """What was found in a recording."""

    channels: dict[str, ChannelSummary]
    delays: list[Delay]
    loop: LoopState
    sentences: list[str]  #: For people: faults first, then what is worth knowing


def summarise(recording: Recording, jitter: float = 0.2) -> RecordingSummary:
    """Look at a recording; nothing is changed.

    ``recording``: as read, with its gaps. ``jitter``: how uneven the sampling may be for delays and
    the loop to be estimated, as a share of a sample.
    """
    masks = find_outliers(recording)
    channels = {name: _channel(recording, name, masks) for name in recording.channels}
    delays = estimate_delays(recording, jitter)
    loop = find_loop(recording, jitter)
    sentences = [*remarks_on(recording, masks)]
    sentences += [delay.sentence() for delay in delays if delay.clear]
    sentences.append(loop.sentence())
    return RecordingSummary(channels, delays, loop, sentences)


def remarks_on(recording: Recording, masks: dict[str, np.ndarray] | None = None) -> list[str]:
    """Sentences on what may be wrong with the channels: cheap enough for every reading."""
    if masks is None:
        masks = find_outliers(recording)
    sentences = [
        f"{sentence}; --outliers mark, or data.outliers=mark, makes them missing"
        for sentence in describe_outliers(recording, masks)
    ]
    for name, values in recording.channels.items():
        there = values[np.isfinite(values)]
        if not len(there):
            sentences.append(f"{name}: not a single value")
        elif float(np.ptp(there)) == 0 and name not in recording.names("disturbance"):
            sentences.append(f"{name} is constant at {there[0]:.4g} {recording.units[name]}")
    for name in recording.names("input"):
        share = _extreme_share(recording.channels[name])
        if share is not None and share > _SATURATED_SHARE:
            largest = float(np.nanmax(np.abs(recording.channels[name])))
            unit = recording.units[name]
            size = f"{largest:.4g}" + (f" {unit}" if unit != "1" else "")
            sentences.append(f"{name} is at its largest, {size}, for {share:.0%} of the time")
    return sentences


def _channel(recording: Recording, name: str, masks: dict[str, np.ndarray]) -> ChannelSummary:
    values = recording.channels[name]
    there = values[np.isfinite(values)]
    mask = masks.get(name)
    inputs, outputs = recording.names("input"), recording.names("output")
    angle = name in outputs and recording.units[name] == "rad"
    rest, turns = None, None
    if name in outputs and len(there) > 10:
        rest, turns = _motion(there, recording.sample_time, angle)
    return ChannelSummary(
        float(there.min()) if len(there) else None,
        float(there.max()) if len(there) else None,
        quantum(values),
        recording.missing.get(name, 0),
        int(mask.sum()) if mask is not None else 0,
        len(there) > 0 and float(np.ptp(there)) == 0,
        _extreme_share(values) if name in inputs else None,
        rest,
        turns,
    )


def _extreme_share(values: np.ndarray) -> float | None:
    """Share of the time at the extreme values, by runs of at least two.

    None where that tells nothing: for few levels, and for a signal that is held at every level.
    """
    there = values[np.isfinite(values)]
    if len(np.unique(there)) < _LEAST_LEVELS:
        return None
    near = 1e-6 * float(np.ptp(there))
    at_limit = (there >= there.max() - near) | (there <= there.min() + near)
    elsewhere = ~at_limit[1:]
    if np.any(elsewhere) and np.mean(np.diff(there)[elsewhere] == 0) > _HELD_SHARE:
        return None
    return sum(count for _, count in runs(at_limit) if count > 1) / len(there)


def _motion(values: np.ndarray, step: float, angle: bool) -> tuple[float | None, int]:
    """Share of rest (angles) and number of reversals, of the samples that there are."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

    width = max(3, round(_SMOOTHING_TIME / step))
    smooth = uniform_filter1d(values, width)
    if not angle:
        return None, _sign_changes(smooth)
    third = np.diff(values, 3)
    noise = 1.4826 * float(np.median(np.abs(third))) / 20**0.5
    still = max(2.01 * (quantum(values) or 0.0), 6 * noise)
    around = max(3, round(_REST_TIME / step))
    spread = maximum_filter1d(values, around) - minimum_filter1d(values, around)
    return float(np.mean(spread <= still)), _sign_changes(np.diff(smooth))


def _sign_changes(values: np.ndarray) -> int:
    """Changes of sign between sizes above a share of the largest."""
    size = _CROSSING_SHARE * float(np.abs(values).max(initial=0.0))
    signs = np.sign(values[np.abs(values) > size])
    return int(np.count_nonzero(np.diff(signs)))
