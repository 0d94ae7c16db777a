"""Full state: the observer that is allowed to look inside the rig.

What a perfect estimator would give; the reference that others are measured against. It works with
simulated rigs only, also with ones that have more states than the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import index_of
from trms_cli.observers.observer import Estimate, ObserverSetup

FloatArray = npt.NDArray[np.float64]


@dataclass
class FullStateState:
    """The model's state names, what predicts the measurement, and the estimate that is reused."""

    names: tuple[str, ...]
    measurement: BufferedFunction
    estimate: Estimate


@dataclass(frozen=True)
class FullState:
    """The true states by name; no disturbance is estimated, so there is no offset-free control."""

    def init(self, setup: ObserverSetup) -> FullStateState:
        model = setup.model
        channels = [index_of(model.outputs, n, "an output of the model") for n in setup.outputs]
        x, u, p, _ = model.symbols()
        y = model.measurement(x, u, p)[channels]
        measurement = BufferedFunction(ca.Function("measured_channels", [x, u, p], [y]))
        measurement.inputs[2][:] = model.parameters.values
        n_y = len(channels)
        estimate = Estimate(
            x=model.rest(),
            sd=np.zeros(model.n_x),
            disturbance=np.zeros(model.n_w),
            disturbance_sd=np.zeros(model.n_w),
            predicted=np.zeros(n_y),
            innovation=np.full(n_y, np.nan),
            innovation_sd=np.array([setup.noise_sd[name] for name in setup.outputs]),
        )
        return FullStateState(model.state_names, measurement, estimate)

    def step(
        self,
        state: FullStateState,
        command: FloatArray,
        measurement: FloatArray,
        truth: Mapping[str, float] | None,
        known: FloatArray | None = None,
    ) -> Estimate:
        estimate = state.estimate
        if known is not None:
            estimate.disturbance[:] = known
        if truth is None:
            raise ConfigurationError(
                "a recording does not hold the true state",
                where="observer",
                remedy="estimate it: observer=ukf",
            )
        try:
            estimate.x[:] = [truth[name] for name in state.names]
        except KeyError as missing:
            raise ConfigurationError(
                f"the rig has no state {missing.args[0]!r}, which the model has; "
                f"the rig's are: {', '.join(truth)}",
                where="observer",
                remedy="observer=ukf, or give rig and model the same states",
            ) from None
        predict = state.measurement
        predict.inputs[0][:] = estimate.x
        predict.inputs[1][:] = command
        predict()
        estimate.predicted[:] = predict.outputs[0]
        np.subtract(measurement, predict.outputs[0], out=estimate.innovation)
        return estimate
