"""Whether a recording is of an open or a closed loop.

It shows where commands answer to what only the sensors know. In
open loop a command is drawn before; no noise of a sensor can be in it. A controller passes
the noise of its measurements on. So the commands are predicted from their own past and the
references, the measurements from the past of all, and the command's surprise is compared with the
measurements' surprises of the same and the earlier samples, which no command made. (Granger
causality with feedback at lag zero; Ljung, System Identification, 2nd ed., section 13.4.)
"""

from dataclasses import dataclass

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.recording import Recording, on_grid

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
