"""What is common to all training algorithms: when to stop, what is kept, what is told.

An algorithm minimises an :class:`TrainingObjective` from a start and reports after each epoch; the
report raises :class:`TrainingStopped` when it is time to end, which no algorithm catches. So an
algorithm is nothing but its published steps, and a library's minimiser fits the same interface.
"""

import enum
from collections.abc import Callable
from dataclasses import dataclass, field
from time import process_time
from typing import Annotated, ClassVar, Protocol

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.blackbox.prediction_error import TrainingObjective


class TrainingOutcome(enum.Enum):
    """How a training ended: a sentence and what to do."""

    GRADIENT = "the gradient vanished: a minimum"
    EPOCHS = "all epochs done (more: method.stopping.epochs)"
    VALIDATION = "the validation error rose; the weights of its minimum are kept"
    GOAL = "the loss reached its goal"
    SETTLED = "the loss settled"
    NO_PROGRESS = "no step reduces the loss any more (try another seed, or another algorithm)"
    INTERRUPTED = "interrupted; the best weights so far are kept"


#: Epochs over which a loss that does not change has settled.
_WHILE = 20


class TrainingStopped(Exception):
    """Raised by the report to end an algorithm."""


class EpochReport(Protocol):
    """Called by an algorithm after each epoch."""

    def __call__(
        self, theta: FloatArray, loss: float, slope: float, effective: float | None = None
    ) -> None:
        """Take note of the weights, the loss, the norm of its gradient and, of a regularised
        training, the effective number of parameters.

        Raises TrainingStopped when it is time to end.
        """


class TrainingAlgorithm(Protocol):
    """A training algorithm: configuration, and one method."""

    regularised: ClassVar[bool] = False  #: It guards against over-fitting itself: no early stopping

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        """Reduce the loss epoch by epoch; return when nothing reduces it any more."""


@dataclass(frozen=True, kw_only=True)
class Stopping:
    """When a training ends."""

    epochs: Annotated[int, Meta(ge=1)] = 300  #: At the most
    gradient: Annotated[float, Meta(ge=0)] = 1e-7  #: Ends below this norm of the loss's gradient
    #: Ends when the loss has changed by less than this share of itself over 20 epochs
    progress: Annotated[float, Meta(ge=0)] = 1e-7
    goal: Annotated[float, Meta(ge=0)] = 0.0  #: Ends below this loss
    #: Epochs without a lower validation error until it ends; 0: no early stopping
    patience: Annotated[int, Meta(ge=0)] = 20


@dataclass(frozen=True)
class TrainingHistory:
    """A training epoch by epoch; entry 0 is the start."""

    #: s of processor time since the start, without what validation takes
    seconds: list[float] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)  #: Mean squared residuals
    validation: list[float] = field(default_factory=list)  #: Of held-out data; NaN without any
    #: Effective number of parameters; NaN where not known
    effective: list[float] = field(default_factory=list)

    @property
    def epochs(self) -> int:
        return max(0, len(self.losses) - 1)


@dataclass(frozen=True)
class Training:
    """What a training gave."""

    #: (P,) array; weights of the smallest validation error where early stopping is on, of the
    #: smallest loss where it is not; of a training that regularises itself the last, for its loss
    #: alone is not what it reduces
    theta: FloatArray
    history: TrainingHistory
    outcome: TrainingOutcome
    best_epoch: int  #: The epoch whose weights are kept


#: Told after each epoch: the epoch, the loss, the validation loss. May raise KeyboardInterrupt.
Watcher = Callable[[int, float, float], None]


class _Recorder:
    """The report of one training."""

    def __init__(
        self,
        start: FloatArray,
        stopping: Stopping,
        validation: TrainingObjective | None,
        watcher: Watcher | None,
        *,
        regularised: bool,
    ) -> None:
        early = validation is not None and stopping.patience > 0 and not regularised
        self.history = TrainingHistory()
        self.outcome = TrainingOutcome.NO_PROGRESS
        self.best_theta, self.best, self.best_epoch = start.copy(), np.inf, 0
        self._stopping, self._validation = stopping, validation
        self._early, self._regularised = early, regularised
        self._watcher = watcher
        self._elapsed, self._resumed = 0.0, process_time()

    def __call__(
        self, theta: FloatArray, loss: float, slope: float, effective: float | None = None
    ) -> None:
        self._elapsed += process_time() - self._resumed
        history, epoch = self.history, len(self.history.losses)
        checked = self._validation.loss(theta) if self._validation is not None else np.nan
        history.seconds.append(self._elapsed)
        history.losses.append(loss)
        history.validation.append(checked)
        history.effective.append(np.nan if effective is None else effective)
        merit = checked if self._early else loss
        if self._regularised or merit < self.best or epoch == 0:
            self.best_theta, self.best, self.best_epoch = theta.copy(), merit, epoch
        if self._watcher is not None:
            self._watcher(epoch, loss, checked)
        self._end_if_due(epoch, loss, slope)
        self._resumed = process_time()

    def settled(self) -> bool:
        """Whether the loss has hardly changed for a while."""
        losses = self.history.losses
        if len(losses) <= _WHILE:
            return False
        lately = losses[-_WHILE - 1 :]
        if not np.isfinite(lately).all():
            return False
        return max(lately) - min(lately) <= self._stopping.progress * lately[-1]

    def _end_if_due(self, epoch: int, loss: float, slope: float) -> None:
        stopping = self._stopping
        reasons = {
            TrainingOutcome.GOAL: loss <= stopping.goal,
            TrainingOutcome.GRADIENT: slope <= stopping.gradient,
            TrainingOutcome.SETTLED: self.settled(),
            TrainingOutcome.VALIDATION: self._early
            and epoch - self.best_epoch >= stopping.patience,
            TrainingOutcome.EPOCHS: epoch >= stopping.epochs,
        }
        for outcome, due in reasons.items():
            if due:
                self.outcome = outcome
                raise TrainingStopped


def train(
    algorithm: TrainingAlgorithm,
    objective: TrainingObjective,
    start: FloatArray,
    stopping: Stopping,
    *,
    validation: TrainingObjective | None = None,
    watcher: Watcher | None = None,
) -> Training:
    """Train from a start until the algorithm or the stopping rule ends it.

    ``validation``: the same error on data that is not fitted; with ``stopping.patience`` above 0
    the weights of its minimum are kept, unless the algorithm regularises itself. ``watcher``: a
    KeyboardInterrupt from it, or from the keyboard, ends the training and keeps the best weights so
    far. Raises ConfigurationError if the loss is not finite at the start.
    """
    recorder = _Recorder(start, stopping, validation, watcher, regularised=algorithm.regularised)
    loss, slope = objective.gradient(start)
    if not np.isfinite(loss):
        raise ConfigurationError(
            "the network's first simulation diverges",
            where="method",
            remedy="start from a network trained on one-step errors, or on shorter windows",
        )
    try:
        recorder(start, loss, float(np.linalg.norm(slope)))
        # A step too long is seen by its loss; NumPy's warnings would only repeat it.
        with np.errstate(over="ignore", invalid="ignore"):
            algorithm.minimise(objective, start.copy(), recorder)
    except TrainingStopped:
        pass
    except KeyboardInterrupt:
        recorder.outcome = TrainingOutcome.INTERRUPTED
    return Training(recorder.best_theta, recorder.history, recorder.outcome, recorder.best_epoch)
