"""Extended Kalman filter with integrating disturbances.

Prediction by the model's own discrete step, covariance by its Jacobian at the last estimate, both
from one set of symbolic equations; see :mod:`trms_cli.observers.kalman_step`.
"""

from dataclasses import dataclass

import casadi as ca

from trms_cli.core.arrays import FloatArray
from trms_cli.core.process_cache import call_memoised
from trms_cli.observers.augmentation import Augmentation, AugmentedModel
from trms_cli.observers.kalman_step import exact_measurement, exact_transition, kalman_step
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import RecursiveFilter


@dataclass(frozen=True, kw_only=True)
class Ekf(RecursiveFilter):
    """Extended Kalman filter; its fields are those of
    :class:`trms_cli.observers.augmentation.FilterOptions`.
    """

    def compose(
        self, setup: ObserverSetup, augmented: Augmentation
    ) -> tuple[ca.Function, FloatArray]:
        return call_memoised(_step, augmented.alone()), augmented.model.parameters.values


def _step(augmented: AugmentedModel) -> ca.Function:
    return kalman_step(
        "ekf_step", augmented, exact_transition(augmented), exact_measurement(augmented)
    )
