"""NNARMAX and NNSSIF: perceptrons that correct themselves by their past residuals.

Both begin as networks whose residuals are zero, trained one step ahead by Levenberg–Marquardt;
then all weights are trained on the prediction error of the recursion, over windows; what is held
out is predicted from its first sample to its last, so that early stopping refuses predictors that
are not stable. Residuals are normalised by their spread after the first of the two trainings.

Source: M. Nørgaard, O. Ravn, N. K. Poulsen & L. K. Hansen (2000), "Neural Networks for Modelling
and Control of Dynamic Systems", chapters 2 and 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.blackbox.innovation_error import InnovationError
from trms_cli.identification.blackbox.narx import (
    Units,
    perceptron,
    random_start,
    require_past_outputs,
)
from trms_cli.identification.blackbox.network_fit import (
    Lag,
    NetworkData,
    RegressorOptions,
    Regressors,
    Stage,
    complaints_by_key,
    fit_result,
    prepare_fit,
    training_watcher,
    was_interrupted,
)
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.identification.blackbox.training.levenberg_marquardt import LevenbergMarquardt
from trms_cli.identification.blackbox.training.training import (
    Stopping,
    TrainingAlgorithm,
    train,
)
from trms_cli.identification.problem import FitProblem, FitResult, Progress
from trms_cli.models.innovation_network import InnovationStructure
from trms_cli.models.model import Signal, names
from trms_cli.models.network import Activation, NarxStructure


@dataclass(frozen=True, kw_only=True)
class ResidualRegressors(Regressors):
    """What NNARMAX predicts from."""

    residual_lags: tuple[Lag, ...] = (1, 2)  #: Samples back, rising from 1 on

    def structure(
        self, outputs: Sequence[Signal], inputs: Sequence[Signal], sample_time: float
    ) -> NarxStructure:
        require_past_outputs(self)
        if not self.residual_lags:
            raise ConfigurationError(
                "no past residual",
                where="method.regressors.residual_lags",
                remedy="for instance [1, 2]; method=narx is the network without",
            )
        structure = super().structure(outputs, inputs, sample_time)
        with complaints_by_key():
            return replace(structure, residual_lags=self.residual_lags)


@dataclass(frozen=True, kw_only=True)
class StateSpaceOptions:
    """The state space of NNSSIF."""

    order: Annotated[int, Meta(ge=1, le=20)] = 2  #: States of each output
    sample_time: Annotated[float, Meta(gt=0)] | None = None  #: s; None: the recordings'
    incremental: bool = True  #: The network gives the change of the last foretold outputs

    smoothing: ClassVar[float] = 0.0  # the innovations are what smoothing would take away

    def structure(
        self, outputs: Sequence[Signal], inputs: Sequence[Signal], sample_time: float
    ) -> InnovationStructure:
        """The structure for given signals; ``sample_time`` (s) where none is chosen."""
        with complaints_by_key():
            return InnovationStructure(
                names(outputs),
                names(inputs),
                tuple(signal.unit for signal in outputs),
                tuple(signal.unit for signal in inputs),
                self.order,
                self.sample_time or sample_time,
                self.incremental,
            )


@dataclass(frozen=True, kw_only=True)
class InnovationFit:
    """What both have; ``regressors`` says what a network predicts from."""

    training: TrainingAlgorithm
    hidden: tuple[Units, ...] = (10,)  #: Units of each hidden layer
    activation: Activation = "tanh"  #: Of the hidden units
    direct: bool = True  #: A linear part from the regressor straight to the output
    window: Annotated[float, Meta(gt=0)] = 10.0  #: s, length of the windows that are predicted
    skip: Annotated[float, Meta(ge=0)] = 1.0  #: s, start of each that does not count
    #: Of the one-step training by Levenberg–Marquardt that gives the first weights
    first_epochs: Annotated[int, Meta(ge=1)] = 20
    stopping: Stopping = field(default_factory=Stopping)

    fits_parameters: ClassVar[bool] = False
    name: ClassVar[str]  #: Of the method

    def _options(self) -> RegressorOptions:
        raise NotImplementedError

    def _corrected(self, network: Mlp, theta: FloatArray, data: NetworkData) -> FloatArray:
        """First weights of the second training from those of the first."""
        return theta

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        if self.skip >= self.window:
            raise ConfigurationError(
                f"{self.skip:g} s of {self.window:g} s do not count",
                where="method.skip",
                remedy="less than method.window",
            )
        data = prepare_fit(self._options(), problem, self.training)
        structure = data.structure
        network = perceptron(data, self.hidden, self.direct, self.activation)
        theta = random_start(network, problem.seed)
        columns = network.weights(theta)["W1"]  # a view
        columns[:, structure.n_regressors - structure.n_residuals :] = 0.0
        first = Stopping(epochs=self.first_epochs, patience=0)
        watcher = training_watcher(progress, 0.0, 0.3, first, "one step")
        result = data.train_one_step(network, LevenbergMarquardt(), theta, first, watcher)
        stages = [Stage("one step", result)]
        if not was_interrupted(stages):
            data = _residuals_scaled(data, network, result.theta)
            steps = max(2, round(self.window / structure.sample_time))
            skip = round(self.skip / structure.sample_time)
            scale, checked = data.scaling, None
            if held_out := data.validation:
                # As long as recordings are: a predictor that loses its way does so slowly.
                whole = min(map(len, held_out))
                checked = InnovationError(network, structure, scale, held_out, whole, skip)
            result = train(
                self.training,
                InnovationError(network, structure, scale, data.fitted, steps, skip),
                self._corrected(network, result.theta, data),
                self.stopping,
                validation=checked,
                watcher=training_watcher(progress, 0.3, 0.7, self.stopping, "prediction"),
            )
            stages.append(Stage("prediction", result))
        return fit_result(self.name, problem, data, network, stages)


@dataclass(frozen=True, kw_only=True)
class NnarmaxFit(InnovationFit):
    """NNARMAX: past outputs, commands and residuals."""

    regressors: ResidualRegressors = field(default_factory=ResidualRegressors)

    name: ClassVar[str] = "nnarmax"

    def _options(self) -> RegressorOptions:
        return self.regressors


@dataclass(frozen=True, kw_only=True)
class NnssifFit(InnovationFit):
    """NNSSIF: a state space in innovations form."""

    regressors: StateSpaceOptions = field(default_factory=StateSpaceOptions)

    name: ClassVar[str] = "nnssif"

    def _options(self) -> RegressorOptions:
        return self.regressors

    def _corrected(self, network: Mlp, theta: FloatArray, data: NetworkData) -> FloatArray:
        """With a direct part, innovations move all foretold outputs by themselves.

        That is the prediction from measured outputs; without it the predictor would begin as a
        simulation that nothing corrects.
        """
        if not network.direct:
            return theta
        result = theta.copy()
        gain = network.weights(result)["A"]  # a view
        scale, n_y = data.scaling, data.structure.n_residuals
        for row, sd in enumerate(scale.output_sd):
            column = network.n_regressors - n_y + row % n_y
            gain[row, network.n_regressors - n_y :] = 0.0
            gain[row, column] = scale.regressor_sd[column] / sd
        return result


def _residuals_scaled(data: NetworkData, network: Mlp, theta: FloatArray) -> NetworkData:
    """The data with the spread of the present residuals in the place of their regressors'."""
    z, targets = data.normalised(data.fitted_smooth)
    residuals = (network.values(theta, z) - targets) * data.scaling.output_sd
    n_y = len(data.structure.outputs)
    spread = np.maximum(residuals[:, -n_y:].std(axis=0), 1e-6 * data.scaling.output_sd[-n_y:])
    scale = data.scaling.regressor_sd.copy()
    first = data.structure.n_regressors - data.structure.n_residuals
    scale[first:] = np.tile(spread, data.structure.n_residuals // n_y)
    return replace(data, scaling=replace(data.scaling, regressor_sd=scale))
