"""NNARX, NNFIR and NNOE: perceptrons trained on one-step errors, and on simulations.

Source: M. Nørgaard, O. Ravn, N. K. Poulsen & L. K. Hansen (2000), "Neural Networks for Modelling
and Control of Dynamic Systems", chapters 2 and 3.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.blackbox.network_fit import (
    NetworkData,
    Regressors,
    Stage,
    fit_result,
    prepare_fit,
    training_watcher,
    was_interrupted,
)
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.identification.blackbox.training.levenberg_marquardt import LevenbergMarquardt
from trms_cli.identification.blackbox.training.training import (
    Stopping,
    Training,
    TrainingAlgorithm,
    train,
)
from trms_cli.identification.problem import FitProblem, FitResult, Progress
from trms_cli.models.network import Activation

Units = Annotated[int, Meta(ge=1, le=1000)]


def random_start(network: Mlp, seed: int) -> FloatArray:
    """First weights of a seed, (P,); of a method with several starts, one seed a start."""
    return network.start(np.random.default_rng(np.random.SeedSequence([seed, 0x4E415258])))


def perceptron(
    data: NetworkData, hidden: tuple[int, ...], direct: bool, activation: Activation
) -> Mlp:
    """A perceptron of as many regressors and outputs as the data have."""
    structure = data.structure
    return Mlp(structure.n_regressors, structure.n_predicted, hidden, direct, activation)


def require_past_outputs(regressors: Regressors) -> None:
    """Raises ConfigurationError for a network without past outputs."""
    if not regressors.output_lags:
        raise ConfigurationError(
            "no past output",
            where="method.regressors.output_lags",
            remedy="for instance [1, 2]; method=nnfir has past commands alone",
        )


@dataclass(frozen=True, kw_only=True)
class NarxFit:
    """NNARX: a perceptron that predicts one sample ahead."""

    training: TrainingAlgorithm
    regressors: Regressors = field(default_factory=Regressors)
    hidden: tuple[Units, ...] = (10,)  #: Units of each hidden layer
    activation: Activation = "tanh"  #: Of the hidden units
    direct: bool = False  #: A linear part from the regressor straight to the output
    #: Random starts; the one of the smallest validation error (without validation: error) is kept
    starts: Annotated[int, Meta(ge=1)] = 1
    stopping: Stopping = field(default_factory=Stopping)

    fits_parameters: ClassVar[bool] = False
    name: ClassVar[str] = "narx"  #: Of the method

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        self._check()
        data = prepare_fit(self.regressors, problem, self.training)
        network = perceptron(data, self.hidden, self.direct, self.activation)
        best: Training | None = None
        for start in range(self.starts):
            name = "one step" if self.starts == 1 else f"start {start + 1} of {self.starts}"
            share = 1.0 / self.starts
            watcher = training_watcher(progress, start * share, share, self.stopping, name)
            theta = random_start(network, problem.seed + start)
            candidate = data.train_one_step(network, self.training, theta, self.stopping, watcher)
            if best is None or _merit(candidate) < _merit(best):
                best = candidate
            if was_interrupted([Stage(name, candidate)]):
                best = replace(best, outcome=candidate.outcome)
                break
        assert best is not None
        return fit_result(self.name, problem, data, network, [Stage("one step", best)])

    def _check(self) -> None:
        require_past_outputs(self.regressors)


@dataclass(frozen=True, kw_only=True)
class NnfirFit(NarxFit):
    """NNFIR: a perceptron that predicts from past commands alone.

    What it predicts from is never wrong and it cannot diverge; its memory is as long as its lags.
    """

    name: ClassVar[str] = "nnfir"

    def _check(self) -> None:
        for key, given, wanted in (
            ("output_lags", list(self.regressors.output_lags), []),
            ("incremental", self.regressors.incremental, False),
        ):
            if given != wanted:
                raise ConfigurationError(
                    f"{str(given).lower()} given, and NNFIR has past commands alone",
                    where=f"method.regressors.{key}",
                    remedy=f"{key}={str(wanted).lower()}; method=narx has past outputs",
                )


@dataclass(frozen=True, kw_only=True)
class NnoeFit:
    """NNOE: a perceptron trained on simulations of many steps, over growing horizons."""

    training: TrainingAlgorithm
    regressors: Regressors = field(default_factory=Regressors)
    hidden: tuple[Units, ...] = (10,)  #: As :class:`NarxFit`
    activation: Activation = "tanh"  #: As :class:`NarxFit`
    direct: bool = True  #: As :class:`NarxFit`
    #: s, lengths of the windows, one training each; each begins with the weights of the last
    horizons: tuple[Annotated[float, Meta(gt=0)], ...] = (0.5, 2.0)
    overlap: Annotated[float, Meta(ge=0, lt=1)] = 0.0  #: Share of a window that the next covers too
    #: Windows at the most, spread over the recordings: short horizons need no more for good weights
    windows: Annotated[int, Meta(ge=1)] = 500
    every: Annotated[int, Meta(ge=1)] = 1  #: Only each such sample of a window counts
    #: Of the one-step training by Levenberg–Marquardt that gives the first weights
    first_epochs: Annotated[int, Meta(ge=1)] = 20
    stopping: Stopping = field(default_factory=Stopping)  #: Of each training

    fits_parameters: ClassVar[bool] = False

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        if not self.horizons:
            raise ConfigurationError(
                "no horizon is given", where="method.horizons", remedy="for instance [0.5, 2.0]"
            )
        require_past_outputs(self.regressors)
        data = prepare_fit(self.regressors, problem, self.training)
        structure = data.structure
        network = perceptron(data, self.hidden, self.direct, self.activation)
        share = 1.0 / (1 + len(self.horizons))
        first = Stopping(epochs=self.first_epochs, patience=0)
        watcher = training_watcher(progress, 0.0, share, first, "one step")
        theta = random_start(network, problem.seed)
        result = data.train_one_step(
            network, LevenbergMarquardt(), theta, first, watcher, self.every
        )
        stages = [Stage("one step", result)]
        for number, horizon in enumerate(self.horizons, start=1):
            if was_interrupted(stages):
                break
            steps = max(1, round(horizon / structure.sample_time))
            samples = sum(len(recording) for recording in data.fitted)
            stride = max(1, round(steps * (1.0 - self.overlap)), samples // self.windows)
            name = f"{horizon:g} s"
            objective = data.simulation(network, steps, "fitted", stride, self.every)
            checked = data.simulation(network, steps, "validation") if data.validation else None
            result = train(
                self.training,
                objective,
                stages[-1].training.theta,
                self.stopping,
                validation=checked,
                watcher=training_watcher(progress, number * share, share, self.stopping, name),
            )
            stages.append(Stage(name, result))
        return fit_result("nnoe", problem, data, network, stages)


def _merit(training: Training) -> float:
    """What starts are compared by: the kept validation error, else the loss."""
    checked = training.history.validation[training.best_epoch]
    return checked if np.isfinite(checked) else training.history.losses[training.best_epoch]
