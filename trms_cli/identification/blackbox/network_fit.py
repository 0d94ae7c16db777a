"""What methods of networks share: recordings made ready for a fit, and the result of trainings."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.identification.blackbox.prediction_error import (
    MultiStepError,
    OneStepError,
    Samples,
    Scaling,
    Structure,
    normalised_rms,
    predict_samples,
    rows,
    sample_signals,
    scaling,
    simulate_network,
)
from trms_cli.identification.blackbox.trainable import TrainableNetwork
from trms_cli.identification.blackbox.training.training import (
    Stopping,
    Training,
    TrainingAlgorithm,
    Watcher,
    train,
)
from trms_cli.identification.blackbox.training.training import TrainingOutcome as Ending
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    HistoryPoint,
    Progress,
)
from trms_cli.models.model import Signal, names
from trms_cli.models.narx_file import NarxFile
from trms_cli.models.network import NarxStructure, Network

Lag = Annotated[int, Meta(ge=1)]


@dataclass(frozen=True, kw_only=True)
class Regressors:
    """What a network predicts from, as configuration has it."""

    #: Samples back, rising from 1 on; empty for a network of past commands alone
    output_lags: tuple[Lag, ...] = (1, 2)
    input_lags: tuple[Lag, ...] = (1, 2)  #: Samples back, rising from 1 on
    sample_time: Annotated[float, Meta(gt=0)] | None = None  #: s; None: the recordings'
    incremental: bool = True  #: The network gives the change of the outputs, else the outputs
    differences: bool = True  #: Differences between successive lags in place of the lagged outputs
    #: s, length of the Savitzky–Golay window over the outputs before fitting; 0: none
    smoothing: Annotated[float, Meta(ge=0)] = 0.0

    def structure(
        self, outputs: Sequence[Signal], inputs: Sequence[Signal], sample_time: float
    ) -> NarxStructure:
        """The structure for given signals; ``sample_time`` (s) where none is chosen.

        Raises ConfigurationError for lags that do not fit; it names the key.
        """
        with complaints_by_key():
            return NarxStructure(
                names(outputs),
                names(inputs),
                tuple(signal.unit for signal in outputs),
                tuple(signal.unit for signal in inputs),
                self.output_lags,
                self.input_lags,
                self.sample_time or sample_time,
                self.incremental,
                self.differences,
            )


@contextmanager
def complaints_by_key() -> Iterator[None]:
    """Complaints of a structure name the key of ``method.regressors``."""
    try:
        yield
    except TrmsError as error:
        raise ConfigurationError(
            error.problem, where=f"method.regressors.{error.where}", remedy=error.remedy
        ) from error


class RegressorOptions(Protocol):
    """What a network predicts from, as :class:`Regressors` or another form."""

    @property
    def smoothing(self) -> float: ...

    def structure(
        self, outputs: Sequence[Signal], inputs: Sequence[Signal], sample_time: float
    ) -> Structure: ...


@dataclass(frozen=True)
class NetworkData:
    """Recordings at a network's sample time."""

    structure: Structure
    scaling: Scaling  #: Of the fitted recordings
    fitted: list[Samples]  #: As measured
    validation: list[Samples]  #: As measured
    fitted_smooth: list[Samples] = field(repr=False)  #: Smoothed
    #: the same objects where no smoothing is asked for
    validation_smooth: list[Samples] = field(repr=False)

    @property
    def lags(self) -> NarxStructure:
        """The structure, of a method whose networks predict from lagged samples."""
        assert isinstance(self.structure, NarxStructure)
        return self.structure

    def normalised(self, recordings: Sequence[Samples]) -> tuple[FloatArray, FloatArray]:
        """Regressors (n, n_phi) and targets (n, n_y) in units of the scales."""
        pairs = [rows(self.structure, samples) for samples in recordings]
        regressors, targets = (np.vstack([pair[i] for pair in pairs]) for i in (0, 1))
        scale = self.scaling
        return (
            (regressors - scale.regressor_mean) / scale.regressor_sd,
            (targets - scale.output_mean) / scale.output_sd,
        )

    def one_step(
        self,
        network: TrainableNetwork,
        part: Literal["fitted", "validation"] = "fitted",
        every: int = 1,
    ) -> OneStepError:
        """The one-step error of a part of the recordings, of each such row."""
        z, targets = self.normalised(getattr(self, f"{part}_smooth"))
        return OneStepError(network, z[::every], targets[::every])

    def train_one_step(
        self,
        network: TrainableNetwork,
        algorithm: TrainingAlgorithm,
        start: FloatArray,
        stopping: Stopping,
        watcher: Watcher | None = None,
        every: int = 1,
    ) -> Training:
        """Train on the one-step errors from starting weights, watched by those held out."""
        return train(
            algorithm,
            self.one_step(network, every=every),
            start,
            stopping,
            validation=self.one_step(network, "validation") if self.validation else None,
            watcher=watcher,
        )

    def simulation(
        self,
        network: TrainableNetwork,
        steps: int,
        part: Literal["fitted", "validation"] = "fitted",
        stride: int | None = None,
        every: int = 1,
    ) -> MultiStepError:
        """The simulation error over windows; they start from smoothed samples."""
        return MultiStepError(
            network,
            self.lags,
            self.scaling,
            getattr(self, part),
            steps,
            starts=getattr(self, f"{part}_smooth"),
            stride=stride,
            every=every,
        )

    def stored(self, network: TrainableNetwork, theta: FloatArray) -> Network:
        """The trained network with its scales."""
        scale = self.scaling
        return Network(
            network.kind,
            network.weights(theta),
            scale.regressor_mean,
            scale.regressor_sd,
            scale.output_mean,
            scale.output_sd,
            getattr(network, "activation", "tanh"),
        )


