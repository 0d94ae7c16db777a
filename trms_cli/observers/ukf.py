"""Unscented Kalman filter with integrating disturbances.

The state of the model is augmented by constant torques on chosen equations
(:mod:`trms_cli.observers.augmentation`). Sigma points are drawn anew between prediction and
update: on a linear model the filter is the Kalman filter.

The covariance is updated in Joseph's form over the sigma points,

    P = Σ_i W_i (x̃_i − K ỹ_i)(x̃_i − K ỹ_i)ᵀ + K R Kᵀ

a sum of squares for non-negative weights (which the defaults have), with a floor far below every
physical scale. A missing channel's row of ỹ is zero: the update conditions exactly on the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import casadi as ca
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.core.process_cache import kept
from trms_cli.observers.augmentation import Augmentation

# Names that were here before there were other filters, and that others import from here.
from trms_cli.observers.noise_tables import InitialSd, ProcessNoise
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterState as UkfState
from trms_cli.observers.recursive_filter import RecursiveFilter
from trms_cli.observers.sigma_points import SigmaPoints
from trms_cli.observers.ukf_step import filter_step

__all__ = ["InitialSd", "ProcessNoise", "Ukf", "UkfState"]

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Ukf(RecursiveFilter):
    """Unscented Kalman filter; the fields that it shares with the others are those of
    :class:`trms_cli.observers.augmentation.FilterOptions`.
    """

    #: ``alpha``, ``beta``, ``kappa``: Spread of the sigma points; see :class:`SigmaPoints`. With α
    #: = 1 and κ = 0 no weight is negative.
    alpha: Annotated[float, Meta(gt=0, le=1)] = 1.0
    beta: Annotated[float, Meta(ge=0)] = 2.0
    kappa: float = 0.0

    def compose(
        self, setup: ObserverSetup, augmented: Augmentation
    ) -> tuple[ca.Function, FloatArray]:
        points = SigmaPoints(augmented.n, self.alpha, self.beta, self.kappa)
        step = kept(filter_step, augmented.alone(), points)
        return step, augmented.model.parameters.values
