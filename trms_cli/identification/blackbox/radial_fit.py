"""Methods ``rbf`` and ``wavelet``: radial networks on one-step errors.

First the units are placed from the data and the linear weights solved for; then, on request, all
weights are trained together.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import process_time
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.identification.blackbox.narx import check_training
from trms_cli.identification.blackbox.one_step import Objective
from trms_cli.identification.blackbox.outcome import Stage, fit_result, told
from trms_cli.identification.blackbox.preparation import Prepared, Regressors, prepared_problem
from trms_cli.identification.blackbox.radial import Radial
from trms_cli.identification.blackbox.radial_start import (
    clustered,
    dyadic,
    selected,
    with_linear_weights,
)
from trms_cli.identification.blackbox.trainable import FloatArray
from trms_cli.identification.blackbox.training.training import (
    Outcome,
    Report,
    Stopping,
    TrainingAlgorithm,
    train,
)
from trms_cli.identification.method import FitResult, Progress
from trms_cli.identification.problem import FitProblem

#: Candidates of a selection, and samples that they are judged on: more cost time and tell little.
_MOST_CANDIDATES, _MOST_SAMPLES = 600, 4000


@dataclass(frozen=True, kw_only=True)
class RadialFit:
    """A network of radial units beside a linear part."""

    kind: Literal["rbf", "wavelet"]
    training: TrainingAlgorithm
    placement: Literal["kmeans", "ols", "dyadic"] = "kmeans"  #: How centres and widths begin
    units: Annotated[int, Meta(ge=1, le=1000)] = 20
    #: Width over the distance to the neighbours (kmeans), or over the spread of the data (ols)
    width: Annotated[float, Meta(gt=0)] = 1.0
    levels: Annotated[int, Meta(ge=1, le=6)] = 3  #: Grids of the dyadic placement
    ridge: Annotated[float, Meta(ge=0)] = 1e-8  #: Of the linear least squares, relative
    tune: bool = True  #: Whether all weights are then trained by ``training``
    regressors: Regressors = field(default_factory=Regressors)
    stopping: Stopping = field(default_factory=Stopping)

    fits_parameters: ClassVar[bool] = False

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem's recordings.

        Raises RecordingError if the recordings cannot be fitted; it says what to record instead.
        """
        check_training(self.training)
        data = prepared_problem(self.regressors, problem)
        begin = process_time()
        network, theta = self.placed(data, problem.seed)
        placing = process_time() - begin
        stopping = self.stopping if self.tune else Stopping(epochs=1)
        algorithm: TrainingAlgorithm = self.training if self.tune else _AsPlaced()
        training = train(
            algorithm,
            data.one_step(network),
            theta,
            stopping,
            validation=data.one_step(network, "validation") if data.validation else None,
            watcher=told(progress, 0.0, 1.0, stopping, "one step"),
        )
        if not self.tune:
            training = replace(training, outcome=Outcome.GOAL)
        return fit_result(self.kind, problem, data, network, [Stage("one step", training, placing)])

    def placed(self, data: Prepared, seed: int) -> tuple[Radial, FloatArray]:
        """The network with its units placed and its linear weights solved for."""
        generator = np.random.default_rng(np.random.SeedSequence([seed, 0x52414449]))
        z, targets = data.normalised(data.fitted_smooth)
        n_out = targets.shape[1]
        if self.placement == "kmeans":
            centres, widths = clustered(z, min(self.units, len(z)), self.width, generator)
        else:
            few = _drawn(len(z), _MOST_SAMPLES, generator)
            if self.placement == "ols":
                centres = z[_drawn(len(z), _MOST_CANDIDATES, generator)]
                widths = np.full(len(centres), self.width * np.sqrt(z.shape[1]))
            else:
                centres, widths = dyadic(z, self.levels)
                kept = _drawn(len(centres), _MOST_CANDIDATES, generator)
                centres, widths = centres[kept], widths[kept]
            family = Radial(self.kind, z.shape[1], n_out, len(centres))
            outputs = family.units(centres, widths, z[few])
            fixed = np.hstack([z[few], np.ones((len(few), 1))])
            chosen = selected(outputs, targets[few], fixed, self.units)
            centres, widths = centres[chosen], widths[chosen]
        network = Radial(self.kind, z.shape[1], n_out, len(centres))
        return network, with_linear_weights(network, centres, widths, z, targets, self.ridge)


class _AsPlaced:
    """No training: the placed units with their linear weights."""

    regularised: ClassVar[bool] = True

    def minimise(self, objective: Objective, start: FloatArray, report: Report) -> None:
        return


def _drawn(n: int, most: int, generator: np.random.Generator) -> np.ndarray:
    """Up to ``most`` of n indices, in order."""
    if n <= most:
        return np.arange(n)
    return np.sort(generator.choice(n, most, replace=False))