def prepare_fit(
    regressors: RegressorOptions, problem: FitProblem, training: TrainingAlgorithm
) -> NetworkData:
    """Bring recordings to the form that networks are fitted to.

    Raises RecordingError for sample times without a whole ratio, missing channels, inputs or
    outputs that never move, too few samples; ConfigurationError for what is no training.
    """
    if not callable(getattr(training, "minimise", None)):
        raise ConfigurationError(
            f"{type(training).__name__} is no training algorithm",
            where="method.training",
            remedy="choose one of `trms list training`: training@method.training=lm",
        )
    return prepare_samples(regressors, problem)


def prepare_samples(regressors: RegressorOptions, problem: FitProblem) -> NetworkData:
    """:func:`prepare_fit` for what no training algorithm fits."""
    fitted, validation = problem.datasets, problem.validation
    first = fitted[0]
    structure = regressors.structure(first.outputs, first.inputs, first.sample_time)

    def samples_of(datasets: Sequence[Dataset], smoothing: float) -> list[Samples]:
        return [sample_signals(dataset, structure, smoothing) for dataset in datasets]

    raw, raw_validation = samples_of(fitted, 0.0), samples_of(validation, 0.0)
    smooth, smooth_validation = raw, raw_validation
    if regressors.smoothing > 0:
        smooth = samples_of(fitted, regressors.smoothing)
        smooth_validation = samples_of(validation, regressors.smoothing)
    scale = scaling(structure, smooth)
    return NetworkData(structure, scale, raw, raw_validation, smooth, smooth_validation)


#: How a fit ended whose last training ended so.
OUTCOMES = {
    Ending.GRADIENT: FitOutcome.CONVERGED,
    Ending.VALIDATION: FitOutcome.CONVERGED,
    Ending.GOAL: FitOutcome.CONVERGED,
    Ending.SETTLED: FitOutcome.CONVERGED,
    Ending.EPOCHS: FitOutcome.BUDGET_SPENT,
    Ending.NO_PROGRESS: FitOutcome.STUCK,
    Ending.INTERRUPTED: FitOutcome.INTERRUPTED,
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


def training_watcher(
    progress: Progress, begin: float, share: float, stopping: Stopping, name: str
) -> Watcher:
    """A watcher that shows a training as a share of a fit's work from ``begin`` on.

    It raises KeyboardInterrupt when somebody asks to stop.
    """

    def watch(epoch: int, loss: float, validation: float) -> None:
        fraction = begin + share * min(1.0, epoch / stopping.epochs)
        message = f"{name}: epoch {epoch}, RMS error {np.sqrt(loss):.3g}"
        if np.isfinite(validation):
            message += f", validation {np.sqrt(validation):.3g}"
        if not progress.update(fraction, loss, message):
            raise KeyboardInterrupt

    return watch


def was_interrupted(stages: Sequence[Stage]) -> bool:
    """Whether the last training was ended from outside."""
    return bool(stages) and stages[-1].training.outcome is Ending.INTERRUPTED


def fit_result(
    method: str,
    problem: FitProblem,
    data: NetworkData,
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
        outcome=OUTCOMES[last.outcome],
        cost=float(last.history.losses[last.best_epoch]),
        history=history,
        evaluations=evaluations,
        seconds=before,
        model_document=document.to_data(),
        details=record,
    )


def errors_of(data: NetworkData, network: Network) -> dict[str, float | None]:
    """Normalised RMS errors one step ahead and in free run, over the fitted and held-out data.

    1 is as good as the mean of each output; None where there are no data or the run diverged.
    """
    return {
        f"{part}_{kind}": error_over(data, network, getattr(data, part), play)
        for part in ("fitted", "validation")
        for kind, play in (("one_step", predict_samples), ("free_run", simulate_network))
    }


def error_over(
    data: NetworkData,
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
