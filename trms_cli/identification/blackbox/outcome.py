"""From trainings to the result of a fit: what a method of networks hands back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trms_cli.identification.blackbox.playback import normalised_rms, predicted, simulated
from trms_cli.identification.blackbox.preparation import Prepared
from trms_cli.identification.blackbox.regressors import Samples
from trms_cli.identification.blackbox.trainable import FloatArray, TrainableNetwork
from trms_cli.identification.blackbox.training.training import Outcome as Ending
from trms_cli.identification.blackbox.training.training import Stopping, Training, Watcher
from trms_cli.identification.method import FitResult, HistoryPoint, Outcome, Progress
from trms_cli.identification.problem import FitProblem
from trms_cli.models.narx_file import NarxFile
from trms_cli.models.network import Network

_OUTCOMES = {
    Ending.GRADIENT: Outcome.CONVERGED,
    Ending.VALIDATION: Outcome.CONVERGED,
    Ending.GOAL: Outcome.CONVERGED,
    Ending.SETTLED: Outcome.CONVERGED,
    Ending.EPOCHS: Outcome.BUDGET_SPENT,
    Ending.NO_PROGRESS: Outcome.STUCK,
    Ending.INTERRUPTED: Outcome.INTERRUPTED,
}


@dataclass(frozen=True)
class Stage:
    """One training of a fit."""

    name: str  #: Short, for the record: ``one step``, ``2 s``
    training: Training
    prepared: float = 0.0  #: Processor time before the first epoch, for placing units, s

    @property
    def seconds(self) -> float:
        """Processor time of the stage, s."""
        return self.prepared + float(self.training.history.seconds[-1])


def told(progress: Progress, begin: float, share: float, stopping: Stopping, name: str) -> Watcher:
    """A watcher that shows a training as a share of a fit's work from ``begin`` on.

    It raises KeyboardInterrupt when somebody asks to stop.
    """

    def watch(epoch: int, loss: float, validation: float) -> None:
        done = begin + share * min(1.0, epoch / stopping.epochs)
        message = f"{name}: epoch {epoch}, RMS error {np.sqrt(loss):.3g}"
        if np.isfinite(validation):
            message += f", validation {np.sqrt(validation):.3g}"
        if not progress.update(done, loss, message):
            raise KeyboardInterrupt

    return watch


def interrupted(stages: Sequence[Stage]) -> bool:
    """Whether the last training was ended from outside."""
    return bool(stages) and stages[-1].training.outcome is Ending.INTERRUPTED


def fit_result(
    method: str,
    problem: FitProblem,
    data: Prepared,
    network: TrainableNetwork,
    stages: Sequence[Stage],
) -> FitResult:
    """The result of a fit whose last stage holds the network."""
    last = stages[-1].training
    stored = data.stored(network, last.theta)
    model = problem.model
    history, before, evaluations = [], 0.0, 0
    for stage in stages:
        for second, loss in zip(
            stage.training.history.seconds, stage.training.history.losses, strict=True
        ):
            evaluations += 1
            history.append(HistoryPoint(evaluations, before + stage.prepared + second, loss))
        before += stage.seconds
    record = {
        "method": method,
        "seed": problem.seed,
        "weights": network.n_parameters,
        "stages": [_told_of(stage) for stage in stages],
        "normalised_rms": errors_of(data, stored),
    }
    effective = last.history.effective[-1]
    if np.isfinite(effective):
        record["effective_weights"] = float(effective)
    bounds = dict(zip(data.structure.inputs, model.input_bounds()[1].tolist(), strict=True))
    stops = {name: float(stop) for name, stop in model.stops.items()}
    document = NarxFile(
        name=method,
        structure=data.structure,
        network=stored,
        limits={name: value for name, value in (bounds | stops).items() if np.isfinite(value)},
        training=record,
    )
    return FitResult(
        method=method,
        outcome=_OUTCOMES[last.outcome],
        cost=float(last.history.losses[last.best_epoch]),
        history=history,
        evaluations=evaluations,
        seconds=before,
        model_document=document.to_data(),
        details=record,
    )


def errors_of(data: Prepared, network: Network) -> dict[str, float | None]:
    """Normalised RMS errors one step ahead and in free run, over the fitted and held-out data.

    1 is as good as the mean of each output; None where there are no data or the run diverged.
    """
    return {
        f"{part}_{kind}": error_over(data, network, getattr(data, part), play)
        for part in ("fitted", "validation")
        for kind, play in (("one_step", predicted), ("free_run", simulated))
    }


def error_over(
    data: Prepared,
    network: Network,
    recordings: Sequence[Samples],
    play: Callable[..., FloatArray],
) -> float | None:
    """Normalised RMS error of a playback over recordings; None for none or a divergence."""
    if not recordings:
        return None
    first = data.structure.longest_lag
    played = np.vstack([play(data.structure, network, samples)[first:] for samples in recordings])
    measured = np.vstack([samples.outputs[first:] for samples in recordings])
    value = normalised_rms(played - measured, measured)
    return value if np.isfinite(value) else None


def _told_of(stage: Stage) -> dict[str, Any]:
    training = stage.training
    checked = training.history.validation[training.best_epoch]
    return {
        "name": stage.name,
        "outcome": training.outcome.value,
        "epochs": training.history.epochs,
        "kept_epoch": training.best_epoch,
        "seconds": round(stage.seconds, 3),
        "loss": float(training.history.losses[training.best_epoch]),
        "validation_loss": float(checked) if np.isfinite(checked) else None,
    }
