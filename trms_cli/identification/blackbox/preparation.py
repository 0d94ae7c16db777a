"""From a fit's recordings to a network's: sample time, lags, smoothing, scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.identification.blackbox.multi_step import SimulationError
from trms_cli.identification.blackbox.one_step import OneStepError
from trms_cli.identification.blackbox.regressors import Samples, Scaling, rows, sampled, scaling
from trms_cli.identification.blackbox.trainable import FloatArray, TrainableNetwork
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.problem import FitProblem
from trms_cli.models.model import Signal, names
from trms_cli.models.network import NarxStructure, Network

Lag = Annotated[int, Meta(ge=1)]


@dataclass(frozen=True, kw_only=True)
class Regressors:
    """What a network predicts from, as configuration has it."""

    output_lags: tuple[Lag, ...] = (1, 2)  #: Samples back, rising from 1 on
    input_lags: tuple[Lag, ...] = (1, 2)  #: Samples back, rising from 1 on
    #: s, a whole multiple of the recordings'; None: theirs
    sample_time: Annotated[float, Meta(gt=0)] | None = None
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
        try:
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
        except TrmsError as error:
            raise ConfigurationError(
                error.problem, where=f"method.regressors.{error.where}", remedy=error.remedy
            ) from error


@dataclass(frozen=True)
class Prepared:
    """Recordings at a network's sample time."""

    structure: NarxStructure
    scaling: Scaling  #: Of the fitted recordings
    fitted: list[Samples]  #: As measured
    validation: list[Samples]  #: As measured
    fitted_smooth: list[Samples] = field(repr=False)  #: Smoothed
    #: the same objects where no smoothing is asked for
    validation_smooth: list[Samples] = field(repr=False)

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

    def simulation(
        self,
        network: TrainableNetwork,
        steps: int,
        part: Literal["fitted", "validation"] = "fitted",
        stride: int | None = None,
        every: int = 1,
    ) -> SimulationError:
        """The simulation error over windows; they start from smoothed samples."""
        return SimulationError(
            network,
            self.structure,
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
            network.named(theta),
            scale.regressor_mean,
            scale.regressor_sd,
            scale.output_mean,
            scale.output_sd,
        )


def prepared(
    regressors: Regressors, fitted: Sequence[Dataset], validation: Sequence[Dataset]
) -> Prepared:
    """Bring recordings to the form that networks are fitted to.

    Raises RecordingError for sample times without a whole ratio, missing channels, inputs or
    outputs that never move, too few samples.
    """
    first = fitted[0]
    structure = regressors.structure(first.outputs, first.inputs, first.sample_time)

    def taken(datasets: Sequence[Dataset], smoothing: float) -> list[Samples]:
        return [sampled(dataset, structure, smoothing) for dataset in datasets]

    raw, raw_validation = taken(fitted, 0.0), taken(validation, 0.0)
    smooth, smooth_validation = raw, raw_validation
    if regressors.smoothing > 0:
        smooth = taken(fitted, regressors.smoothing)
        smooth_validation = taken(validation, regressors.smoothing)
    scale = scaling(structure, smooth)
    return Prepared(structure, scale, raw, raw_validation, smooth, smooth_validation)


def prepared_problem(regressors: Regressors, problem: FitProblem) -> Prepared:
    """:func:`prepared` for the recordings of a fit."""
    return prepared(regressors, problem.datasets, problem.validation)
