"""Full state: the observer that is allowed to look inside the rig.

What a perfect estimator would give; the reference that others are measured against. It works with
simulated rigs only, also with ones that have more states than the model. What a black-box model
remembers of past outputs and inputs is no state of a rig: it is kept here, sample by sample.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discrete import copied_states
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model
from trms_cli.models.rest import resting_state
from trms_cli.observers.observer import ObserverSetup


@dataclass
class FullStateState:
    """What is used again at each sample."""

    model: Model
    names: tuple[str, ...]  #: States that are taken from the rig
    rows: list[int]  #: Their places in x
    past: list[int]  #: Places in x of the states that only remember
    #: The model over a sample, for what it then remembers; None where it remembers nothing
    advance: BufferedFunction | None
    #: (n_full,) array; its state, memory of the input path included; empty before the first sample
    full: FloatArray
    measurement: BufferedFunction
    estimate: Estimate


@dataclass(frozen=True)
class FullState:
    """The true states by name; no disturbance is estimated, so there is no offset-free control."""

    def init(self, setup: ObserverSetup) -> FullStateState:
        model = setup.model
        channels = setup.channels()
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
        past = sorted(copied_states(model))
        rows = [i for i in range(model.n_x) if i not in past]
        return FullStateState(
            model,
            tuple(model.state_names[i] for i in rows),
            rows,
            past,
            _advance(setup) if past else None,
            np.zeros(0),
            measurement,
            estimate,
        )

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
            estimate.x[state.rows] = [truth[name] for name in state.names]
        except KeyError as missing:
            raise ConfigurationError(
                f"the rig has no state {missing.args[0]!r}, which the model has; "
                f"the rig's are: {', '.join(truth)}",
                where="observer",
                remedy="observer=ukf, or give rig and model the same states",
            ) from None
        if state.advance is not None:
            _remember(state, state.advance, command)
        predict = state.measurement
        predict.inputs[0][:] = estimate.x
        predict.inputs[1][:] = command
        predict()
        estimate.predicted[:] = predict.outputs[0]
        np.subtract(measurement, predict.outputs[0], out=estimate.innovation)
        return estimate


def _advance(setup: ObserverSetup) -> BufferedFunction:
    """The model over one sample, which must be its own: between two samples nothing is known.

    Raises ConfigurationError if the model steps faster than the rig is sampled.
    """
    model = setup.model
    discrete = discretise(model, setup.sample_time)
    if len(discrete.parts) > 1:
        raise ConfigurationError(
            f"model {model.name!r} remembers outputs {model.sample_time:g} s apart, and the rig is "
            f"looked at every {setup.sample_time:g} s",
            where="observer",
            remedy=f"sim.sample_time={model.sample_time:g}, or observer=ukf",
        )
    step = BufferedFunction(discrete.step)
    step.inputs[2][:] = model.parameters.values
    return step


def _remember(state: FullStateState, advance: BufferedFunction, command: FloatArray) -> None:
    """Fill in the states that only remember; at the first sample, as after a long rest."""
    x, n_x = state.estimate.x, state.model.n_x
    if not state.full.size:
        truth = dict(zip(state.names, x[state.rows].tolist(), strict=True))
        x[:] = resting_state(state.model, truth, command)
        memory = discretise(state.model, state.model.sample_time or 0.0).initial(x, command)[n_x:]
        state.full = np.concatenate([x, memory])
        return
    advance.inputs[0][:] = state.full
    advance.inputs[1][:] = command
    advance()
    x[state.past] = advance.outputs[0][state.past]
    state.full[:n_x], state.full[n_x:] = x, advance.outputs[0][n_x:]
