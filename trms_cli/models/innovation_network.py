"""NNSSIF: a network as the state-space model in innovations form, in an observable form.

With the residual (the innovation) e(k) = y(k) − C x̂(k) the network g gives the next state::

    x̂(k+1) = S x̂(k) + g(x̂(k), u(k), e(k))          ŷ(k) = C x̂(k)

    x̂ = (x_1, …, x_d)      x_j(k): the outputs foretold for sample k + j − 1      C = [I 0 … 0]

d is the order: states of each output, all observability indices being equal. S moves the foretold
outputs up, ``x_j(k+1) = x_{j+1}(k) + g_j``; the last ones start from themselves in an incremental
network, ``x_d(k+1) = x_d(k) + g_d``, and from nothing in another.

As a model for simulation and control the innovation is zero, as nothing is measured; what corrects
the state is then the observer of the loop. Disturbances are accelerations as those of other
networks: added to the last of the foretold outputs, T² w for an angle and T w for a speed.

Source: M. Nørgaard, O. Ravn, N. K. Poulsen & L. K. Hansen (2000), "Neural Networks for Modelling
and Control of Dynamic Systems", chapter 2; the observable form is that of L. Ljung (1999), "System
Identification", appendix 4A.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.black_box import ANGLE, BlackBox
from trms_cli.models.model import FloatArray, Signal
from trms_cli.models.network import NarxStructure, Network, from_plain_data
from trms_cli.models.rest import settled_state


@dataclass(frozen=True)
class InnovationStructure:
    """The state space that a network is the step of.

    Raises ModelError for an order below 1, units that are not one a signal, a sample time that is
    not positive.
    """

    outputs: tuple[str, ...]  #: Names of the signals
    inputs: tuple[str, ...]  #: Names of the signals
    output_units: tuple[str, ...]  #: One a signal
    input_units: tuple[str, ...]  #: One a signal
    order: int  #: States of each output
    sample_time: float  #: s
    incremental: bool = True  #: The last foretold outputs start from themselves

    def __post_init__(self) -> None:
        for name in ("outputs", "inputs", "output_units", "input_units"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if isinstance(self.order, bool) or not isinstance(self.order, int) or self.order < 1:
            raise ModelError(
                f"{self.order!r} given", where="order", remedy="a whole number from 1 on"
            )
        for what in ("output", "input"):
            if len(getattr(self, f"{what}_units")) != len(getattr(self, f"{what}s")):
                raise ModelError(
                    f"{len(getattr(self, f'{what}_units'))} given",
                    where=f"{what}_units",
                    remedy=f"one for each of {', '.join(getattr(self, f'{what}s'))}",
                )
        if not self.sample_time > 0:
            raise ModelError(
                f"{self.sample_time!r} given", where="sample_time", remedy="a positive time in s"
            )

    @property
    def n_states(self) -> int:
        return self.order * len(self.outputs)

    @property
    def n_predicted(self) -> int:
        """Outputs of the network."""
        return self.n_states

    @property
    def n_regressors(self) -> int:
        """States, commands and innovations."""
        return self.n_states + len(self.inputs) + len(self.outputs)

    @property
    def n_residuals(self) -> int:
        """Innovations among the regressors, the last ones."""
        return len(self.outputs)

    @property
    def longest_lag(self) -> int:
        """Samples of the past that must be known before the first prediction."""
        return self.order

    def shift(self) -> FloatArray:
        """S, (n_states, n_states)."""
        n_y = len(self.outputs)
        result = np.eye(self.n_states, k=n_y)
        if self.incremental:
            result[-n_y:, -n_y:] = np.eye(n_y)
        return result

    def to_data(self) -> dict[str, Any]:
        """Plain data for a YAML file."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        }


class InnovationNetwork(BlackBox):
    """A network in innovations form, with innovations of zero.

    Raises ModelError if network and structure do not fit, or a limit names no input or angle.

    ``network``: of as many regressors and outputs as the structure has. ``limits``: as
    :class:`trms_cli.models.black_box.BlackBox` takes them.
    """

    def __init__(
        self,
        structure: InnovationStructure,
        network: Network,
        *,
        name: str = "nnssif",
        limits: Mapping[str, float] | None = None,
    ) -> None:
        check_fit(structure, network)
        self.structure, self.network = structure, network
        outputs = tuple(map(Signal, structure.outputs, structure.output_units))
        inputs = tuple(map(Signal, structure.inputs, structure.input_units))
        ahead = [
            Signal(f"{y.name}_ahead{j}", y.unit, f"{y.name} foretold {j} sample{'s' * (j > 1)}")
            for j in range(1, structure.order)
            for y in outputs
        ]
        super().__init__(outputs, inputs, ahead, structure.sample_time, name=name, limits=limits)
        self._rest: FloatArray | None = None

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        regressor = ca.vertcat(x, u, ca.DM.zeros(self.n_y, 1))
        following = ca.DM(self.structure.shift()) @ x + self.network.expression(regressor)
        push = ca.DM(push_scale(self.outputs, self.structure.sample_time)) * w
        return following + ca.vertcat(ca.DM.zeros(self.n_x - self.n_y, 1), push)

    def rest(self) -> FloatArray:
        """Where the network settles without a command, as nearly as it does."""
        if self._rest is None:
            self._rest = settled_state(self, self.network.regressor_mean[: self.n_x].copy())
        return self._rest.copy()


def push_scale(outputs: Sequence[Signal], sample_time: float) -> FloatArray:
    """Change of each output in a step by a unit of its disturbance, (n_y,)."""
    return np.array([sample_time**2 if y.unit == ANGLE else sample_time for y in outputs])


def check_fit(structure: NarxStructure | InnovationStructure, network: Network) -> None:
    """Raises ModelError for a network whose regressors or outputs are not the structure's."""
    for key, size, expected in (
        ("regressor_mean", network.n_regressors, structure.n_regressors),
        ("output_mean", network.n_outputs, structure.n_predicted),
    ):
        if size != expected:
            raise ModelError(
                f"the network has {size} and the structure {expected}",
                where=f"network.{key}",
                remedy="structure and network belong together: take both from one training",
            )


def structure_from_data(
    data: Mapping[str, Any], where: str = "structure"
) -> NarxStructure | InnovationStructure:
    """The structure of its ``to_data``: of a state space where it has an ``order``, else of lags.

    Raises ModelError for a key that is missing or unknown and for values that do not fit; it names
    the key.
    """
    if isinstance(data, Mapping) and "order" in data:
        return from_plain_data(InnovationStructure, data, where, "write it as trained")
    return NarxStructure.from_data(data, where)
