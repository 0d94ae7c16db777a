"""How the models of a diagnosis do on a recording of the same rig that nobody has seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.gap.blind.judging import HORIZON, Answer, OnFresh
from experiments.gap.blind.refit import dataset_of
from trms_cli.effects.model_file import load_model
from trms_cli.gap.free_runs import free_run_errors

#: Files of a diagnosis: the nominal model refitted, and with the cause.
CORRECTED, REFIT = "corrected_model.yaml", "refit_model.yaml"
#: A channel that errs by so much more is worse; a refit so near the floor leaves nothing to shrink.
_WORSE, _LEAST_GAP = 1.02, 1.05


def on_fresh(answer: Answer, folder: Path, recording: Path) -> OnFresh | None:
    """Free runs of both models over a whole recording.

    Parameters
    ----------
    answer : Answer
        Its floors are the units of the channels, as in its own shrink.
    folder : Path
        Of the diagnosis.
    recording : Path
        CSV.

    Returns
    -------
    OnFresh or None
        None where the diagnosis left no models.
    """
    files = [folder / name for name in (REFIT, CORRECTED)]
    if not all(file.is_file() for file in files):
        return None
    if not answer.named:
        return OnFresh(shrink=None, worse=())  # nothing was added
    refit, corrected = (_errors(file, recording) for file in files)
    worse = tuple(c for c in refit if corrected[c] > _WORSE * refit[c])
    told = [c for c in refit if c in answer.floors]
    if not told:
        return OnFresh(shrink=None, worse=worse)
    floors = np.array([answer.floors[c] for c in told])
    before, after = (
        float(np.sqrt(np.mean((np.array([e[c] for c in told]) / floors) ** 2)))
        for e in (refit, corrected)
    )
    shrink = 1 - (after - 1) / (before - 1) if before > _LEAST_GAP else None
    return OnFresh(shrink=shrink, worse=worse)


def _errors(file: Path, recording: Path) -> dict[str, float]:
    """Root mean square by channel at the horizon."""
    model = load_model(str(file))
    with recording.open(encoding="utf-8") as lines:
        columns = next(line for line in lines if not line.startswith("#")).count(",") + 1
    table = np.loadtxt(recording, delimiter=",", comments="#", skiprows=_header(recording))
    data = dataset_of(model, table[:, 0], table[:, 1:3], table[:, 3:columns], recording.name)
    horizon = float(HORIZON)
    errors = free_run_errors(model, [data], [(0, 0, len(data))], horizons=[horizon])
    return {channel: of[horizon].rms for channel, of in errors.items()}


def _header(recording: Path) -> int:
    """Lines up to and with the names of the columns."""
    with recording.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, start=1):
            if not line.startswith("#"):
                return number
    return 0
