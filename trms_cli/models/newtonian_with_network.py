"""The Newtonian model with a network that adds what its equations leave out: a hybrid model.

A perceptron N of the beam's motion, the rotors and the commands gives a torque on each axis, which
acts where the model's own torques do::

    J_v Ṡ_v = … + N_pitch(α_v, α_h, Ω_v, Ω_h, ω_v, ω_h, u_v, u_h)
    J_h Ṡ_h = … + N_yaw(…)

in continuous time, smooth, and exact in its derivatives: whatever takes the Newtonian model takes
this one. The equations stay what they are, and what is learnt is only their error (D. C. Psichogios
& L. H. Ungar 1992, "A hybrid neural network–first principles approach to process modeling", AIChE
Journal 38(10)). The hidden layer is of tanh without a linear part beside it, so that the torque is
bounded by the output weights however far the rig leaves what was recorded.

The network stands in the parameter file, beside the parameters that it was trained with::

    model: newtonian_with_network
    parameters: {…}
    torque_network:
      regressors: [alpha_v, alpha_h, alpha_v_rate, alpha_h_rate, omega_v, omega_h, u_v, u_h]
      torques: [pitch_moment, yaw_moment]
      network: {kind: mlp, …}          # as in a network file: in SI, with its normalisation
      training: {…}                    # optional: a record of the training

A set without one is the Newtonian model exactly.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import require_known
from trms_cli.models.model import names
from trms_cli.models.network import Network, check_keys
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import Parameter, ParameterFile

#: Key of the parameter file.
KEY = "torque_network"
#: What a moment acts on: a state's equation, and the inertia in it.
_EQUATIONS = {"pitch_moment": ("S_v", "inertia_pitch"), "yaw_moment": ("S_h", "inertia_yaw")}
#: Ending of the rate of an angle.
_RATE = "_rate"


@dataclass(frozen=True, eq=False)
class TorqueNetwork:
    """A network that gives torques on the axes.

    Raises ModelError if names and network do not fit together.
    """

    #: States (``alpha_v``, ``omega_v``), rates of the angles (``alpha_v_rate``), inputs; in SI
    regressors: tuple[str, ...]
    torques: tuple[str, ...]  #: Moments that it adds to, N m
    network: Network
    #: A record of how it was made, plain data
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, size in (
            ("regressors", self.network.n_regressors),
            ("torques", self.network.n_outputs),
        ):
            value = getattr(self, key)
            if not isinstance(value, list | tuple) or len(value) != size:
                raise ModelError(
                    f"{value!r} given", where=key, remedy=f"the network has {size} {key}: name them"
                )
            object.__setattr__(self, key, tuple(map(str, value)))
        if self.network.kind != "mlp":
            raise ModelError(
                f"{self.network.kind!r} given", where="network.kind", remedy="an mlp is needed"
            )
        for name in self.torques:
            problem = f"there is no torque {name!r} on an axis"
            require_known(name, _EQUATIONS, problem, "torques", ModelError)

    def to_data(self) -> dict[str, Any]:
        """Plain data for a YAML file; read back, every weight has its bits."""
        data: dict[str, Any] = {
            "regressors": list(self.regressors),
            "torques": list(self.torques),
            "network": self.network.to_data(),
        }
        return data | ({"training": dict(self.training)} if self.training else {})

    @classmethod
    def from_data(cls, data: Mapping[str, Any], where: str = KEY) -> "TorqueNetwork":
        """The network of :meth:`to_data`.

        Raises ModelError for a key that is missing or unknown, and for what does not fit; it names
        the key.
        """
        body = {"training": {}, **data}
        check_keys(body, {"regressors", "torques", "network", "training"}, where)
        network = Network.from_data(body["network"], f"{where}.network")
        try:
            return cls(body["regressors"], body["torques"], network, body["training"] or {})
        except ModelError as error:
            place = f"{where}.{error.where}"
            raise ModelError(error.problem, where=place, remedy=error.remedy) from None


class NewtonianWithNetwork(Newtonian):
    """Newtonian TRMS whose axes get a network's torques as well.

    Raises what :class:`trms_cli.models.newtonian.Newtonian` does, whose arguments it has, and
    ModelError for a network that does not fit the model.

    ``parameter_set``: a set without a network is the Newtonian model; the path of a file that has
    one (``trms identify model=newtonian_with_network method=torque_network``) is that with it.
    """

    OPTION = "newtonian_with_network"

    torque_network: TorqueNetwork | None = None
    #: Whether the network's weights are parameters of the model: while it is trained
    free_weights: bool = False

    def _frame(
        self, content: ParameterFile, input_limit: float, moving: Sequence[str] = ("pitch", "yaw")
    ) -> None:
        super()._frame(content, input_limit, moving)
        if content.torque_network:
            network = TorqueNetwork.from_data(content.torque_network, f"{content.name}: {KEY}")
            self._check_fit(network, f"{content.name}: {KEY}")
            self.torque_network = network

    def regressor_names(self) -> tuple[str, ...]:
        """All that a network of this model may be of."""
        angles = self.controlled
        speeds = (f"omega_{angle[-1]}" for angle in angles)
        rates = (f"{angle}{_RATE}" for angle in angles)
        return (*angles, *rates, *speeds, *(rotor.input for rotor in self.rotors.values()))

    def with_network(
        self, network: TorqueNetwork | None, *, free_weights: bool = False
    ) -> "NewtonianWithNetwork":
        """The same model with another network, or none.

        ``free_weights``: the weights follow the parameters, named as :func:`weight_names` does.
        """
        if self.free_weights:
            raise ValueError("the weights are parameters already")
        changed = copy.copy(self)
        changed.torque_network, changed.free_weights = network, free_weights
        if network is not None:
            self._check_fit(network, KEY)
            if free_weights:
                values = np.concatenate([w.ravel() for w in network.network.weights.values()])
                changed.parameters = self.parameters.concatenate(
                    Parameter(name, float(value), "1")
                    for name, value in zip(weight_names(network.network), values, strict=True)
                )
        return changed

    def _check_fit(self, network: TorqueNetwork, where: str) -> None:
        for name in network.regressors:
            problem = f"model {self.OPTION!r} has no {name!r} with the axes that move"
            require_known(name, self.regressor_names(), problem, f"{where}.regressors", ModelError)
        moments = [axis.moment for axis in self.axes.values()]
        for name in network.torques:
            problem = f"nothing moves under {name!r} in this model"
            require_known(name, moments, problem, f"{where}.torques", ModelError)

    def _equations(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> tuple[ca.SX, dict[str, ca.SX]]:
        rates, quantities = super()._equations(x, u, p, w)
        if self.torque_network is None:
            return rates, quantities
        torques = self._torques(x, u, p, rates)
        for name, torque in torques.items():
            state, inertia = _EQUATIONS[name]
            rates[self.state_index(state)] += torque / quantities[inertia]
        return rates, quantities | {f"network_{name}": torque for name, torque in torques.items()}

    def _torques(self, x: ca.SX, u: ca.SX, p: ca.SX, rates: ca.SX) -> dict[str, ca.SX]:
        """The network's torques, N m; ``rates``: derivatives of the states."""
        content = self.torque_network
        assert content is not None
        values = {name: x[i] for i, name in enumerate(self.state_names)}
        values |= {name: u[i] for i, name in enumerate(names(self.inputs))}
        values |= {f"{a}{_RATE}": rates[self.state_index(a)] for a in self.controlled}
        weights = None
        if self.free_weights:
            weights, first = {}, len(self.parameters) - len(weight_names(content.network))
            for name, array in content.network.weights.items():
                # a matrix stands row by row, and casadi fills columns
                flat = p[first : first + array.size]
                weights[name] = ca.reshape(flat, *array.T.shape).T if array.ndim == 2 else flat
                first += array.size
        regressor = ca.vertcat(*(values[name] for name in content.regressors))
        output = content.network.expression(regressor, weights)
        return {name: output[i] for i, name in enumerate(content.torques)}


def weight_names(network: Network) -> list[str]:
    """Names of the weights as parameters, block by block and row by row: ``network_W1_1``."""
    return [
        f"network_{block}_{i + 1}"
        for block, array in network.weights.items()
        for i in range(array.size)
    ]
