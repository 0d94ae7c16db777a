"""A filter that carries a mean and a covariance from sample to sample: what all of them share.

The members differ in one function, a step of prediction and update. Its inputs are, in this order,

    m, P, memory, u, y, mask, advance, known, p, q, r, floor, gate

and its outputs

    m_next, P_next, memory_next, health, sd, d, d_sd, predicted, innovation, innovation_sd, rejected

``health`` is finite exactly if mean and covariance are.

Which measurements a filter believes is decided by a gate on each channel's innovation: a sample
whose innovation is beyond ``gate`` of its expected standard deviations is treated as missing. That
alone could blind a filter for ever: where the model is wrong, or the rig was moved by hand, every
sample looks like an outlier. A channel that was rejected without a break for ``longest_rejection``
seconds is therefore believed again, from a covariance widened by the prior's, and stays believed
until its innovations have kept within the gate for as long.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import casadi as ca
import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.estimate import Estimate
from trms_cli.observers.augmentation import Augmentation, FilterOptions, augment
from trms_cli.observers.observer import ObserverSetup

INPUTS = (
    *("m", "P", "memory", "u", "y", "mask", "advance", "known"),
    *("p", "q", "r", "floor", "gate"),
)
OUTPUTS = (
    *("m_next", "P_next", "memory_next", "health", "sd", "d", "d_sd"),
    *("predicted", "innovation", "innovation_sd", "rejected"),
)


@dataclass
class Gate:
    """The gate of a filter that runs, over arrays of its step, which it fills and reads."""

    width: float  #: Standard deviations; infinite for a gate that is open for good
    #: Samples of unbroken rejection after which a channel is believed, and of unbroken agreement
    #: after which it is watched again
    patience: int
    #: (n_y,) array; ``width²`` per channel, infinite where the gate is open: an input of the
    #: filter's step
    squared: FloatArray
    #: (n_y,) array; 1 for what the last sample's gate held back; zeros for a gate that is always
    #: open
    rejected: FloatArray
    #: (n_y,) int array; samples that a watched channel has been rejected, or a believed one has
    #: agreed, in a row
    run: IntArray = field(init=False)
    open: BoolArray = field(init=False)  #: (n_y,) bool array; channels believed again
    counting: bool = False  #: Whether any channel has a run or is believed again

    def __post_init__(self) -> None:
        self.squared[:] = self.width**2
        self.run = np.zeros(self.squared.size, int)
        self.open = np.zeros(self.squared.size, dtype=bool)

    @property
    def active(self) -> bool:
        """Whether there is a gate at all."""
        return self.width < np.inf

    def quiet(self) -> bool:
        """Whether the last sample changes nothing in the gate: all was believed, as before."""
        return not (self.counting or any(self.rejected.tolist()))

    def follow(self, present: BoolArray, innovation: FloatArray, sd: FloatArray) -> bool:
        """Take note of a sample; true if a channel is to be believed from the next one on.

        ``present``: (n_y,) bool array; channels that were measured; the others change nothing.
        ``innovation``, ``sd``: (n_y,) arrays.
        """
        within = np.abs(innovation) <= self.width * sd
        counting = np.where(self.open, within, self.rejected > 0)
        self.run[present & counting] += 1
        self.run[present & ~counting] = 0
        turned = self.run >= self.patience
        widened = bool((turned & ~self.open).any())
        self.run[turned] = 0
        self.open ^= turned
        self.squared[:] = np.where(self.open, np.inf, self.width**2)
        self.counting = bool(self.run.any() or self.open.any())
        return widened


class FilterStep(Protocol):
    """A step of prediction and update, bound to its own arrays: write, call, read."""

    @property
    def inputs(self) -> tuple[FloatArray, ...]:
        """One array for each of :data:`INPUTS`."""

    @property
    def outputs(self) -> tuple[FloatArray, ...]:
        """One array for each of :data:`OUTPUTS`."""

    def __call__(self) -> None:
        """From the present inputs into the outputs."""


@dataclass
class FilterState:
    """The filter at a sample."""

    function: FilterStep  #: One step; its inputs hold the present mean, covariance and memory
    estimate: Estimate  #: Views of its outputs
    prior_mean: FloatArray  #: Before the first measurement
    prior_covariance: FloatArray  #: where the filter recovers to
    present: BoolArray  #: (n_y,) bool array; channels that the last measurement had
    gate: Gate
    #: (n, n) array or None; covariance after every sample, of a filter with a steady gain
    settled: FloatArray | None = None
    has_started: bool = False  #: Whether there was a sample yet
    recoveries: int = 0  #: How often the covariance had to be inflated to the prior


@dataclass(frozen=True, kw_only=True)
class GatedFilter(FilterOptions, ABC):
    """Everything of a Kalman filter but its step; see :class:`FilterOptions` for the fields."""

    @abstractmethod
    def bind(self, setup: ObserverSetup, augmented: Augmentation) -> tuple[FilterStep, FloatArray]:
        """The step with arrays of its own, and its ``p``."""

    def init(self, setup: ObserverSetup) -> FilterState:
        """A fresh state; see :class:`trms_cli.observers.observer.Observer`."""
        return self.start(setup, augment(setup, self))

    def start(self, setup: ObserverSetup, augmented: Augmentation) -> FilterState:
        """A fresh state of a filter whose model is augmented already."""
        function, parameters = self.bind(setup, augmented)
        arguments = dict(zip(INPUTS, function.inputs, strict=True))
        arguments["m"][:] = augmented.mean
        arguments["P"][...] = np.diag(augmented.sd**2)
        arguments["memory"][:] = augmented.memory
        arguments["p"][:] = parameters
        arguments["q"][:] = augmented.q
        arguments["r"][:] = augmented.r
        arguments["floor"][:] = augmented.floor
        results = dict(zip(OUTPUTS, function.outputs, strict=True))
        n_x = augmented.model.n_x
        estimate = Estimate(
            x=results["m_next"][:n_x],
            sd=results["sd"][:n_x],
            disturbance=results["d"],
            disturbance_sd=results["d_sd"],
            predicted=results["predicted"],
            innovation=results["innovation"],
            innovation_sd=results["innovation_sd"],
            rejected=results["rejected"],
        )
        width = np.inf if self.gate is None else self.gate
        patience = max(1, round(self.longest_rejection / setup.sample_time))
        gate = Gate(width, patience, arguments["gate"], results["rejected"])
        present = np.zeros(len(augmented.channels), dtype=bool)
        return FilterState(
            function, estimate, augmented.mean, np.diag(augmented.sd**2), present, gate
        )

    def step(
        self,
        state: FilterState,
        command: FloatArray,
        measurement: FloatArray,
        truth: Mapping[str, float] | None,
        known: FloatArray | None = None,
    ) -> Estimate:
        """The estimate at this sample; see :class:`trms_cli.observers.observer.Observer`."""
        function, gate, estimate = state.function, state.gate, state.estimate
        m, covariance, memory, u, y, mask, advance, acting = function.inputs[:8]
        if known is not None:
            acting[:] = known
        u[:] = command
        complete = math.isfinite(sum(measurement.tolist()))
        if complete:
            state.present[:] = mask[:] = True
            y[:] = measurement
        else:
            np.isfinite(measurement, out=state.present)
            mask[:] = state.present
            y[:] = 0.0
            np.copyto(y, measurement, where=state.present)
        # At time zero there is nothing to predict over: the prior meets the first measurement.
        advance[0] = state.has_started
        state.has_started = True
        function()
        m_next, covariance_next, memory_next, health = function.outputs[:4]
        healthy = math.isfinite(health[0])
        if not healthy:
            recover(state)
        m[:] = m_next
        covariance[...] = covariance_next if state.settled is None else state.settled
        memory[:] = memory_next
        if (
            gate.active
            and not gate.quiet()
            and gate.follow(state.present, estimate.innovation, estimate.innovation_sd)
        ):
            covariance += state.prior_covariance
        if not (complete and healthy):
            estimate.innovation[~state.present] = np.nan
        return estimate


@dataclass(frozen=True, kw_only=True)
class RecursiveFilter(GatedFilter):
    """A filter whose step is one compiled function."""

    @abstractmethod
    def compose(
        self, setup: ObserverSetup, augmented: Augmentation
    ) -> tuple[ca.Function, FloatArray]:
        """The step as a function with :data:`INPUTS` and :data:`OUTPUTS`, and its ``p``."""

    def bind(self, setup: ObserverSetup, augmented: Augmentation) -> tuple[FilterStep, FloatArray]:
        """The step, compiled; see :class:`GatedFilter`."""
        step, parameters = self.compose(setup, augmented)
        return BufferedFunction(step), parameters


def recover(state: FilterState) -> None:
    """Get a finite estimate when a factorisation failed or a model step overflowed.

    The step is repeated from the prior covariance; then from the prior mean too; then without
    the measurement, which no state explains.
    """
    state.recoveries += 1
    function = state.function
    m, covariance, memory, _, _, mask, _ = function.inputs[:7]
    health = function.outputs[3]
    covariance[...] = state.prior_covariance
    function()
    if not np.isfinite(health[0]):
        m[:] = state.prior_mean
        function()
    if not np.isfinite(health[0]):
        mask[:] = 0.0
        state.present[:] = False
        function()
    if not np.isfinite(health[0]):
        for result in function.outputs:
            result[...] = 0.0
        function.outputs[0][:] = m
        function.outputs[1][...] = covariance
        function.outputs[2][:] = memory
